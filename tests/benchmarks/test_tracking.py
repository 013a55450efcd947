"""Odometries alone, as programs and in this process: the same poses, and when they are taken."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from kiss_icp.config import load_config as load_kiss_icp_config
from kiss_icp.preprocess import get_preprocessor

from benchmarks.chain import write_readings
from benchmarks.processes import ChildFailed
from benchmarks.tracking import (
    ChainedOdometry,
    Program,
    kiss_icp_variables,
    moment_of,
    run_tracker,
)
from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import Pose, planar_pose
from hmt_service.core.types import Reading, Scan, StampedPose
from hmt_service.sim.sensors import Lidar3d
from hmt_service.sim.simulation import LIDAR, Robot, simulate
from hmt_service.sim.worlds.families import Family, draw

ROBOT = Robot(follower=LIDAR.follower, sensor=Lidar3d(rows=8, columns=180))
SCANS = 30


@pytest.fixture(scope="module")
def drive() -> tuple[list[Reading], list[StampedPose]]:
    instants = list(islice(simulate(draw(Family.GARAGE, 0), ROBOT, 0), SCANS))
    readings = [reading for instant in instants for reading in instant.readings]
    return readings, [instant.truth for instant in instants]


def scan_of(times: list[float] | None, stamp_s: float = 3.0) -> Scan:
    points = np.tile([10.0, 0.0, 0.0], (2 if times is None else len(times), 1))
    return Scan(stamp_s, points, np.zeros(3), None if times is None else np.array(times))


def motion(first: StampedPose, last: StampedPose) -> Pose:
    return np.linalg.inv(first.reference_from_body) @ last.reference_from_body


def test_kiss_icp_carries_all_points_to_the_moment_of_the_last_return(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in kiss_icp_variables(60.0).items():
        monkeypatch.setenv(name, value)
    preprocessor = get_preprocessor(load_kiss_icp_config(None))
    scan = scan_of([0.2, 0.5, 0.8])
    carried = preprocessor.preprocess(
        scan.points_in_body, scan.point_times, planar_pose(1.0, 0.0, 0.0)
    )
    # The robot moves 1 m between the first and the last return, whose point stays.
    np.testing.assert_allclose(carried[:, 0], [9.0, 9.5, 10.0], atol=1e-12)


def test_kiss_icp_takes_its_own_voxel_from_the_range(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in kiss_icp_variables(60.0).items():
        monkeypatch.setenv(name, value)
    config = load_kiss_icp_config(None)
    assert config.data.max_range == 60.0
    assert config.data.deskew
    assert config.mapping.voxel_size == 0.6
    assert config.registration.max_num_threads == 1


def test_the_last_return_is_that_share_of_the_sweep_before_its_end() -> None:
    assert moment_of(scan_of([0.1, 0.75]), before_s=2.6) == pytest.approx(2.9)
    assert moment_of(scan_of([0.1, 1.0]), before_s=2.6) == 3.0


@pytest.mark.parametrize("scan", [scan_of(None), scan_of([])])
def test_a_scan_without_times_is_of_its_stamp(scan: Scan) -> None:
    assert moment_of(scan, before_s=2.6) == 3.0


def test_the_robot_stands_before_the_first_scan() -> None:
    assert moment_of(scan_of([0.5]), before_s=None) == 3.0


def test_chained_keyframes_follow_the_robot(
    drive: tuple[list[Reading], list[StampedPose]],
) -> None:
    readings, truth = drive
    tracker = ChainedOdometry(load_config(Preset.INDOOR))
    poses = [pose for reading in readings if (pose := tracker.track(reading)) is not None]
    assert [pose.stamp_s for pose in poses] == [pose.stamp_s for pose in truth]
    driven, found = motion(truth[0], truth[-1]), motion(poses[0], poses[-1])
    # Many keyframes: what it has driven is far beyond the distance between two.
    assert np.linalg.norm(driven[:3, 3]) > 4.0
    assert np.linalg.norm(found[:3, 3] - driven[:3, 3]) < 0.3


def test_the_program_tracks_as_this_process_does(
    drive: tuple[list[Reading], list[StampedPose]], tmp_path: Path
) -> None:
    readings, _ = drive
    write_readings(readings, tmp_path / "readings")
    for program in (Program.HMT, Program.HMT_SCANS_ONLY):
        run = run_tracker(program, tmp_path / "readings", Preset.INDOOR, tmp_path, timeout_s=120.0)
        tracker = ChainedOdometry(load_config(Preset.INDOOR), has_odometry=program is Program.HMT)
        expected = [pose for each in readings if (pose := tracker.track(each)) is not None]
        assert run.failures == tracker.failures
        assert run.speed_hz == pytest.approx(SCANS / run.cpu_s)
        for pose, same in zip(run.trajectory, expected, strict=True):
            assert pose.stamp_s == same.stamp_s
            np.testing.assert_allclose(
                pose.reference_from_body, same.reference_from_body, atol=1e-9
            )


def test_kiss_icp_gives_every_scan_a_pose_in_its_sweep(
    drive: tuple[list[Reading], list[StampedPose]], tmp_path: Path
) -> None:
    readings, truth = drive
    write_readings(readings, tmp_path / "readings")
    run = run_tracker(
        Program.KISS_ICP, tmp_path / "readings", Preset.INDOOR, tmp_path, timeout_s=120.0
    )
    late_s = [end.stamp_s - pose.stamp_s for pose, end in zip(run.trajectory, truth, strict=True)]
    assert 0.0 <= min(late_s) <= max(late_s) < ROBOT.scan_period_s
    moved_m = np.linalg.norm(motion(run.trajectory[0], run.trajectory[-1])[:3, 3])
    assert moved_m > 1.0
    assert run.failures == 0


def test_a_file_that_is_no_readings_is_a_failure(tmp_path: Path) -> None:
    (tmp_path / "readings").write_bytes(b"not an array")
    with pytest.raises(ChildFailed, match="ended with code 1"):
        run_tracker(Program.HMT, tmp_path / "readings", Preset.INDOOR, tmp_path, timeout_s=120.0)
