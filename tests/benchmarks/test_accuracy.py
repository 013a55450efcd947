"""Accuracy on simulated worlds: a small piece of one, end to end."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import accuracy
from benchmarks.cells import Cells
from benchmarks.report import Run
from hmt_service.sim.usual import USUAL_ROBOTS
from hmt_service.sim.worlds.families import Family

_SCANS = 150


def test_a_piece_of_an_office_is_mapped_and_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(accuracy, "_QUICK_WORLDS", {Family.OFFICE: 1})
    monkeypatch.setattr(accuracy, "_QUICK_WORLD_SCANS", _SCANS)
    cells = Cells(tmp_path, "code", is_resumed=False)
    run = Run(is_quick=True, say=lambda _: None, out=tmp_path, cells=cells)
    values = {metric.key: metric.value for metric in accuracy.measure_simulated(run).metrics}
    assert values["simulated/office/matched"] == _SCANS
    assert 0.0 < values["simulated/office/absolute_rmse"] < 0.2
    assert 0.0 < values["simulated/office/relative_10m"] < 0.2


def test_every_measured_family_has_a_usual_robot() -> None:
    assert set(USUAL_ROBOTS) == set(Family)
