"""The log, the settings and the output of `rbpf-slam`, on hand-made readings."""

from __future__ import annotations

import configparser
import math
import struct
from pathlib import Path

import numpy as np
import pytest

from benchmarks.processes import ChildFailed
from benchmarks.rbpf import (
    beams_of,
    configuration,
    find_rbpf,
    read_memory,
    read_path,
    run_rbpf,
    write_rawlog,
)
from hmt_service.core.geometry import inverse, planar_pose, transform_points, yaw_of
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput

NOTHING = Scan(0.0, np.zeros((0, 3)), np.zeros(3))
SENSOR = np.array([0.3, 0.1, 0.2])


def scan(angles_deg: list[float], ranges_m: list[float], *, stamp_s: float = 0.0) -> Scan:
    angles = np.radians(angles_deg)
    rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    return Scan(stamp_s, SENSOR + rays * np.array(ranges_m)[:, None], SENSOR)


def room(x: float, y: float, yaw: float, *, stamp_s: float) -> list[Reading]:
    """Return odometry and a scan in a room of 8 m by 6 m around the origin."""
    angles = np.radians(np.arange(-90.0, 91.0))
    ahead = np.column_stack([np.cos(angles + yaw), np.sin(angles + yaw)])
    with np.errstate(divide="ignore"):
        walls = [
            (np.sign(ahead[:, i]) * half - at) / ahead[:, i]
            for i, half, at in ((0, 4.0, x), (1, 3.0, y))
        ]
    ranges = np.minimum(*walls)
    points = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
    pose = planar_pose(x, y, yaw)
    return [
        OdometryReading(stamp_s, pose),
        Scan(stamp_s, points * ranges[:, None], np.zeros(3)),
    ]


# ------------------------------------------------------------------ the beams


def test_beams_are_those_of_the_laser() -> None:
    beams = beams_of([scan([-90.0, -60.0, 89.0], [1.0] * 3), scan([0.0, 1.0], [1.0] * 2)])
    assert beams.count == 180
    assert math.degrees(beams.first_rad) == pytest.approx(-90.0)
    assert math.degrees(beams.step_rad) == pytest.approx(1.0)
    assert math.degrees(beams.aperture_rad) == pytest.approx(179.0)


def test_ranges_are_those_of_the_returns_and_zero_without_one() -> None:
    one = scan([-1.0, 0.0, 2.0], [5.0, 0.25, 30.0])
    np.testing.assert_allclose(beams_of([one]).ranges(one), [5.0, 0.25, 0.0, 30.0])


def test_of_two_returns_in_one_direction_the_nearer_one_counts() -> None:
    beams = beams_of([scan([0.0, 1.0], [1.0, 1.0])])
    np.testing.assert_allclose(beams.ranges(scan([1.0, 1.0], [7.0, 6.0])), [0.0, 6.0])


def test_without_returns_there_are_beams_nevertheless() -> None:
    beams = beams_of([NOTHING])
    assert beams.count > 1
    assert not beams.ranges(NOTHING).any()


# ------------------------------------------------------------------ the log


def unpacked(data: bytes, name: str, layout: str, *, number: int = 0) -> tuple[float, ...]:
    """Return what follows the name and version of an object in a log."""
    at = -1
    for _ in range(number + 1):
        at = data.index(bytes([0x80 | len(name)]) + name.encode(), at + 1)
    return struct.unpack_from(layout, data, at + len(name) + 2)


def test_a_log_holds_pairs_of_the_motion_since_the_scan_before_and_a_scan(tmp_path: Path) -> None:
    poses = [planar_pose(1.0, 2.0, 0.5), planar_pose(1.5, 2.5, -0.7)]
    readings: list[Reading] = [
        OdometryReading(0.0, poses[0]),
        scan([0.0, 1.0], [2.0, 3.0], stamp_s=0.0),
        OdometryReading(0.5, planar_pose(9.0, 9.0, 0.0)),  # superseded before the next scan
        OdometryReading(1.0, poses[1]),
        scan([0.0, 1.0], [4.0, 5.0], stamp_s=1.0),
    ]
    assert write_rawlog(readings, tmp_path / "log") == 2
    data = (tmp_path / "log").read_bytes()
    for name in ("CActionCollection", "CSensoryFrame", "CObservation2DRangeScan"):
        assert data.count(name.encode()) == 2
    first, second = (unpacked(data, "CPose2D", "<3d", number=i) for i in (0, 1))
    motion = inverse(poses[0]) @ poses[1]
    assert first == (0.0, 0.0, 0.0)
    assert second == pytest.approx((motion[0, 3], motion[1, 3], yaw_of(motion)))


