"""The gate: known answers for every verdict, and the exit code that follows from them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks import accuracy, metric_level
from benchmarks.__main__ import REGISTRY, WORSE, Name, app
from benchmarks.metric import (
    BaselineValue,
    Direction,
    Metric,
    Verdict,
    compare,
    read_baseline,
    update_baseline,
)
from benchmarks.report import Report, Run
from hmt_service.errors import InvalidInput, NotFound

LOWER, HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


def metric(
    value: float,
    *,
    key: str = "error",
    unit: str = "m",
    direction: Direction = LOWER,
    rel_tol: float | None = 0.1,
) -> Metric:
    return Metric(key, value, unit, direction, rel_tol)


def verdict(measured: Metric, baseline: float, *, unit: str = "m") -> Verdict:
    (comparison,) = compare([measured], {measured.key: BaselineValue(baseline, unit)})
    return comparison.verdict


# ------------------------------------------------------------------ one metric


@pytest.mark.parametrize(
    ("direction", "value", "expected"),
    [
        (LOWER, 2.21, Verdict.WORSE),
        (LOWER, 2.2, Verdict.WITHIN),
        (LOWER, 2.0, Verdict.WITHIN),
        (LOWER, 1.8, Verdict.WITHIN),
        (LOWER, 1.79, Verdict.BETTER),
        (HIGHER, 1.79, Verdict.WORSE),
        (HIGHER, 1.8, Verdict.WITHIN),
        (HIGHER, 2.2, Verdict.WITHIN),
        (HIGHER, 2.21, Verdict.BETTER),
    ],
)
def test_ten_percent_around_two(direction: Direction, value: float, expected: Verdict) -> None:
    assert verdict(metric(value, direction=direction), 2.0) is expected


@pytest.mark.parametrize(
    ("baseline", "value", "expected"),
    [
        (0.0, 0.0, Verdict.WITHIN),
        (0.0, 1.0, Verdict.WORSE),
        (-2.0, -1.9, Verdict.WITHIN),
        (-2.0, -1.7, Verdict.WORSE),
    ],
)
def test_zero_and_negative_baselines(baseline: float, value: float, expected: Verdict) -> None:
    assert verdict(metric(value), baseline) is expected


def test_without_tolerance_the_same_passes_and_anything_worse_fails() -> None:
    assert verdict(metric(2.0, rel_tol=0.0), 2.0) is Verdict.WITHIN
    assert verdict(metric(math.nextafter(2.0, 3.0), rel_tol=0.0), 2.0) is Verdict.WORSE


def test_a_number_that_is_only_reported_never_fails() -> None:
    (comparison,) = compare([metric(9.0, rel_tol=None)], {"error": BaselineValue(2.0, "m")})
    assert comparison.verdict is Verdict.NOT_GATED
    assert not comparison.is_failure
    assert not comparison.is_compared
    assert comparison.change == pytest.approx(3.5)


def test_another_unit_fails_whatever_the_number() -> None:
    (comparison,) = compare([metric(0.1)], {"error": BaselineValue(10.0, "cm")})
    assert comparison.verdict is Verdict.OTHER_UNIT
    assert comparison.is_failure
    assert comparison.change is None


@given(
    baseline=st.floats(-1e6, 1e6),
    value=st.floats(-1e6, 1e6),
    rel_tol=st.floats(0.0, 2.0),
    direction=st.sampled_from(Direction),
)
def test_worse_one_way_is_better_the_other_way(
    baseline: float, value: float, rel_tol: float, direction: Direction
) -> None:
    other = HIGHER if direction is LOWER else LOWER
    mirrored = {Verdict.WORSE: Verdict.BETTER, Verdict.BETTER: Verdict.WORSE}
    one = verdict(metric(value, direction=direction, rel_tol=rel_tol), baseline)
    assert verdict(metric(value, direction=other, rel_tol=rel_tol), baseline) is mirrored.get(
        one, one
    )


@pytest.mark.parametrize(
    ("value", "rel_tol"), [(math.nan, 0.1), (math.inf, 0.1), (1.0, -0.1), (1.0, math.nan)]
)
def test_numbers_that_a_gate_cannot_judge_are_refused(value: float, rel_tol: float) -> None:
    with pytest.raises(InvalidInput, match="metric error"):
        metric(value, rel_tol=rel_tol)


# ------------------------------------------------------------------ both sides


def test_what_one_side_lacks_is_said_and_fails_nothing() -> None:
    comparisons = compare([metric(1.0, key="new")], {"gone": BaselineValue(1.0, "m")})
    assert [(c.key, c.verdict) for c in comparisons] == [
        ("new", Verdict.NOT_IN_BASELINE),
        ("gone", Verdict.NOT_IN_RUN),
    ]
    assert not any(c.is_failure or c.is_compared for c in comparisons)


def test_two_metrics_of_one_key_are_refused() -> None:
    with pytest.raises(InvalidInput, match="2 metrics share 1 keys"):
        compare([metric(1.0), metric(2.0)], {})


# ------------------------------------------------------------------ the file


def test_update_replaces_what_was_measured_and_keeps_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    assert read_baseline(path, "full") == {}
    update_baseline(path, "full", [metric(1.0), metric(2.0, key="other")])
    update_baseline(path, "quick", [metric(7.0)])
    update_baseline(path, "full", [metric(3.0)])
    assert read_baseline(path, "full") == {
        "error": BaselineValue(3.0, "m"),
        "other": BaselineValue(2.0, "m"),
    }
    assert read_baseline(path, "quick") == {"error": BaselineValue(7.0, "m")}


@pytest.mark.parametrize("text", ["", "[]", '{"full": {"error": 1.0}}', '{"full": {"error": {}}}'])
def test_a_file_that_is_no_baseline_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(InvalidInput, match=r"baseline\.json is no baseline"):
        read_baseline(path, "full")


def test_a_baseline_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="cannot write the baseline"):
        update_baseline(tmp_path / "no" / "baseline.json", "full", [metric(1.0)])


# ------------------------------------------------------------------ the command

Measure = Callable[..., None]


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> Measure:
    """Return what makes the accuracy benchmark measure these metrics."""

    def put(*metrics: Metric, skipped: tuple[str, ...] = ()) -> None:
        def measure(run: Run) -> Report:
            run.say("measuring")
            return Report(metrics, skipped)

        monkeypatch.setitem(REGISTRY, Name.ACCURACY, measure)

    return put


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: str | Path, expected: int = 0) -> str:
    result = CliRunner().invoke(app, ["accuracy", *map(str, arguments)])
    assert result.exit_code == expected, result.output
    return " ".join(result.output.split())


def test_the_gate_passes_what_is_the_same_and_fails_what_is_worse(
    tmp_path: Path, measured: Measure
) -> None:
    baseline = tmp_path / "baseline.json"
    measured(metric(2.0), metric(1.0, key="other"))
    run("--baseline", baseline, "--update-baseline")
    assert "gate passed: 2 compared" in run("--baseline", baseline, "--gate")
    measured(metric(2.5), metric(1.0, key="other"))
    output = run("--baseline", baseline, "--gate", expected=WORSE)
    assert "gate failed: 1 of 2 compared: accuracy/error" in output
    assert re.search(r"accuracy/error │ 2\.5 │ m │ 2 │ \+25\.0% │ \+10% │ WORSE", output)
    run("--baseline", baseline)  # only the gate fails


def test_the_gate_says_what_one_side_lacks(tmp_path: Path, measured: Measure) -> None:
    baseline = tmp_path / "baseline.json"
    measured(metric(2.0), metric(1.0, key="gone"))
    run("--baseline", baseline, "--update-baseline")
    measured(metric(2.0), metric(1.0, key="new"), skipped=("intel: no file",))
    output = run("--baseline", baseline, "--gate")
    assert "gate passed: 1 compared, 1 not in baseline, 1 not in this run" in output
    assert "skipped accuracy/intel: no file" in output


def test_a_gate_that_could_compare_nothing_has_not_passed(
    tmp_path: Path, measured: Measure
) -> None:
    measured(metric(2.0))
    missing = tmp_path / "baseline.json"
    assert "no metric could be compared" in run("--baseline", missing, "--gate", expected=WORSE)


def test_a_quick_run_is_not_held_against_a_full_one(tmp_path: Path, measured: Measure) -> None:
    baseline = tmp_path / "baseline.json"
    measured(metric(2.0))
    run("--baseline", baseline, "--update-baseline")
    output = run("--baseline", baseline, "--quick", "--gate", expected=WORSE)
    assert "1 not in baseline" in output


def test_values_of_benchmarks_that_were_not_asked_for_are_left_alone(
    tmp_path: Path, measured: Measure
) -> None:
    baseline = tmp_path / "baseline.json"
    update_baseline(baseline, "full", [metric(1.0, key="latency/scans_lost")])
    measured(metric(2.0))
    assert "not in this run" not in run("--baseline", baseline, "--update-baseline")
    assert set(read_baseline(baseline, "full")) == {"accuracy/error", "latency/scans_lost"}


def test_json_holds_every_number(tmp_path: Path, measured: Measure) -> None:
    measured(metric(2.0, rel_tol=None), skipped=("intel: no file",))
    output = run("--baseline", tmp_path / "none", "--out", tmp_path / "results")
    assert f"numbers and 0 figures in {tmp_path / 'results' / 'full'}" in output
    assert json.loads((tmp_path / "results" / "full" / "accuracy.json").read_text()) == {
        "metrics": [
            {
                "key": "accuracy/error",
                "value": 2.0,
                "unit": "m",
                "direction": "lower",
                "rel_tol": None,
            }
        ],
        "skipped": ["accuracy/intel: no file"],
        "figures": [],
    }


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, measured: Measure) -> None:
    measured(metric(2.0))
    (tmp_path / "file").touch()
    result = CliRunner().invoke(app, ["accuracy", "--out", str(tmp_path / "file")])
    assert isinstance(result.exception, InvalidInput)
    assert "cannot make the folder" in str(result.exception)


def test_without_recorded_logs_accuracy_is_skipped_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    none = tmp_path / "none"
    monkeypatch.setattr(accuracy, "measure_simulated", lambda _: Report(()))
    monkeypatch.setattr(metric_level, "measure", lambda _: Report(()))
    monkeypatch.delenv("HMT_DATA", raising=False)
    assert "skipped accuracy/intel: HMT_DATA does not name the folder" in run("--baseline", none)
    monkeypatch.setenv("HMT_DATA", str(tmp_path))
    output = run("--baseline", none)
    assert "skipped accuracy/aces: no file 2d/aces.clf.bz2" in output
    assert str(tmp_path) not in output.replace(str(none), "")


def test_every_name_has_a_benchmark() -> None:
    assert set(REGISTRY) == set(Name)
