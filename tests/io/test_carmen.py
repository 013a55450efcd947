"""CARMEN logs: known lines with known answers, damage, and the recorded logs."""

from __future__ import annotations

import bz2
import gzip
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import planar_pose
from hmt_service.core.types import OdometryReading, Scan
from hmt_service.errors import InvalidLog
from hmt_service.io.carmen import CarmenLog, carmen_streams, read_carmen
from hmt_service.io.malformed import Tally
from hmt_service.io.streams import Use


def flaser(
    ranges: list[float],
    *,
    laser: str = "0 0 0",
    robot: str = "0 0 0",
    stamp_s: float = 1.0,
) -> str:
    sweep = f"{len(ranges)} {' '.join(map(str, ranges))}"
    return f"FLASER {sweep} {laser} {robot} {stamp_s} host {stamp_s}"


def odom(stamp_s: float) -> str:
    return f"ODOM 1 2 0.5 0 0 0 {stamp_s} host {stamp_s}"


def robotlaser1(ranges: list[float], *, sensor_max_m: float = 80.0, stamp_s: float = 1.0) -> str:
    return (
        f"ROBOTLASER1 0 -0.5 1.0 0.5 {sensor_max_m} 0.01 1 {len(ranges)} "
        f"{' '.join(map(str, ranges))} 2 7 8 1.1 2 1.5707963267948966 1 2 1.5707963267948966 "
        f"0 0 0.3 0.3 0 {stamp_s} host {stamp_s}"
    )


def rawlaser1(ranges: list[float], *, stamp_s: float = 1.0) -> str:
    return (
        f"RAWLASER1 0 -0.5 1.0 0.5 80 0.01 0 {len(ranges)} {' '.join(map(str, ranges))} 0 "
        f"{stamp_s} host {stamp_s}"
    )


def read(path: Path) -> CarmenLog:
    return read_carmen(path, min_range_m=0.1, max_range_m=40.0)


def read_lines(folder: Path, *lines: str) -> CarmenLog:
    path = folder / "log.clf"
    path.write_text("\n".join(lines) + "\n")
    return read(path)


def scans_of(log: CarmenLog) -> list[Scan]:
    return [reading for reading in log.readings if isinstance(reading, Scan)]


def odometry_of(log: CarmenLog) -> list[OdometryReading]:
    return [reading for reading in log.readings if isinstance(reading, OdometryReading)]


@pytest.mark.parametrize(
    ("beams", "last_rad"),
    [(180, math.radians(89)), (181, math.pi / 2), (360, math.pi / 2), (361, math.pi / 2)],
)
def test_flaser_beams_start_at_minus_90_degrees(
    tmp_path: Path, beams: int, last_rad: float
) -> None:
    points = scans_of(read_lines(tmp_path, flaser([2.0] * beams)))[0].points_in_body
    bearings = np.arctan2(points[:, 1], points[:, 0])
    assert np.linalg.norm(points, axis=1) == pytest.approx(2.0)
    assert np.diff(bearings) == pytest.approx((last_rad + math.pi / 2) / (beams - 1))
    assert bearings[[0, -1]] == pytest.approx([-math.pi / 2, last_rad])


def test_flaser_is_seen_from_the_mounted_laser(tmp_path: Path) -> None:
    # The robot looks along y; the laser sits 0.5 m ahead, 0.2 m to the left, turned by 90 degrees.
    line = flaser([1.0, 2.0, 3.0], laser=f"0.8 2.5 {math.pi}", robot=f"1 2 {math.pi / 2}")
    log = read_lines(tmp_path, line)
    (scan,), (odometry,) = scans_of(log), odometry_of(log)
    assert scan.sensor_in_body == pytest.approx([0.5, 0.2, 0.0])
    assert scan.points_in_body == pytest.approx(
        np.array([[1.5, 0.2, 0.0], [0.5, 2.2, 0.0], [-2.5, 0.2, 0.0]])
    )
    assert odometry.odom_from_body == pytest.approx(planar_pose(1.0, 2.0, math.pi / 2))
    assert odometry.stamp_s == scan.stamp_s == 1.0


