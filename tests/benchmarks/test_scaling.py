"""Scaling: hand-made drives with known means, power laws and gaps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.cells import Cells, Result
from benchmarks.long_drive import Checkpoint, End, Entry
from benchmarks.report import Run
from benchmarks.scaling import (
    CHECKPOINTS,
    Stretch,
    growth_exponent,
    measure,
    projected_s,
    report,
    stretches_of,
)
from hmt_service.errors import InvalidInput

SCANS = 4
SCAN_S = 0.002


def entry(areas: int, entry_s: float = 0.01) -> Entry:
    return Entry(areas, entry_s, SCANS, SCANS * SCAN_S)


def look(areas: int) -> Checkpoint:
    """Return a checkpoint of a map whose costs grow linearly, 1 ms and 10 kB per area."""
    return Checkpoint(
        areas, 1e-3 * areas, 2e-3 * areas, 1e-4, 1e-3 * areas, 5000 * areas, 10000 * areas
    )


def stretch(areas: int, entry_s: float) -> Stretch:
    return Stretch(areas, float(areas), SCAN_S, entry_s, SCANS)


def driven(
    entries: Sequence[Entry],
    looks: Sequence[int],
    *,
    is_complete: bool = False,
    failure: str | None = None,
) -> Result:
    return {
        "entries": [asdict(each) for each in entries],
        "checkpoints": [asdict(look(areas)) for areas in looks],
        "end": asdict(End(20.0, is_complete, failure)),
    }


# ------------------------------------------------------------------ stretches


def test_a_stretch_ends_with_the_entry_that_reaches_the_checkpoint() -> None:
    # Entries 1 to 10 take 1 s each, those of the second stretch 3 s.
    entries = [entry(areas, 1.0 if areas <= 10 else 3.0) for areas in range(1, 31)]
    first, second = stretches_of(entries, (10, 30, 100))
    assert (first.areas, first.entry_s) == (10, 1.0)
    assert (second.areas, second.entry_s) == (30, 3.0)
    assert first.scan_s == pytest.approx(SCAN_S)
    assert second.scans_per_area == SCANS
    # 10! ^ (1/10): the middle of 1 to 10 on a logarithmic scale.
    assert first.middle == pytest.approx(math.factorial(10) ** 0.1)


def test_known_areas_entered_again_count_as_entries_and_not_as_areas() -> None:
    entries = [entry(1), entry(2), entry(2, 0.07), entry(3)]
    (only,) = stretches_of(entries, (3,))
    assert only.entry_s == pytest.approx(0.1 / 4)
    assert only.scans_per_area == pytest.approx(4 * SCANS / 3)


@pytest.mark.parametrize(("largest", "last"), [(14, 10), (15, 15)])
def test_the_stretch_that_was_cut_off_counts_when_the_map_has_grown_by_half(
    largest: int, last: int
) -> None:
    found = stretches_of([entry(areas) for areas in range(1, largest + 1)], (10, 30))
    assert found[-1].areas == last


def test_an_entry_that_skips_a_number_ends_the_stretch_as_well() -> None:
    first, second = stretches_of([entry(9), entry(12), entry(31)], (10, 30))
    assert (first.areas, second.areas) == (12, 31)


# ------------------------------------------------------------------ growth


@given(
    st.floats(-1.0, 4.0),
    st.floats(1e-6, 1e3),
    st.lists(st.integers(1, 10_000), min_size=2, max_size=7, unique=True),
)
def test_the_exponent_of_a_power_law_is_found(
    exponent: float, factor: float, sizes: list[int]
) -> None:
    costs = [factor * size**exponent for size in sizes]
    assert growth_exponent(sizes, costs) == pytest.approx(exponent, abs=1e-6)


@pytest.mark.parametrize("sizes", [[], [10.0], [10.0, 10.0]])
def test_fewer_than_two_sizes_have_no_exponent(sizes: list[float]) -> None:
    assert growth_exponent(sizes, [1.0] * len(sizes)) is None


def test_costs_that_do_not_grow_are_projected_linearly() -> None:
    # 900 areas to come, of one entry of 10 ms and 4 scans of 2 ms each.
    stretches = [stretch(10, 0.01), stretch(100, 0.01)]
    assert projected_s(stretches, 100, 1000) == pytest.approx(900 * (0.01 + SCANS * SCAN_S))


def test_only_what_is_still_to_come_is_projected() -> None:
    stretches = [stretch(10, 0.01), stretch(100, 0.01)]
    assert projected_s(stretches, 999, 1000) == pytest.approx(0.01 + SCANS * SCAN_S)


def test_costs_that_grow_linearly_are_projected_as_their_sum() -> None:
    # Entry n takes n ms.
    stretches = [stretch(10, 0.01), stretch(100, 0.1)]
    entries_s = sum(1e-3 * n for n in range(101, 1001))
    scans_s = 900 * SCANS * SCAN_S
    assert projected_s(stretches, 100, 1000) == pytest.approx(entries_s + scans_s, rel=2e-3)


def test_the_projection_does_not_trust_a_flat_beginning() -> None:
    # Flat first, then quadratic: over all three the exponent would be one.
    stretches = [stretch(1, 0.01), stretch(10, 0.01), stretch(100, 1.0)]
    more_s = projected_s(stretches, 100, 1000)
    assert more_s is not None
    assert more_s == pytest.approx(1e-4 * (1000**3 - 100**3) / 3 + 900 * SCANS * SCAN_S)


def test_one_stretch_is_not_projected() -> None:
    assert projected_s([stretch(10, 0.01)], 10, 1000) is None


# ------------------------------------------------------------------ the report


def test_a_report_has_the_costs_at_each_checkpoint_and_their_growth(tmp_path: Path) -> None:
    # Entry n takes n ms; the drive is cut off at 50 areas.
    entries = [entry(areas, 1e-3 * areas) for areas in range(1, 51)]
    figure = tmp_path / "figure.png"
    found = report(driven(entries, [10, 30]), 20.0, figure)
    values = {metric.key: metric.value for metric in found.metrics}
    assert values["largest"] == 50.0
    assert values["10_areas/entry"] == pytest.approx(5.5)
    assert values["30_areas/entry"] == pytest.approx(20.5)
    assert values["30_areas/scan"] == pytest.approx(1e3 * SCAN_S)
    assert values["30_areas/consistent_map"] == pytest.approx(30.0)
    assert values["30_areas/memory_per_area"] == pytest.approx(5.0)
    assert values["30_areas/file_per_area"] == pytest.approx(10.0)
    assert values["consistent_map_exponent"] == pytest.approx(1.0)
    assert values["consistent_map_for_tenfold_areas"] == pytest.approx(10.0)
    assert values["scan_for_tenfold_areas"] == pytest.approx(1.0)
    assert found.figures == (figure,)
    assert figure.stat().st_size > 0


def test_growth_is_gated_and_does_not_depend_on_how_far_a_cut_off_drive_came(
    tmp_path: Path,
) -> None:
    entries = [entry(areas, 1e-3 * areas) for areas in range(1, 31)]
    slow = [entry(areas, 5.0) for areas in range(31, 61)]
    short, long = (
        {m.key: m for m in report(driven(es, [10, 30]), 20.0, tmp_path / "f.png").metrics}
        for es in (entries, [*entries, *slow])
    )
    growth = "entry_for_tenfold_areas"
    assert short[growth].rel_tol is not None
    assert short[growth].value == long[growth].value
    assert short["largest"].value < long["largest"].value


def test_each_checkpoint_that_was_not_reached_is_named_with_a_projection(tmp_path: Path) -> None:
    entries = [entry(areas, 1e-3) for areas in range(1, 51)]
    found = report(driven(entries, [10, 30]), 20.0, tmp_path / "figure.png")
    assert [line.split()[0] for line in found.skipped] == [str(n) for n in CHECKPOINTS[2:]]
    # 20 s so far; 9,950 areas of 1 ms and four scans of 2 ms make 90 s more.
    assert found.skipped[-1] == "10000 areas: 50 in 20 s; extrapolated 110 s"


def test_what_would_take_for_ever_is_said_to(tmp_path: Path) -> None:
    entries = [entry(areas, 1e-6 * areas**6) for areas in range(1, 31)]
    found = report(driven(entries, [10, 30]), 20.0, tmp_path / "figure.png")
    assert found.skipped[-1] == "10000 areas: 30 in 20 s; extrapolated over 100 years"


def test_a_route_that_is_too_short_is_told_as_such(tmp_path: Path) -> None:
    entries = [entry(areas) for areas in range(1, 51)]
    found = report(driven(entries, [10, 30], is_complete=True), 20.0, tmp_path / "figure.png")
    assert found.skipped[0] == "100 areas: 50 on the whole route"


def test_a_map_that_failed_keeps_what_was_measured_and_the_gate_sees_it(tmp_path: Path) -> None:
    entries = [entry(areas) for areas in range(1, 51)]
    failed, well = (
        report(driven(entries, [10, 30], failure=failure), 20.0, tmp_path / "figure.png")
        for failure in ("ValueError: singular", None)
    )
    assert failed.skipped[0] == "100 areas: 50, then ValueError: singular"
    (failures,) = set(failed.metrics) - set(well.metrics)
    assert (failures.key, failures.value, failures.rel_tol) == ("failures", 1.0, 0.0)
    assert len(failed.metrics) == len(well.metrics)


def test_a_resumed_run_does_not_drive_again(tmp_path: Path) -> None:
    cells = Cells(tmp_path / "cells", "a", is_resumed=True)
    cells.write("drive", driven([entry(areas) for areas in range(1, 51)], [10, 30]))
    found = measure(Run(True, lambda _: None, tmp_path, cells))
    assert {metric.key: metric.value for metric in found.metrics}["largest"] == 50.0


@pytest.mark.parametrize("areas", [0, 5])
def test_a_drive_that_reached_no_checkpoint_is_an_error(areas: int, tmp_path: Path) -> None:
    entries = [entry(number) for number in range(1, areas + 1)]
    with pytest.raises(InvalidInput, match=f"{areas} areas in 20.0 s"):
        report(driven(entries, []), 20.0, tmp_path / "figure.png")