def test_a_scan_in_a_log_has_its_ranges_which_are_valid_and_its_laser(tmp_path: Path) -> None:
    one = scan([10.0, 11.0, 13.0], [2.0, 3.0, 4.0], stamp_s=1_137_834_225.97376)
    write_rawlog([one], tmp_path / "log")
    data = (tmp_path / "log").read_bytes()
    aperture, is_to_the_left, longest = unpacked(data, "CObservation2DRangeScan", "<f?f")
    assert math.degrees(aperture) == pytest.approx(3.0)
    assert is_to_the_left
    assert longest > 4.0
    pose = np.eye(4)
    numbers = unpacked(data, "CPose3D", "<12d")
    pose[:3, 3], pose[:3, :3] = numbers[:3], np.array(numbers[3:]).reshape(3, 3)
    np.testing.assert_allclose(pose[:3, 3], SENSOR)
    # Beam k of N is at k / (N - 1) of the aperture, half of which is to the right.
    middle = np.array([2.0 * math.cos(-aperture / 2), 2.0 * math.sin(-aperture / 2), 0.0])
    np.testing.assert_allclose(
        transform_points(pose, middle[None])[0], one.points_in_body[0], atol=1e-6
    )
    body = data[data.index(b"CPose3D") + len("CPose3D") + 1 + 96 + 1 :]
    assert struct.unpack_from("<I4f4?", body) == (4, 2.0, 3.0, 0.0, 4.0, True, True, False, True)
    (ticks,) = struct.unpack_from("<Q", body, 4 + 16 + 4 + 4)
    assert ticks / 1e7 - 11_644_473_600 == pytest.approx(one.stamp_s, abs=1e-6)


def test_a_log_without_scans_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no scan to write to log"):
        write_rawlog([OdometryReading(0.0, np.eye(4))], tmp_path / "log")


# ------------------------------------------------------------------ settings and output


def test_settings_make_no_window_and_name_the_output(tmp_path: Path) -> None:
    settings = configparser.ConfigParser()
    settings.read_string(configuration(tmp_path / "output"))
    main = settings["MappingApplication"]
    assert main["logOutput_dir"] == str(tmp_path / "output")
    assert main["SHOW_PROGRESS_IN_WINDOW"] == "0"
    assert main["sampleSize"] == "10"
    assert main["occupancyGrid_count"] == "1"
    grid = settings["MappingApplication_occupancyGrid_00_creationOpts"]
    assert grid["resolution"] == "0.1"


def written(folder: Path, name: str, text: str) -> Path:
    (folder / "output").mkdir(exist_ok=True)
    (folder / "output" / name).write_text(text)
    return folder


def test_memory_after_each_scan_is_read(tmp_path: Path) -> None:
    folder = written(tmp_path, "log_MemoryUsage.txt", "0\t62414848\n1\t62500000\n")
    assert read_memory(folder, 2).tolist() == [62_414_848.0, 62_500_000.0]


def test_memory_after_one_scan_is_read(tmp_path: Path) -> None:
    folder = written(tmp_path, "log_MemoryUsage.txt", "0\t62414848\n")
    assert read_memory(folder, 1).tolist() == [62_414_848.0]


def test_the_path_is_read_with_its_stamps(tmp_path: Path) -> None:
    text = (
        "% time_step  x  y z yaw pitch roll timestamp \n"
        "0 0.5 -0.25 0.0 0.1 0.0 0.0 1137834225.973760\n"
    )
    (pose,) = read_path(written(tmp_path, "log_estimated_path.txt", text), 1)
    assert pose.stamp_s == 1_137_834_225.97376
    np.testing.assert_allclose(pose.reference_from_body, planar_pose(0.5, -0.25, 0.1))


def test_output_about_another_number_of_scans_is_a_failure(tmp_path: Path) -> None:
    folder = written(tmp_path, "log_MemoryUsage.txt", "0\t62414848\n")
    with pytest.raises(ChildFailed, match=r"log_MemoryUsage.txt of rbpf-slam is \(1, 2\), not"):
        read_memory(folder, 3)


def test_output_that_is_missing_is_a_failure(tmp_path: Path) -> None:
    with pytest.raises(ChildFailed, match=r"has not written log_estimated_path\.txt"):
        read_path(tmp_path, 1)


# ------------------------------------------------------------------ the program


def test_the_program_follows_a_robot_through_a_room_better_than_its_odometry(
    tmp_path: Path,
) -> None:
    program = find_rbpf()
    if program is None:
        pytest.skip("rbpf-slam is not installed")
    readings: list[Reading] = []
    truth = [0.1 * step for step in range(16)]
    for step, x in enumerate(truth):
        _, seen = room(x, 0.3, 0.2, stamp_s=float(step))
        wheels = planar_pose(1.3 * x, 0.3, 0.2)
        readings += [OdometryReading(float(step), wheels), seen]
    run = run_rbpf(program, readings, tmp_path, timeout_s=60.0)
    assert len(run.memory_bytes) == len(run.trajectory) == len(truth)
    assert 0.0 < run.empty_bytes < run.memory_bytes[-1]
    moved = [pose.reference_from_body[:3, 3] for pose in run.trajectory]
    travelled = float(np.linalg.norm(moved[-1] - moved[0]))
    assert abs(travelled - 1.5) < 0.2  # the odometry says 1.95