@given(
    robot=st.tuples(*[st.floats(-50, 50)] * 2, st.floats(-10, 10)),
    mount=st.tuples(*[st.floats(-2, 2)] * 2, st.floats(-3, 3)),
)
def test_scan_does_not_depend_on_where_the_robot_is(
    tmp_path_factory: pytest.TempPathFactory,
    robot: tuple[float, float, float],
    mount: tuple[float, float, float],
) -> None:
    def text(x: float, y: float, yaw: float) -> str:
        return f"{x:.17g} {y:.17g} {yaw:.17g}"

    x, y, yaw = robot
    odom_from_laser = planar_pose(x, y, yaw) @ planar_pose(*mount)
    laser = text(odom_from_laser[0, 3], odom_from_laser[1, 3], yaw + mount[2])
    folder = tmp_path_factory.mktemp("log")
    moved = read_lines(folder, flaser([1.0, 2.0, 3.0], laser=laser, robot=text(x, y, yaw)))
    still = read_lines(folder, flaser([1.0, 2.0, 3.0], laser=text(*mount)))
    assert scans_of(moved)[0].points_in_body == pytest.approx(
        scans_of(still)[0].points_in_body, abs=1e-9
    )


def test_robotlaser1_uses_its_own_angles_and_range(tmp_path: Path) -> None:
    log = read_lines(tmp_path, robotlaser1([1.0, 2.0, 30.0], sensor_max_m=30.0))
    (scan,) = scans_of(log)
    # Beams at -0.5, 0, 0.5 rad from 0.1 m right of the robot's centre; the third had no return.
    assert scan.points_in_body == pytest.approx(
        np.array([[math.cos(-0.5), math.sin(-0.5) - 0.1, 0.0], [2.0, -0.1, 0.0]])
    )
    assert scan.sensor_in_body == pytest.approx([0.0, -0.1, 0.0])
    assert log.odometry == 1


def test_rawlaser1_is_a_scan_from_the_robot_centre_without_odometry(tmp_path: Path) -> None:
    log = read_lines(tmp_path, rawlaser1([1.0, 2.0]))
    assert (log.scans, log.odometry) == (1, 0)
    assert scans_of(log)[0].sensor_in_body == pytest.approx([0.0, 0.0, 0.0])
    assert scans_of(log)[0].points_in_body[1] == pytest.approx([2.0, 0.0, 0.0])


def test_rawlaser1_beside_the_same_scan_with_a_pose_is_left_out(tmp_path: Path) -> None:
    log = read_lines(tmp_path, rawlaser1([1.0, 2.0]), robotlaser1([1.0, 2.0]))
    assert (log.scans, log.odometry) == (1, 1)


def test_readings_are_sorted_by_time_with_odometry_first(tmp_path: Path) -> None:
    log = read_lines(
        tmp_path,
        flaser([1.0, 1.0], stamp_s=3.0),
        odom(2.0),
        flaser([1.0, 1.0], stamp_s=2.0),
        flaser([1.0, 1.0], stamp_s=1.0),
        flaser([1.0, 1.0], stamp_s=4.0),
    )
    stamps_and_kinds = [(reading.stamp_s, isinstance(reading, Scan)) for reading in log.readings]
    assert stamps_and_kinds == sorted(stamps_and_kinds)
    assert (log.scans, log.odometry, log.out_of_order) == (4, 5, 2)


def test_odometry_lines_give_poses(tmp_path: Path) -> None:
    reading = odometry_of(read_lines(tmp_path, odom(0.5), flaser([1.0, 1.0])))[0]
    assert reading.stamp_s == 0.5
    assert reading.odom_from_body == pytest.approx(planar_pose(1.0, 2.0, 0.5))


