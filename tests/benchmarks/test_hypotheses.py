"""What is compared with what, and one small drive with both budgets."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import pytest

from benchmarks import hypotheses
from benchmarks.cells import Cells
from benchmarks.hypotheses import report_of
from benchmarks.report import Run
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.families import Family, draw

SCANS = 10


def cost(time: float, topology: float, memory: float) -> dict[str, float]:
    return {"time": time, "topology": topology, "memory": memory}


def result(*, alive_most: float = 4.0, extra_kb: float | None = 50.0) -> dict[str, object]:
    return {
        "several": cost(12.0, 3.0, 44.0),
        "one": cost(10.0, 2.0, 40.0),
        "alive_mean": 1.5,
        "alive_most": alive_most,
        "extra_kb": extra_kb,
    }


def test_costs_of_a_group_are_added_up_before_they_are_compared() -> None:
    other = result() | {"several": cost(28.0, 6.0, 36.0), "alive_mean": 2.5, "alive_most": 7.0}
    report = report_of({"worlds": [result(), other | {"extra_kb": 80.0}]})
    assert {metric.key: metric.value for metric in report.metrics} == {
        "worlds/time_over_one": 2.0,
        "worlds/topology_over_one": 2.25,
        "worlds/memory_over_one": 1.0,
        "worlds/alive_mean": 2.0,
        "worlds/alive_most": 7.0,
        "worlds/memory_per_extra": 80.0,
    }
    assert report.skipped == ()


def test_where_one_hypothesis_lives_no_other_takes_memory() -> None:
    alone = result(alive_most=1.0, extra_kb=None)
    report = report_of({"worlds": [alone]})
    assert "worlds/memory_per_extra" not in {metric.key for metric in report.metrics}
    assert report.skipped == (
        "worlds/memory_per_extra: two hypotheses never live at the same time",
    )
    # One world of several in which they do is enough.
    assert report_of({"worlds": [alone, result()]}).skipped == ()


def test_a_log_that_is_missing_is_skipped_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HMT_DATA", str(tmp_path))
    monkeypatch.setattr(hypotheses, "_compare", lambda *_: result())
    cells = Cells(tmp_path / "cells", "a", is_resumed=False)
    run = Run(is_quick=False, say=lambda _: None, out=tmp_path, cells=cells)
    report = hypotheses.measure(run)
    assert report.skipped == ("intel: no file 2d/intel.clf.bz2 in the folder that HMT_DATA names",)
    assert {metric.key.split("/")[0] for metric in report.metrics} == set(hypotheses._FULL)


def test_a_drive_is_mapped_with_each_budget() -> None:
    world = draw(Family.OFFICE, 0)
    instants = islice(simulate(world, INDOOR_LASER, 0), SCANS)
    readings = [reading for instant in instants for reading in instant.readings]
    compared = hypotheses._compare(lambda: readings, SCANS)
    assert json.loads(json.dumps(compared)) == compared
    for budget in ("several", "one"):
        assert 0.0 < compared[budget]["topology"] < compared[budget]["time"]
        assert compared[budget]["memory"] > 0.0
    assert compared["alive_most"] == compared["alive_mean"] == 1.0
    assert compared["extra_kb"] is None


def test_budgets_differ_in_nothing_else() -> None:
    several, one = hypotheses._BUDGETS["several"], hypotheses._BUDGETS["one"]
    assert (several.particles.budget, one.particles.budget) == (15, 1)
    same = one.particles.model_copy(update={"budget": 15})
    assert one.model_copy(update={"particles": same}) == several
