"""Logs with known faults, as other programs write them: each is found, with the next step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hmt_service.core.config import Preset
from hmt_service.core.geometry import FloatArray, Pose, planar_pose
from hmt_service.errors import InvalidLog
from hmt_service.io.findings import Finding, Severity, Trouble
from hmt_service.io.inspection import Inspection, Verdict, inspect_log
from hmt_service.io.mcap_writer import McapWriter
from hmt_service.io.ros_messages import Serialization
from hmt_service.io.streams import Says, Use
from tests.flat import BEAMS, readings
from tests.hall import write_hall
from tests.ros import BODY, LASER, SCAN_FRAME, Ros, Stamped, write_bag1, write_bag2

SCANS = 60
ROS2 = Ros()
STATIC: Stamped = ("/tf_static", 999.0, ROS2.transforms((BODY, SCAN_FRAME, np.eye(4))))


def drive(scans: int = SCANS) -> list[Stamped]:
    """Return a sound drive through the flat."""
    return [STATIC, *ROS2.drive(scans)]


def bag(folder: Path, sent: Sequence[Stamped]) -> Path:
    return write_bag2(folder / "bag", sent)


def found(inspection: Inspection, trouble: Trouble) -> Finding:
    (finding,) = [each for each in inspection.findings if each.trouble is trouble]
    return finding


def changed(change: Callable[[int, Any], Stamped | None], kind: str = LASER) -> list[Stamped]:
    """Return the drive with every message of a kind changed; None leaves it out."""
    sent: list[Stamped] = []
    number = 0
    for each in drive():
        if each[2].__msgtype__ != kind:
            sent.append(each)
            continue
        if (other := change(number, each)) is not None:
            sent.append(other)
        number += 1
    return sent


# ------------------------------------------------------------------ sound logs


def test_a_sound_bag_is_described_and_usable(tmp_path: Path) -> None:
    sent = [*drive(), *(("/camera", 1000.0 + t, ROS2.header(1.0 + t, "c")) for t in range(3))]
    inspection = inspect_log(bag(tmp_path, sent))
    assert (inspection.verdict, inspection.findings) == (Verdict.USABLE, ())
    assert inspection.form == "bag of ROS 2"
    uses = {stream.name: (stream.use, stream.messages) for stream in inspection.streams}
    assert uses == {
        "/camera": (Use.NOTHING, 3),
        "/odom": (Use.ODOMETRY, SCANS),
        "/scan": (Use.SCANS, SCANS),
        "/tf_static": (Use.FRAMES, 1),
    }
    mounting, scans, odometry = inspection.mounting, inspection.scans, inspection.odometry
    assert mounting is not None
    assert (mounting.scan_frame, mounting.body_frame) == (SCAN_FRAME, BODY)
    assert mounting.says is Says.STATIC_FRAMES
    assert scans is not None
    assert (scans.scans, scans.beams, scans.points_p50) == (SCANS, BEAMS, BEAMS)
    assert (scans.rows, scans.width_deg) == (None, 360.0)
    assert scans.timing.rate_hz == pytest.approx(20.0)
    assert odometry is not None
    # 0.1 m from scan to scan.
    assert odometry.path_m == pytest.approx(0.1 * (SCANS - 1), rel=0.01)
    assert odometry.jump_m == pytest.approx(0.1, rel=0.01)
    assert inspection.preset is Preset.PLANAR


def test_the_same_drive_is_the_same_in_every_format(tmp_path: Path) -> None:
    with (tmp_path / "flat.mcap").open("wb") as file:
        writer = McapWriter(file)
        for reading in readings(SCANS):
            writer.write(reading)
        writer.finish()
    ros1 = Ros(Serialization.ROS1)
    static = ("/tf_static", 999.0, ros1.transforms((BODY, SCAN_FRAME, np.eye(4))))
    logs = [
        tmp_path / "flat.mcap",
        bag(tmp_path, drive()),
        write_bag1(tmp_path / "flat.bag", [static, *ros1.drive(SCANS)]),
    ]
    first, *others = map(inspect_log, logs)
    assert first.scans is not None
    for other in others:
        assert other.scans is not None
        assert other.scans.timing.first_s == first.scans.timing.first_s
        assert other.scans.range_p50_m == pytest.approx(first.scans.range_p50_m)
        assert other.fit == first.fit


@pytest.mark.parametrize(("half_m", "preset"), [(6.0, Preset.INDOOR), (40.0, Preset.OUTDOOR)])
def test_a_lidar_has_rows_and_the_preset_of_where_it_drives(
    tmp_path: Path, half_m: float, preset: Preset
) -> None:
    inspection = inspect_log(write_hall(tmp_path, half_m=half_m))
    assert inspection.verdict is Verdict.USABLE
    assert {finding.trouble for finding in inspection.findings} == {
        Trouble.NO_ODOMETRY,
        Trouble.NO_POINT_TIMES,
    }
    assert inspection.preset is preset
    assert inspection.scans is not None
    assert (inspection.scans.rows, inspection.scans.width_deg) == (16, 360.0)
    assert inspection.scans.lowest_deg == pytest.approx(-15.0, abs=0.1)


# ------------------------------------------------------------------ one fault each


def test_ranges_in_mm_are_an_error(tmp_path: Path) -> None:
    inspection = inspect_log(write_hall(tmp_path, half_m=6.0, scale=1000.0))
    assert inspection.verdict is Verdict.UNUSABLE
    finding = found(inspection, Trouble.WRONG_UNIT)
    assert finding.severity is Severity.ERROR
    assert "write the log in m" in finding.advice
    assert inspection.preset is None


def test_a_flipped_lidar_is_noticed_in_the_open(tmp_path: Path) -> None:
    inspection = inspect_log(write_hall(tmp_path, half_m=40.0, z_sign=-1.0))
    finding = found(inspection, Trouble.UPSIDE_DOWN)
    assert finding.severity is Severity.WARNING
    assert "1.6 m above the sensor" in finding.message
    assert "--sensor-pose 0 0 0 180 0 0" in finding.advice


def test_messages_that_are_refused_are_counted_and_named(tmp_path: Path) -> None:
    def unstamped(number: int, sent: Stamped) -> Stamped:
        if number % 10 == 3:
            sent[2].header = ROS2.header(0.0, SCAN_FRAME)
        return sent

    inspection = inspect_log(bag(tmp_path, changed(unstamped)))
    assert inspection.verdict is Verdict.DOUBTFUL
    finding = found(inspection, Trouble.MALFORMED)
    assert finding.message == "/scan, message 4: bad_stamp, 6 times"
    assert "stamp" in finding.advice


def test_odometry_of_a_body_that_nothing_joins_says_what_to_do(tmp_path: Path) -> None:
    inspection = inspect_log(bag(tmp_path, drive()[1:]))
    assert inspection.verdict is Verdict.DOUBTFUL
    assert inspection.odometry is None
    finding = found(inspection, Trouble.MALFORMED)
    assert f"/odom, message 1: wrong_frame, {SCANS} times" in finding.message
    assert f"'{SCAN_FRAME}', odometry is of '{BODY}'" in finding.advice
    assert "--sensor-pose" in finding.advice
    assert f"none of {SCANS} readings" in found(inspection, Trouble.NO_ODOMETRY).message
    joined = inspect_log(tmp_path / "bag", body_from_sensor=np.eye(4))
    assert joined.verdict is Verdict.USABLE


def test_a_log_without_odometry_is_usable(tmp_path: Path) -> None:
    sent = changed(lambda _, __: None, "nav_msgs/msg/Odometry")
    inspection = inspect_log(bag(tmp_path, sent))
    assert inspection.verdict is Verdict.USABLE
    assert found(inspection, Trouble.NO_ODOMETRY).severity is Severity.NOTE


@pytest.mark.parametrize(("late_s", "severity"), [(0.12, Severity.NOTE), (30.0, Severity.WARNING)])
def test_stamps_that_go_backwards_are_a_warning_where_they_cost_scans(
    tmp_path: Path, late_s: float, severity: Severity
) -> None:
    def late(number: int, sent: Stamped) -> Stamped:
        if number == 30:
            sent[2].header = ROS2.header(sent[1] - late_s, SCAN_FRAME)
        return sent

    finding = found(inspect_log(bag(tmp_path, changed(late))), Trouble.STAMPS_BACKWARDS)
    assert finding.severity is severity
    assert f"1 scans are stamped earlier than the one before, by up to {late_s - 0.05:.3f}" in (
        finding.message
    )


def test_scans_with_the_stamp_of_the_one_before_are_a_warning(tmp_path: Path) -> None:
    sent = [each for message in drive() for each in [message] * (1 + (message[0] == "/scan"))]
    finding = found(inspect_log(bag(tmp_path, sent)), Trouble.STAMPS_REPEATED)
    assert f"{SCANS} scans have the stamp of the one before" in finding.message


@pytest.mark.parametrize(
    ("has_odometry", "severity"), [(True, Severity.NOTE), (False, Severity.WARNING)]
)
def test_a_gap_is_a_warning_where_no_odometry_bridges_it(
    tmp_path: Path, has_odometry: bool, severity: Severity
) -> None:
    sent = changed(lambda number, sent: None if 10 < number < 50 else sent)
    if not has_odometry:
        sent = [each for each in sent if each[0] != "/odom"]
    finding = found(inspect_log(bag(tmp_path, sent)), Trouble.GAPS)
    assert finding.severity is severity
    assert finding.message.startswith("1 gaps between scans, the longest of 2.0 s after 1000.500 s")


def with_ranges(ranges_of: Callable[[int, FloatArray], FloatArray]) -> list[Stamped]:
    def change(number: int, sent: Stamped) -> Stamped:
        sent[2].ranges = ranges_of(number, sent[2].ranges).astype(np.float32)
        return sent

    return changed(change)


@pytest.mark.parametrize(
    ("ranges_of", "trouble", "severity", "message"),
    [
        (
            lambda number, ranges: ranges if number % 4 else np.full_like(ranges, np.inf),
            Trouble.SCANS_EMPTY,
            Severity.WARNING,
            "15 of 60 scans have no return",
        ),
        (
            lambda _, ranges: np.full_like(ranges, np.inf),
            Trouble.SCANS_EMPTY,
            Severity.ERROR,
            "60 of 60 scans have no return",
        ),
        (
            lambda _, ranges: np.full_like(ranges, 3.0),
            Trouble.SCANS_CONSTANT,
            Severity.ERROR,
            "60 of 60 scans have one range",
        ),
        (
            lambda _, ranges: np.linspace(2.0, 5.0, len(ranges)),
            Trouble.SCANS_FROZEN,
            Severity.WARNING,
            "59 of 60 scans repeat the one before",
        ),
        (
            lambda _, ranges: np.where(np.arange(len(ranges)) % 4, ranges, 30.0),
            Trouble.NO_RETURN_AS_RANGE,
            Severity.WARNING,
            "25 % of all returns are as far as the farthest, 30.000 m",
        ),
    ],
)
def test_ranges_that_no_sensor_measures_are_found(
    tmp_path: Path,
    ranges_of: Callable[[int, FloatArray], FloatArray],
    trouble: Trouble,
    severity: Severity,
    message: str,
) -> None:
    finding = found(inspect_log(bag(tmp_path, with_ranges(ranges_of))), trouble)
    assert finding.severity is severity
    assert finding.message.startswith(message)


def test_a_range_for_no_return_can_be_left_out_as_advised(tmp_path: Path) -> None:
    sent = with_ranges(lambda _, ranges: np.where(np.arange(len(ranges)) % 4, ranges, 30.0))
    finding = found(inspect_log(bag(tmp_path, sent)), Trouble.NO_RETURN_AS_RANGE)
    assert "`sensor: {max_range_m: 29.9}`" in finding.advice


def with_poses(pose_of: Callable[[int], Pose]) -> list[Stamped]:
    def change(number: int, sent: Stamped) -> Stamped:
        topic, stamp_s, _ = sent
        return topic, stamp_s, ROS2.odometry(pose_of(number), stamp_s=stamp_s)

    return changed(change, "nav_msgs/msg/Odometry")


def test_odometry_that_jumps_or_stays_is_a_warning(tmp_path: Path) -> None:
    jumping = with_poses(lambda n: planar_pose(0.1 * n + 50.0 * (n >= 40), 0.0, 0.0))
    finding = found(inspect_log(bag(tmp_path / "a", jumping)), Trouble.ODOMETRY_JUMPS)
    assert finding.message == "the odometry jumps 50.1 m in 0.05 s, after 1001.950 s"
    still = with_poses(lambda _: planar_pose(7.0, 0.0, 0.0))
    finding = found(inspect_log(bag(tmp_path / "b", still)), Trouble.ODOMETRY_STILL)
    assert finding.severity is Severity.WARNING


def test_a_clock_that_is_set_while_recording_is_a_gap_of_years(tmp_path: Path) -> None:
    def since_boot(number: int, sent: Stamped) -> Stamped:
        topic, stamp_s, message = sent
        if number < 10:
            frame = SCAN_FRAME if topic == "/scan" else "odom"
            message.header = ROS2.header(1.0 + 0.05 * number, frame)
        else:
            message.header = ROS2.header(1.5e9 + stamp_s, message.header.frame_id)
        return topic, stamp_s, message

    sent = [STATIC]
    for number in range(SCANS):
        sent += [
            since_boot(number, each) for each in ROS2.drive(SCANS)[2 * number : 2 * number + 2]
        ]
    inspection = inspect_log(bag(tmp_path, sent))
    finding = found(inspection, Trouble.GAPS)
    assert finding.severity is Severity.NOTE
    assert inspection.odometry is not None
    assert inspection.odometry.path_m == pytest.approx(0.1 * (SCANS - 1), rel=0.02)


def test_clocks_that_differ_are_told_by_when_both_were_recorded(tmp_path: Path) -> None:
    def ahead(_: int, sent: Stamped) -> Stamped:
        sent[2].header = ROS2.header(sent[1] + 3.0, SCAN_FRAME)
        return sent

    finding = found(inspect_log(bag(tmp_path, changed(ahead))), Trouble.CLOCKS_APART)
    assert finding.message.endswith("their clocks differ by about -3.000 s")


def test_scans_without_odometry_near_them_are_a_warning(tmp_path: Path) -> None:
    sent = [each for each in drive(200) if each[0] != "/odom" or each[1] < 1005.0]
    finding = found(inspect_log(bag(tmp_path, sent)), Trouble.CLOCKS_APART)
    assert finding.message.startswith("40 % of the scans have no odometry within 1 s")


# ------------------------------------------------------------------ unusable logs


def test_a_log_without_scans_lists_what_it_holds(tmp_path: Path) -> None:
    sent = [each for each in drive() if each[0] != "/scan"]
    inspection = inspect_log(bag(tmp_path, sent))
    assert inspection.verdict is Verdict.UNUSABLE
    assert [stream.name for stream in inspection.streams] == ["/odom", "/tf_static"]
    finding = found(inspection, Trouble.NOTHING_USABLE)
    assert "no usable scan in 0 messages" in finding.message
    assert "record the topic of the laser" in finding.advice


def test_a_log_whose_scans_are_all_refused_names_the_reason(tmp_path: Path) -> None:
    inspection = inspect_log(bag(tmp_path, with_ranges(lambda _, r: np.full_like(r, np.nan))))
    finding = found(inspection, Trouble.NOTHING_USABLE)
    assert f"in {SCANS} messages" in finding.message
    assert "nan_ranges" in finding.message


def test_what_is_no_log_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InvalidLog, match="unknown format"):
        inspect_log(tmp_path / "drive.zip")
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InvalidLog, match="cannot read"):
        inspect_log(tmp_path / "a.bag")


# ------------------------------------------------------------------ recorded logs


@pytest.mark.parametrize(
    ("name", "preset", "scans", "path_m"),
    [
        ("2d/fr079.clf.bz2", Preset.PLANAR, 4934, 392.0),
        ("2d/malaga-one-loop.clf.gz", Preset.PLANAR, 224, 76.0),
        ("3d/imm-ring.mcap", Preset.OUTDOOR, 323, 621.0),
        ("3d/kitti00-part", Preset.OUTDOOR, 110, None),
    ],
)
def test_recorded_logs_are_usable_and_get_their_presets(
    hmt_data: Path, name: str, preset: Preset, scans: int, path_m: float | None
) -> None:
    inspection = inspect_log(hmt_data / name)
    assert (inspection.verdict, inspection.preset) == (Verdict.USABLE, preset)
    assert inspection.scans is not None
    assert inspection.scans.scans == scans
    if path_m is None:
        assert inspection.odometry is None
    else:
        assert inspection.odometry is not None
        assert inspection.odometry.path_m == pytest.approx(path_m, rel=0.02)