def test_ranges_outside_the_limits_are_no_returns(tmp_path: Path) -> None:
    (scan,) = scans_of(read_lines(tmp_path, flaser([0.05, 0.1, 40.0, 40.01, math.inf])))
    assert np.linalg.norm(scan.points_in_body, axis=1) == pytest.approx([0.1, 40.0])


def test_scan_without_returns_is_still_a_scan(tmp_path: Path) -> None:
    log = read_lines(tmp_path, flaser([81.83] * 180))
    assert scans_of(log)[0].points_in_body.shape == (0, 3)


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(flaser([1.0, math.nan]), id="range not a number"),
        pytest.param(flaser([1.0, -1.0]), id="negative range"),
        pytest.param(flaser([1.0]), id="one beam"),
        pytest.param(flaser([1.0, 2.0]).replace("FLASER 2", "FLASER 3"), id="count too large"),
        pytest.param(flaser([1.0, 2.0]).replace("FLASER 2", "FLASER 1"), id="count too small"),
        pytest.param(flaser([1.0, 2.0]).replace("FLASER 2", "FLASER -2"), id="count negative"),
        pytest.param(flaser([1.0, 2.0]).replace("FLASER 2", "FLASER 1.5"), id="count not whole"),
        pytest.param(flaser([1.0, 2.0]).replace("FLASER 2", "FLASER 1e300"), id="count absurd"),
        pytest.param(flaser([1.0, 2.0], robot="0 0 abc"), id="pose not a number"),
        pytest.param(flaser([1.0, 2.0], robot="0 0 nan"), id="pose not finite"),
        pytest.param(flaser([1.0, 2.0], stamp_s=math.inf), id="stamp not finite"),
        pytest.param(flaser([1.0, 2.0])[:-12], id="cut off"),
        pytest.param("FLASER", id="tag alone"),
        pytest.param("ODOM 1 2", id="odometry cut off"),
        pytest.param("ODOM 1 2 \xff 0 0 0 1 host 1", id="odometry with a byte that is no text"),
        pytest.param(robotlaser1([1.0, 2.0]).replace("-0.5 1.0 0.5", "-0.5 1.0 0"), id="no step"),
        pytest.param(robotlaser1([1.0, 2.0]).replace(" 2 7 8 ", " 3 7 8 "), id="remissions"),
    ],
)
def test_malformed_line_is_reported_and_costs_nothing_else(tmp_path: Path, line: str) -> None:
    log = read_lines(tmp_path, "# a comment", line, "", "PARAM laser on", flaser([1.0, 1.0]))
    assert [malformed.place for malformed in log.malformed] == ["line 2"]
    assert log.malformed[0].reason
    assert (log.scans, log.odometry) == (1, 1)


@given(line=st.binary(max_size=60), tag=st.sampled_from([b"FLASER ", b"ODOM ", b"RAWLASER1 ", b""]))
def test_no_line_is_fatal(
    tmp_path_factory: pytest.TempPathFactory, line: bytes, tag: bytes
) -> None:
    path = tmp_path_factory.mktemp("log") / "log.clf"
    path.write_bytes(b"#\n" + tag + line + b"\n" + flaser([1.0, 1.0], stamp_s=7.0).encode() + b"\n")
    assert 7.0 in [scan.stamp_s for scan in scans_of(read(path))]


