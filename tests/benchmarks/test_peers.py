"""What is skipped and why, and the numbers that follow from results by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import peers
from benchmarks.cells import Cells
from benchmarks.chain import read_readings
from benchmarks.processes import ChildFailed
from benchmarks.report import Run
from hmt_service.core.types import OdometryReading, Scan
from hmt_service.sim.worlds.families import Family

PYTHON = Path("python")


def run_in(folder: Path, *, is_quick: bool) -> Run:
    (folder / "mode").mkdir()
    cells = Cells(folder / "cells", "a", is_resumed=False)
    return Run(is_quick, lambda _: None, folder / "mode", cells)


def costs(speed: float, memory_mb: float) -> dict[str, float]:
    return {
        "speed": speed,
        "cpu_per_scan": 1e3 / speed,
        "map_memory": memory_mb,
        "peak_memory": 4.0 * memory_mb,
        "loop_closures": 2.0,
    }


def errors(absolute_m: float) -> dict[str, float]:
    return {
        "matched": 10,
        "absolute_rmse_m": absolute_m,
        "absolute_max_m": 2.0 * absolute_m,
        "relative_m": 0.1,
        "relative_deg": 0.2,
    }


def with_truth(ours_m: float = 0.2) -> dict[str, Any]:
    return {
        "hmt": {"costs": costs(20.0, 10.0), "errors": errors(ours_m)},
        "kiss_slam": {"costs": costs(10.0, 40.0), "errors": errors(0.4)},
    }


def test_a_quick_run_installs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "make_environment", lambda _: pytest.fail("installs"))
    report = peers.measure(run_in(tmp_path, is_quick=True))
    assert report.metrics == ()
    assert report.skipped == ("all: KISS-SLAM is not installed, which only a full run does",)


def test_what_cannot_be_installed_is_skipped_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: Path) -> Path:
        raise ChildFailed("python ended with code 1\n  looking\n  no network")

    monkeypatch.setattr(peers, "make_environment", fail)
    report = peers.measure(run_in(tmp_path, is_quick=False))
    assert report.skipped == (
        "all: KISS-SLAM cannot be installed: python ended with code 1 no network",
    )


def test_logs_that_are_missing_are_skipped_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "make_environment", lambda _: PYTHON)
    monkeypatch.setattr(peers, "_compare", lambda *_: with_truth())
    monkeypatch.setenv("HMT_DATA", str(tmp_path))
    report = peers.measure(run_in(tmp_path, is_quick=False))
    names = [sentence.split(":")[0] for sentence in report.skipped]
    assert names == ["kitti00_part", "imm_ring"]
    measured = {metric.key.split("/")[0] for metric in report.metrics}
    assert measured == {"garage", "campus"}


def test_ratios_are_of_means_over_the_seeds_and_alone_gated() -> None:
    metrics = {m.key: m for m in peers._metrics("garage", [with_truth(0.1), with_truth(0.3)])}
    assert metrics["garage/speed_over_kiss_slam"].value == 2.0
    assert metrics["garage/cpu_per_scan_over_kiss_slam"].value == 0.5
    assert metrics["garage/map_memory_over_kiss_slam"].value == 0.25
    assert metrics["garage/error_over_kiss_slam"].value == pytest.approx(0.5)
    assert metrics["garage/hmt/absolute_rmse"].value == pytest.approx(0.2)
    assert metrics["garage/hmt/matched"].value == 20.0
    gated = {key for key, metric in metrics.items() if metric.rel_tol is not None}
    assert gated == {
        f"garage/{key}_over_kiss_slam"
        for key in ("cpu_per_scan", "map_memory", "peak_memory", "error")
    }


def test_without_truth_the_gap_between_revisits_is_the_error() -> None:
    result = {
        "hmt": {"costs": costs(20.0, 10.0), "revisit_gap_m": 0.25},
        "kiss_slam": {"costs": costs(10.0, 40.0), "revisit_gap_m": 0.5},
    }
    metrics = {metric.key: metric.value for metric in peers._metrics("imm_ring", [result])}
    assert metrics["imm_ring/error_over_kiss_slam"] == 0.5
    assert metrics["imm_ring/kiss_slam/revisit_gap"] == 0.5
    assert "imm_ring/hmt/absolute_rmse" not in metrics


def test_a_simulated_drive_is_handed_over_with_a_true_pose_per_scan(tmp_path: Path) -> None:
    truth = peers._simulated(Family.GARAGE, 2, 4, tmp_path / "readings")
    readings = list(read_readings(tmp_path / "readings"))
    scans = [reading for reading in readings if isinstance(reading, Scan)]
    assert sum(isinstance(reading, OdometryReading) for reading in readings) == 4
    assert [scan.stamp_s for scan in scans] == [pose.stamp_s for pose in truth]
    assert all(scan.point_times is not None for scan in scans)
    assert np.ptp([pose.reference_from_body[1, 3] for pose in truth]) > 0.0
