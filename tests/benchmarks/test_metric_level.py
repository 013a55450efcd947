"""The metric level: a small piece of a drive end to end, and numbers that follow by hand."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from benchmarks import honesty, metric_level
from benchmarks.cells import Cells
from benchmarks.metric_level import poses_at
from benchmarks.report import Report, Run
from benchmarks.short_steps import StepErrors
from hmt_service.core.geometry import planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.sim.sensors import Lidar3d
from hmt_service.sim.simulation import LIDAR, Robot, simulate
from hmt_service.sim.worlds.families import Family, draw

ROBOT = Robot(follower=LIDAR.follower, sensor=Lidar3d(columns=360))
# A corner, and more than the 10 m that errors are taken over.
DRIVE = metric_level._Drive(Family.GARAGE, 2, ROBOT, 60)
SIDE = {"relative_10m": 0.1, "relative_10m_rotation": 0.2, "cpu_per_scan": 40.0, "failures": 3.0}
PEER = {"relative_10m": 0.2, "relative_10m_rotation": 0.8, "cpu_per_scan": 20.0, "failures": 0.0}


def run_in(folder: Path, *, is_quick: bool) -> Run:
    return Run(is_quick, lambda _: None, folder, Cells(folder, "code", is_resumed=False))


def test_between_two_true_poses_the_robot_drives_along_an_arc() -> None:
    # A quarter turn to the left around (0, 1) in 2 s.
    truth = [
        StampedPose(10.0, planar_pose(0.0, 0.0, 0.0)),
        StampedPose(12.0, planar_pose(1.0, 1.0, np.pi / 2)),
        StampedPose(13.0, planar_pose(1.0, 3.0, np.pi / 2)),
    ]
    stamps_s = np.array([9.0, 10.0, 11.0, 12.0, 12.25, 13.0, 14.0])
    half = np.sqrt(0.5)
    expected = [
        planar_pose(0.0, 0.0, 0.0),
        planar_pose(0.0, 0.0, 0.0),
        planar_pose(half, 1.0 - half, np.pi / 4),
        planar_pose(1.0, 1.0, np.pi / 2),
        planar_pose(1.0, 1.5, np.pi / 2),
        planar_pose(1.0, 3.0, np.pi / 2),
        planar_pose(1.0, 3.0, np.pi / 2),
    ]
    found = poses_at(truth, stamps_s)
    assert [pose.stamp_s for pose in found] == stamps_s.tolist()
    for pose, same in zip(found, expected, strict=True):
        np.testing.assert_allclose(pose.reference_from_body, same, atol=1e-12)


def test_the_truth_of_a_simulated_drive_is_where_its_scans_end(tmp_path: Path) -> None:
    truth = metric_level._simulated(DRIVE, tmp_path / "readings")
    assert len(truth) > 9 * DRIVE.scans
    instants = islice(simulate(draw(DRIVE.family, DRIVE.seed), ROBOT, DRIVE.seed), DRIVE.scans)
    ends = [instant.truth for instant in instants]
    for pose, end in zip(poses_at(truth, np.array([e.stamp_s for e in ends])), ends, strict=True):
        np.testing.assert_allclose(pose.reference_from_body, end.reference_from_body, atol=1e-9)


def test_a_small_drive_is_tracked_by_all_three(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metric_level, "_QUICK_DRIVES", {"small": DRIVE})
    report = metric_level._measure_lidar(run_in(tmp_path, is_quick=True))
    values = {metric.key: metric.value for metric in report.metrics}
    for side in ("hmt", "hmt_scans_only", "kiss_icp"):
        assert values[f"lidar/small/{side}/speed"] > 0.0
    assert 0.0 < values["lidar/small/hmt/relative_10m"] < 0.5
    assert 0.0 < values["lidar/small/hmt/relative_10m_rotation"] < 3.0
    assert report.skipped == ()


def test_ratios_are_over_kiss_icp_and_alone_gated() -> None:
    sides = {"hmt": SIDE, "hmt_scans_only": SIDE, "kiss_icp": PEER}
    metrics = {metric.key: metric for metric in metric_level._lidar_metrics("lidar/x", sides)}
    assert metrics["lidar/x/hmt/relative_10m_over_kiss_icp"].value == 0.5
    assert metrics["lidar/x/hmt_scans_only/relative_10m_rotation_over_kiss_icp"].value == 0.25
    assert metrics["lidar/x/hmt/cpu_per_scan_over_kiss_icp"].value == 2.0
    assert metrics["lidar/x/hmt/speed"].value == 25.0
    assert metrics["lidar/x/kiss_icp/speed"].value == 50.0
    assert metrics["lidar/x/hmt/failures"].value == 3.0
    assert "lidar/x/kiss_icp/failures" not in metrics
    gated = {key for key, metric in metrics.items() if metric.rel_tol is not None}
    assert gated == {key for key in metrics if key.endswith("_over_kiss_icp")}
    assert len(gated) == 6


def test_logs_that_are_missing_are_skipped_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metric_level, "_compare", lambda *_, **__: {"hmt": SIDE, "kiss_icp": PEER})
    monkeypatch.setattr(metric_level, "_watch", lambda _: {"settled": 100e6, "late": 110e6})
    monkeypatch.setattr(honesty, "measure", lambda _: Report(()))
    monkeypatch.setenv("HMT_DATA", str(tmp_path))
    report = metric_level.measure(run_in(tmp_path, is_quick=False))
    names = [sentence.split(":")[0] for sentence in report.skipped]
    assert names == ["lidar/kitti00_part", "steps/intel", "steps/fr079", "steps/aces"]
    values = {metric.key: metric.value for metric in report.metrics}
    assert values["speed/garage-64"] == 25.0


def test_the_worst_step_and_what_is_usual_are_gated_what_the_wheels_say_is_not() -> None:
    errors = StepErrors(7, 0.1, 0.4, 0.3, 0.2, 11.0, 12.0)
    metrics = [*metric_level._step_metrics("steps/x", errors)]
    assert [(m.key, m.value, m.rel_tol is not None) for m in metrics] == [
        ("steps/x/relations", 7.0, True),
        ("steps/x/worst_step", 0.4, True),
        ("steps/x/p99_step", 0.1, True),
        ("steps/x/worst_step_raw", 0.3, False),
        ("steps/x/worst_step_ours_vs_raw", 0.2, False),
    ]


def test_growth_is_what_came_after_the_second_minute() -> None:
    metrics = [*metric_level._memory_metrics("memory/x", 100e6, 125e6)]
    assert [(m.key, m.value, m.unit) for m in metrics] == [
        ("memory/x/growth", 25.0, "MB"),
        ("memory/x/growth_ratio", 1.25, "1"),
        ("memory/x/resident", 125.0, "MB"),
    ]
