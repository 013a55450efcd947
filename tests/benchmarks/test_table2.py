"""Which logs are skipped and why, and one small log through both programs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import table2
from benchmarks.cells import Cells
from benchmarks.rbpf import find_rbpf
from benchmarks.report import Run
from benchmarks.stages import Stage

LOG = "malaga-one-loop.clf.gz"
PROGRAM = Path("rbpf-slam")


def run_in(folder: Path) -> Run:
    cells = Cells(folder / "cells", "a", is_resumed=False)
    return Run(is_quick=True, say=lambda _: None, out=folder, cells=cells)


def side(time_s: float, memory_mb: float) -> dict[str, object]:
    numbers = {"time": time_s, "map_memory": memory_mb, "peak_memory": 200.0}
    return {"numbers": numbers, "growth_mb": [0.0, memory_mb]}


def result(ours_s: float = 2.0) -> dict[str, object]:
    return {
        "scans": [1, 10],
        "sides": {"hmt": side(ours_s, 20.0), "rbpf": side(8.0, 80.0)},
        "spent_s": {stage.value: [0.1, 0.2] for stage in Stage},
        "ms_per_scan": {stage.value: 20.0 for stage in Stage},
    }


def test_without_the_program_everything_is_skipped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table2, "find_rbpf", lambda: None)
    report = table2.measure(run_in(tmp_path))
    assert report.metrics == ()
    assert report.skipped == ("all: rbpf-slam is not installed (Debian package mrpt-apps)",)


def test_a_log_that_is_missing_is_skipped_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table2, "find_rbpf", lambda: PROGRAM)
    monkeypatch.setenv("HMT_DATA", str(tmp_path))
    report = table2.measure(run_in(tmp_path))
    assert report.metrics == ()
    assert report.skipped == (f"malaga: no file 2d/{LOG} in the folder that HMT_DATA names",)


def test_ratios_are_of_ours_over_theirs_and_medians_over_repetitions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "2d").mkdir()
    (tmp_path / "2d" / LOG).touch()
    monkeypatch.setenv("HMT_DATA", str(tmp_path))
    monkeypatch.setattr(table2, "find_rbpf", lambda: PROGRAM)
    results = iter([result(2.0), result(100.0), result(4.0)])
    monkeypatch.setattr(table2, "_compare", lambda *_: next(results))
    cells = Cells(tmp_path / "cells", "a", is_resumed=False)
    run = Run(is_quick=False, say=lambda _: None, out=tmp_path, cells=cells)
    report = table2.measure(run)
    values = {metric.key: metric for metric in report.metrics}
    assert values["malaga/time_over_rbpf"].value == 0.5
    assert values["malaga/map_memory_over_rbpf"].value == 0.25
    assert values["malaga/hmt/time"].value == 4.0
    assert values["malaga/hmt/metric_slam_per_scan"].value == 20.0
    gated = {key for key, metric in values.items() if metric.rel_tol is not None}
    assert gated == {"malaga/time_over_rbpf", "malaga/map_memory_over_rbpf"}
    assert [figure.name for figure in report.figures] == ["table2-malaga.png"]
    assert all(figure.stat().st_size > 10_000 for figure in report.figures)
    assert [sentence.split(":")[0] for sentence in report.skipped] == ["fr079", "intel"]


def test_a_tiny_log_goes_through_both_programs(tmp_path: Path) -> None:
    program = find_rbpf()
    if program is None:
        pytest.skip("rbpf-slam is not installed")
    angles = np.radians(np.arange(-90.0, 91.0))
    with (tmp_path / "tiny.clf").open("w") as log:
        for step in range(12):
            # A room of 10 m by 6 m, driven along its middle.
            x = 0.1 * step
            with np.errstate(divide="ignore"):
                ahead = (5.0 - x) / np.abs(np.cos(angles))
                aside = 3.0 / np.abs(np.sin(angles))
            ranges = " ".join(f"{each:.3f}" for each in np.minimum(ahead, aside))
            log.write(f"FLASER 181 {ranges} {x} 0 0 {x} 0 0 {step}.0 host {step}.0\n")
    log_of = table2._Log("tiny", "tiny.clf", None, 1)
    compared = table2._compare(program, tmp_path / "tiny.clf", log_of, is_quick=True)
    assert json.loads(json.dumps(compared)) == compared
    assert compared["scans"] == list(range(1, 13))
    # The other one's is within the error of the time that it takes to start.
    assert compared["sides"]["hmt"]["numbers"]["time"] > 0.0
    for one in compared["sides"].values():
        assert one["numbers"]["peak_memory"] > 10.0
        assert len(one["growth_mb"]) == 12
    assert set(compared["spent_s"]) == set(Stage)