@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress], ids=["gzip", "bzip2"])
def test_compression_is_known_by_content(
    tmp_path: Path, compress: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "log.clf"
    path.write_bytes(compress(flaser([1.0, 1.0]).encode()))
    assert read(path).scans == 1


def test_damaged_stream_keeps_what_came_before(tmp_path: Path) -> None:
    path = tmp_path / "log.clf.gz"
    noise = np.random.default_rng(1).uniform(1.0, 9.0, (500, 2))
    text = "\n".join(flaser(row.tolist(), stamp_s=i) for i, row in enumerate(noise))
    whole = gzip.compress(text.encode())
    path.write_bytes(whole[: len(whole) // 2])
    log = read(path)
    assert 0 < log.scans < 500
    assert log.malformed[-1].place == f"line {log.scans + 1}"
    assert "compressed stream" in log.malformed[-1].reason


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no CARMEN scan in 0 lines"),
        (odom(1.0).encode(), r"no CARMEN scan in 1 lines \(0 malformed\)"),
        (b"FLASER 2 1 1", r"1 malformed, the first: 0 words left where 3 numbers should be"),
        (b"BZh9 but no more", "compressed stream is damaged"),
        (b"\x1f\x8b", "compressed stream is damaged"),
    ],
)
def test_log_without_a_scan_is_refused_with_numbers(
    tmp_path: Path, content: bytes, reason: str
) -> None:
    path = tmp_path / "log.clf"
    path.write_bytes(content)
    with pytest.raises(InvalidLog, match=reason):
        read(path)


def test_missing_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidLog, match="No such file"):
        read(tmp_path / "none.clf")


@pytest.mark.parametrize(
    ("name", "scans", "beams", "out_of_order", "mount_m"),
    [
        ("intel.clf.bz2", 13_631, 180, 631, 0.0),
        ("fr079.clf.bz2", 4_934, 360, 0, -0.04),
        ("aces.clf.bz2", 7_374, 180, 0, 0.0),
        ("malaga-one-loop.clf.gz", 224, 361, 0, 0.78),
    ],
)
def test_recorded_log_is_read_whole(
    hmt_data: Path, name: str, scans: int, beams: int, out_of_order: int, mount_m: float
) -> None:
    log = read_carmen(hmt_data / "2d" / name, min_range_m=0.0, max_range_m=math.inf)
    assert (log.scans, log.out_of_order, log.malformed) == (scans, out_of_order, ())
    stamps = [reading.stamp_s for reading in log.readings]
    assert stamps == sorted(stamps)
    assert {len(scan.points_in_body) for scan in scans_of(log)} == {beams}
    sensors = np.array([scan.sensor_in_body for scan in scans_of(log)])
    assert sensors == pytest.approx(np.tile([mount_m, 0.0, 0.0], (scans, 1)), abs=2e-6)


def test_streams_are_the_tags_with_their_times_and_uses(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    raw = "RAWLASER1 0 0 0 0.1 0 0 0 2 1 1 0 1.5 host 0"
    lines = ["# no message", "PARAM a b nan host 0", flaser([1.0, 2.0]), odom(2.0), odom(3.0), raw]
    path.write_text("\n".join(lines))
    streams = {stream.name: stream for stream in carmen_streams(path)}
    assert {name: (stream.messages, stream.use) for name, stream in streams.items()} == {
        "FLASER": (1, Use.SCANS_AND_ODOMETRY),
        "ODOM": (2, Use.ODOMETRY),
        "PARAM": (1, Use.NOTHING),
        "RAWLASER1": (1, Use.NOTHING),
    }
    assert streams["ODOM"].times_s.tolist() == [2.0, 3.0]
    assert streams["PARAM"].times_s.tolist() == []
    path.write_text(raw)
    (alone,) = carmen_streams(path)
    assert alone.use is Use.SCANS


def test_arrivals_are_in_the_order_of_the_file_and_defects_are_counted(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("\n".join([odom(3.0), "ODOM nonsense", flaser([1.0, 2.0], stamp_s=2.0)]))
    tally = Tally()
    log = read_carmen(path, min_range_m=0.0, max_range_m=10.0)
    arrivals = list(log.arrivals(tally))
    assert [(a.stream, a.place, a.reading.stamp_s) for a in arrivals] == [
        ("ODOM", "line 1", 3.0),
        ("FLASER", "line 3", 2.0),
        ("FLASER", "line 3", 2.0),
    ]
    assert [each.place for each in tally.result()] == ["line 2"]
    assert [scan.stamp_s for scan in log.sample(100)] == [2.0]
