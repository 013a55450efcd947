"""ROS messages: what is right becomes a reading, what is wrong has a name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import FloatArray, planar_pose
from hmt_service.core.types import OdometryReading, Scan
from hmt_service.io.decoding import Decoded, Defect
from hmt_service.io.ros_messages import Frames, RosType, Serialization, decode, type_hash, type_name
from tests.ros import BODY, SCAN_FRAME, Ros

NAN, INF = math.nan, math.inf
ROS = Ros()
CDR, ROS1 = Serialization.CDR, Serialization.ROS1


def decoded(
    message: Any, frames: Frames | None = None, serialization: Serialization = CDR
) -> Decoded | Defect:
    return decode(
        RosType(message.__msgtype__),
        Ros(serialization).serialize(message),
        serialization,
        min_range_m=0.5,
        max_range_m=30.0,
        frames=frames or Frames(),
    )


def scan_of(message: Any, frames: Frames | None = None) -> Scan:
    result = decoded(message, frames)
    assert isinstance(result, Decoded), result
    assert isinstance(result.reading, Scan)
    return result.reading


def rows(points: FloatArray, kind: str = "<f4", **times: Any) -> Any:
    """Return points as a driver lays them out, with something before and between."""
    width = np.dtype(kind).itemsize
    names = ["intensity", "x", "y", "z", *times]
    kinds = [f"{kind[0]}f4", kind, kind, kind, *(t.dtype.str for t in times.values())]
    offsets = [0, *(4 + axis * width for axis in range(3)), *range(40, 40 + 8 * len(times), 8)]
    dtype = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": 64})
    result = np.zeros(len(points), dtype)
    for axis, name in enumerate("xyz"):
        result[name] = points[:, axis]
    for name, values in times.items():
        result[name] = values
    return result


SOME = np.array([[1.0, 2.0, 3.0], [NAN, NAN, NAN], [0.1, 0.1, 0.1], [4.0, 5.0, -6.0]])
RIGHT = SOME[[0, 3]]


# ------------------------------------------------------------------ planar scans


@pytest.mark.parametrize("serialization", Serialization)
def test_a_laser_scan_becomes_points_along_its_bearings(serialization: Serialization) -> None:
    message = Ros(serialization).laser_scan([1.0, 2.0, 3.0, 4.0], stamp_s=7.25)
    result = decoded(message, serialization=serialization)
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, Scan)
    assert (result.reading.stamp_s, result.frame) == (7.25, SCAN_FRAME)
    expected = [[-1.0, 0.0, 0.0], [0.0, -2.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
    np.testing.assert_allclose(result.reading.points_in_body, expected, atol=1e-6)
    assert result.reading.point_times is None


def test_what_the_laser_itself_does_not_believe_is_no_return() -> None:
    message = ROS.laser_scan([0.7, 1.0, 20.0, INF, 0.0, 19.0], range_min=0.8, range_max=20.0)
    ranges = np.linalg.norm(scan_of(message).points_in_body, axis=1)
    np.testing.assert_allclose(ranges, [1.0, 19.0], rtol=1e-6)


def test_limits_that_are_not_set_leave_out_nothing() -> None:
    message = ROS.laser_scan([1.0, 20.0], range_min=NAN, range_max=0.0)
    assert len(scan_of(message).points_in_body) == 2


def test_wrong_beams_are_left_out_and_counted() -> None:
    result = decoded(ROS.laser_scan([1.0, NAN, -1.0, -INF, 2.0, 3.0]))
    assert isinstance(result, Decoded)
    assert result.dropped_beams == {Defect.NAN_RANGES: 1, Defect.NEGATIVE_RANGES: 2}


def test_a_laser_that_looks_forward_only_is_blind_for_the_rest_of_its_turn() -> None:
    """Three quarters of a turn of 0.04 s: the first beam is a quarter after the last scan."""
    message = ROS.laser_scan(
        [1.0, 2.0, 0.0, 4.0], stamp_s=10.0, time_increment=0.01, scan_time=0.04
    )
    scan = scan_of(message)
    assert scan.stamp_s == pytest.approx(10.03)
    assert scan.point_times is not None
    np.testing.assert_allclose(scan.point_times, [0.25, 0.5, 1.0], atol=1e-6)


def test_without_the_time_of_a_turn_the_beams_are_all_of_it() -> None:
    scan = scan_of(ROS.laser_scan([1.0] * 5, stamp_s=10.0, time_increment=0.01))
    assert scan.stamp_s == pytest.approx(10.04)
    assert scan.point_times is not None
    np.testing.assert_allclose(scan.point_times, [0.0, 0.25, 0.5, 0.75, 1.0], atol=1e-6)


@pytest.mark.parametrize("increment", [NAN, INF, -0.01, 5.0])
def test_times_that_make_no_sense_are_not_believed(increment: float) -> None:
    scan = scan_of(ROS.laser_scan([1.0] * 5, stamp_s=10.0, time_increment=increment))
    assert (scan.stamp_s, scan.point_times) == (10.0, None)


# ------------------------------------------------------------------ clouds


@pytest.mark.parametrize("serialization", Serialization)
@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f4", ">f8"])
def test_a_cloud_becomes_its_points(kind: str, serialization: Serialization) -> None:
    message = Ros(serialization).cloud(rows(SOME, kind))
    result = decoded(message, serialization=serialization)
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, Scan)
    np.testing.assert_array_equal(result.reading.points_in_body, RIGHT)
    assert result.dropped_beams == {Defect.NAN_RANGES: 1}
    assert result.reading.point_times is None


@pytest.mark.parametrize("padding", [0, 5])
def test_rows_may_be_padded(padding: int) -> None:
    message = ROS.cloud(rows(SOME), height=2, row_padding=padding)
    np.testing.assert_array_equal(scan_of(message).points_in_body, RIGHT)


SHARES = np.array([0.0, 0.3, 0.9, 1.0])
SWEEP_S = 0.1
STAMP_S = 1_700_000_000.5


@pytest.mark.parametrize(
    ("name", "times", "end_s"),
    [
        ("t", (SHARES * 1e8).astype("<u4"), SWEEP_S),
        ("offset_time", (SHARES * 1e8).astype("<u4"), SWEEP_S),
        ("time", (SHARES * SWEEP_S).astype("<f4"), SWEEP_S),
        ("time", ((SHARES - 1.0) * SWEEP_S).astype("<f4"), 0.0),
        ("timestamp", STAMP_S + SHARES * SWEEP_S, SWEEP_S),
        ("timestamp", STAMP_S + (SHARES - 1.0) * SWEEP_S, 0.0),
        ("timestamp", (STAMP_S + SHARES * SWEEP_S) * 1e9, SWEEP_S),
        ("timestamp", 12.0 + SHARES * SWEEP_S, 0.0),
    ],
)
def test_times_of_points_become_shares_of_the_sweep(
    name: str, times: FloatArray, end_s: float
) -> None:
    fields: dict[str, Any] = {name: times}
    message = ROS.cloud(rows(SOME, **fields), stamp_s=STAMP_S)
    scan = scan_of(message)
    assert scan.point_times is not None
    np.testing.assert_allclose(scan.point_times, SHARES[[0, 3]], atol=1e-5)
    assert scan.stamp_s == pytest.approx(STAMP_S + end_s, abs=1e-6)


def test_points_of_one_time_are_of_no_sweep() -> None:
    scan = scan_of(ROS.cloud(rows(SOME, time=np.zeros(4, "<f4"))))
    assert (scan.stamp_s, scan.point_times) == (5.0, None)


def test_whole_times_are_told_apart_at_the_ends_of_their_type() -> None:
    times = np.array([-128, 0, 0, 127], dtype="i1")
    scan = scan_of(ROS.cloud(rows(SOME, time=times)))
    assert scan.point_times is not None
    np.testing.assert_array_equal(scan.point_times, [0.0, 1.0])


def test_a_cloud_without_a_return_has_no_times() -> None:
    scan = scan_of(ROS.cloud(rows(np.full((3, 3), INF), time=np.full(3, NAN, "<f4"))))
    assert (scan.points_in_body.shape, scan.point_times) == ((0, 3), None)


def test_a_return_at_no_time_is_wrong() -> None:
    for wrong in (NAN, INF):
        times = np.array([0.0, 0.1, 0.1, wrong], "<f4")
        assert decoded(ROS.cloud(rows(SOME, time=times))) is Defect.BAD_GEOMETRY


def test_times_that_are_farther_apart_than_a_number_is_large_are_wrong() -> None:
    times = np.array([-1.7e308, 0.0, 0.0, 1.7e308], "<f8")
    assert decoded(ROS.cloud(rows(SOME, time=times))) is Defect.BAD_GEOMETRY


@pytest.mark.parametrize(
    "changes",
    [
        {"point_step": 15},
        {"point_step": 0},
        {"row_step": 100},
        {"width": 5},
        {"width": 0},
        {"height": 2**32 - 1, "width": 2**32 - 1},
        {"fields": []},
    ],
)
def test_a_cloud_that_contradicts_itself_is_refused(changes: dict[str, Any]) -> None:
    message = ROS.cloud(rows(SOME))
    for name, value in changes.items():
        setattr(message, name, value)
    assert decoded(message) is Defect.BAD_GEOMETRY


def test_coordinates_must_be_floats() -> None:
    message = ROS.cloud(rows(SOME))
    for datatype in (5, 99):
        message.fields[1].datatype = datatype
        assert decoded(message) is Defect.BAD_GEOMETRY


# ------------------------------------------------------------------ odometry and frames


@pytest.mark.parametrize("serialization", Serialization)
def test_odometry_is_taken(serialization: Serialization) -> None:
    pose = planar_pose(1.0, 2.0, 0.5)
    message = Ros(serialization).odometry(pose, frame="/odom_combined")
    result = decoded(message, Frames(body={BODY}), serialization)
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, OdometryReading)
    np.testing.assert_allclose(result.reading.odom_from_body, pose, atol=1e-12)
    assert result.frame == BODY


def test_the_caller_says_where_the_sensor_sits() -> None:
    frames = Frames(body_from_sensor=planar_pose(0.5, 0.0, np.pi / 2.0))
    message = ROS.laser_scan([1.0], angle_min=0.0)
    cloud = ROS.cloud(rows(np.array([[1.0, 0.0, 0.0]])))
    for scan in (scan_of(message, frames), scan_of(cloud, frames)):
        np.testing.assert_allclose(scan.points_in_body, [[0.5, 1.0, 0.0]], atol=1e-6)
        np.testing.assert_array_equal(scan.sensor_in_body, [0.5, 0.0, 0.0])


def test_a_frame_may_begin_with_a_slash() -> None:
    result = decoded(ROS.laser_scan([1.0], frame="/base_scan"), Frames(scan={SCAN_FRAME}))
    assert isinstance(result, Decoded)
    assert result.frame == SCAN_FRAME


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (ROS.laser_scan([1.0], frame="rear"), Defect.WRONG_FRAME),
        (ROS.cloud(rows(SOME), frame="rear"), Defect.WRONG_FRAME),
        (ROS.odometry(np.eye(4), body="trailer"), Defect.WRONG_FRAME),
        (ROS.odometry(np.eye(4), frame="map"), Defect.WRONG_FRAME),
        (ROS.odometry(planar_pose(NAN, 0.0, 0.0)), Defect.BAD_POSE),
        (ROS.odometry(planar_pose(1e9, 0.0, 0.0)), Defect.BAD_POSE),
        (ROS.laser_scan([1.0], stamp_s=0.0), Defect.BAD_STAMP),
        (ROS.laser_scan([]), Defect.EMPTY),
        (ROS.laser_scan([NAN] * 3), Defect.NAN_RANGES),
        (ROS.laser_scan([-1.0] * 3), Defect.NEGATIVE_RANGES),
        (ROS.laser_scan([1.0] * 9, angle_increment=1.0), Defect.BAD_GEOMETRY),
        (ROS.laser_scan([1.0], angle_min=NAN), Defect.BAD_GEOMETRY),
        (ROS.cloud(rows(np.full((4, 3), NAN))), Defect.NAN_RANGES),
        (ROS.cloud(rows(SOME[:0])), Defect.EMPTY),
    ],
)
def test_what_is_wrong_has_a_name(message: Any, reason: Defect) -> None:
    assert decoded(message, Frames(scan={SCAN_FRAME}, body={BODY})) is reason


def test_a_stamp_of_too_many_nanoseconds_is_wrong() -> None:
    message = ROS.laser_scan([1.0])
    message.header.stamp.nanosec = 10**9
    assert decoded(message) is Defect.BAD_STAMP


def test_types_are_known_by_both_names_and_by_hash() -> None:
    assert type_name("sensor_msgs/LaserScan") == type_name(RosType.LASER_SCAN) == RosType.LASER_SCAN
    assert type_name("foxglove.LaserScan") == "foxglove.LaserScan"
    # As every ROS 2 since Iron has it.
    digest = "64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"
    assert type_hash(RosType.LASER_SCAN) == f"RIHS01_{digest}"


# ------------------------------------------------------------------ anything else

MESSAGES = [
    ROS.laser_scan([1.0, 2.0, 3.0, NAN] * 3, time_increment=0.01),
    ROS.cloud(rows(SOME, "<f8", t=(SHARES * 1e8).astype("<u4"), time=SHARES)),
    ROS.cloud(rows(SOME, ">f4"), height=2, row_padding=3),
    ROS.odometry(planar_pose(1.0, 2.0, 0.5)),
]


def check_any(kind: RosType, payload: bytes, serialization: Serialization) -> None:
    """Whatever the bytes are, there is a reading of finite numbers, or a reason why not."""
    result = decode(
        kind, payload, serialization, min_range_m=0.5, max_range_m=30.0, frames=Frames()
    )
    if not isinstance(result, Decoded):
        assert isinstance(result, Defect)
        return
    assert math.isfinite(result.reading.stamp_s)
    if isinstance(result.reading, OdometryReading):
        assert np.all(np.isfinite(result.reading.odom_from_body))
        return
    scan = result.reading
    ranges = np.linalg.norm(scan.points_in_body, axis=1)
    assert np.all((ranges > 0.4) & (ranges < 30.1))
    if scan.point_times is not None:
        assert scan.point_times.shape == ranges.shape
        assert np.all((scan.point_times >= 0.0) & (scan.point_times <= 1.0))


@given(st.sampled_from(RosType), st.sampled_from(Serialization), st.binary(max_size=600))
def test_random_bytes_are_no_message(
    kind: RosType, serialization: Serialization, content: bytes
) -> None:
    check_any(kind, content, serialization)
    check_any(kind, b"\x00\x01\x00\x00" + content, serialization)


@given(st.sampled_from(RosType), st.sampled_from(MESSAGES), st.data())
def test_no_damage_to_a_message_goes_through_unnoticed_or_unnamed(
    kind: RosType, message: Any, data: st.DataObject
) -> None:
    content = bytearray(ROS.serialize(message))
    for _ in range(data.draw(st.integers(0, 5))):
        bit = data.draw(st.integers(0, 8 * len(content) - 1))
        content[bit // 8] ^= 1 << bit % 8
    end = data.draw(st.just(len(content)) | st.integers(0, len(content)))
    told = data.draw(st.sampled_from([kind, RosType(message.__msgtype__)]))
    check_any(told, bytes(content[:end]), CDR)


@pytest.mark.parametrize("message", MESSAGES)
def test_a_truncated_message_is_no_message(message: Any) -> None:
    content = ROS.serialize(message)
    for end in range(len(content) - 4):
        result = decode(
            RosType(message.__msgtype__),
            content[:end],
            CDR,
            min_range_m=0.5,
            max_range_m=30.0,
            frames=Frames(),
        )
        assert result is Defect.NOT_ROS
