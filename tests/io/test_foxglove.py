from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import FloatArray, planar_pose
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput
from hmt_service.io.decoding import Decoded, Defect
from hmt_service.io.foxglove import ODOMETRY_SCHEMAS, SCAN_SCHEMAS, decode, encode
from tests.messages import cloud, laser_scan, odometry

NAN, INF = math.nan, math.inf


def decoded(message: Message, **changes: Any) -> Decoded | Defect:
    limits = {"min_range_m": 0.5, "max_range_m": 30.0} | changes
    return decode(message.DESCRIPTOR.full_name, message.SerializeToString(), **limits)


def scan_of(message: Message) -> Scan:
    result = decoded(message)
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, Scan)
    return result.reading


def there_and_back(reading: Reading, **changes: Any) -> Reading:
    result = decoded(encode(reading), **changes)
    assert isinstance(result, Decoded)
    return result.reading


def changed(message: Message, **changes: object) -> Message:
    for name, value in changes.items():
        setattr(message, name, value)
    return message


# ------------------------------------------------------------------ what is right


def test_a_laser_scan_becomes_points_along_its_bearings() -> None:
    message = laser_scan([1.0, 2.0, 3.0, 4.0], stamp_s=7.25)
    scan = scan_of(message)
    assert scan.stamp_s == 7.25
    expected = [[-1.0, 0.0, 0.0], [0.0, -2.0, 0.0], [3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]
    np.testing.assert_allclose(scan.points_in_body, expected, atol=1e-12)
    np.testing.assert_array_equal(scan.sensor_in_body, np.zeros(3))


def test_the_pose_of_a_laser_is_where_its_rays_start() -> None:
    message = laser_scan([1.0], stamp_s=1.0)
    message.start_angle = message.end_angle = 0.0
    half = math.sqrt(0.5)
    message.pose.CopyFrom(
        PoseMessage(position=Vector3(x=0.5, z=0.2), orientation=Quaternion(z=half, w=half))
    )
    scan = scan_of(message)
    np.testing.assert_allclose(scan.points_in_body, [[0.5, 1.0, 0.2]], atol=1e-12)
    np.testing.assert_allclose(scan.sensor_in_body, [0.5, 0.0, 0.2], atol=1e-12)


def test_beams_without_return_are_left_out_silently() -> None:
    result = decoded(laser_scan([1.0, INF, 31.0, 0.4, 0.0, INF]))
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, Scan)
    assert len(result.reading.points_in_body) == 1
    assert result.dropped_beams == {}


def test_a_scan_that_sees_nothing_is_a_scan() -> None:
    assert scan_of(laser_scan([INF] * 8)).points_in_body.shape == (0, 3)


def test_wrong_beams_are_left_out_and_counted() -> None:
    result = decoded(laser_scan([1.0, NAN, -1.0, -INF, 2.0, 3.0]))
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, Scan)
    assert len(result.reading.points_in_body) == 3
    assert result.dropped_beams == {Defect.NAN_RANGES: 1, Defect.NEGATIVE_RANGES: 2}


@pytest.mark.parametrize("dtype", ["<f4", "<f8"])
def test_a_cloud_becomes_its_points(dtype: str) -> None:
    points = np.array([[1.0, 2.0, 3.0], [0.1, 0.1, 0.1], [40.0, 0.0, 0.0], [4.0, 5.0, 6.0]])
    scan = scan_of(cloud(points, dtype))
    np.testing.assert_array_equal(scan.points_in_body, points[[0, 3]])
    assert scan.stamp_s == 5.0


def test_an_organised_cloud_may_mark_most_directions_as_empty() -> None:
    points = np.full((10, 3), NAN)
    points[4] = 1.0, 1.0, 1.0
    result = decoded(cloud(points))
    assert isinstance(result, Decoded)
    assert result.dropped_beams == {Defect.NAN_RANGES: 9}


def test_a_cloud_of_two_coordinates_is_flat() -> None:
    message = cloud(np.array([[1.0, 2.0, 9.0]]))
    del message.fields[2]
    np.testing.assert_array_equal(scan_of(message).points_in_body, [[1.0, 2.0, 0.0]])


def test_coordinates_beyond_float_are_no_return() -> None:
    points = np.array([[1e200, 1e200, 0.0], [1.0, 1.0, 1.0], [INF, 0.0, 0.0]])
    assert len(scan_of(cloud(points, "<f8")).points_in_body) == 1


def test_a_coordinate_that_signals_nan_is_as_wrong_as_any_other() -> None:
    message = cloud(np.ones((2, 3)))
    message.data = b"\x01\x00\x80\x7f" + message.data[4:]
    result = decoded(message)
    assert isinstance(result, Decoded)
    assert result.dropped_beams == {Defect.NAN_RANGES: 1}


def test_odometry_is_taken_in_both_forms() -> None:
    pose = PoseMessage(position=Vector3(x=1.0), orientation=Quaternion(w=1.0))
    plain = PoseInFrame(timestamp=Timestamp(seconds=5), frame_id="odom", pose=pose)
    for message in (odometry(), plain):
        result = decoded(message)
        assert isinstance(result, Decoded)
        assert isinstance(result.reading, OdometryReading)
        np.testing.assert_array_equal(result.reading.odom_from_body, planar_pose(1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "message",
    [changed(cloud(np.ones((1, 3))), frame_id="lidar"), changed(odometry(), body_frame_id="lidar")],
)
def test_a_log_may_call_the_body_as_it_likes(message: Message) -> None:
    assert decoded(message) is Defect.WRONG_FRAME
    assert decoded(message, body_frames={"laser"}) is Defect.WRONG_FRAME
    for names in (None, {"lidar"}):
        result = decoded(message, body_frames=names)
        assert isinstance(result, Decoded)
        assert result.frame == "lidar"


# ------------------------------------------------------------------ there and back


stamps = st.floats(-1e10, 1e10)
coordinates = st.floats(-15.0, 15.0)
point_lists = st.lists(
    st.tuples(coordinates, coordinates, coordinates).filter(lambda p: np.linalg.norm(p) > 0.51),
    min_size=1,
    max_size=6,
).map(np.array)


@given(stamps, point_lists)
def test_scans_of_a_central_sensor_come_back_bit_for_bit(
    stamp_s: float, points: FloatArray
) -> None:
    back = there_and_back(Scan(stamp_s, points, np.zeros(3)))
    assert isinstance(back, Scan)
    assert abs(back.stamp_s - stamp_s) <= 0.5e-9
    np.testing.assert_array_equal(back.points_in_body, points)


@given(point_lists, st.tuples(coordinates, coordinates, coordinates).map(np.array))
def test_scans_of_any_sensor_come_back_within_rounding(
    points: FloatArray, sensor_in_body: FloatArray
) -> None:
    times = np.linspace(0.0, 1.0, len(points))
    scan = Scan(1.0, points, sensor_in_body, times)
    back = there_and_back(scan, min_range_m=0.0, max_range_m=1e3)
    assert isinstance(back, Scan)
    np.testing.assert_allclose(back.points_in_body, points, rtol=0.0, atol=1e-13)
    np.testing.assert_array_equal(back.sensor_in_body, sensor_in_body)
    np.testing.assert_array_equal(back.point_times, times)


@given(st.integers(0, 2**31), st.integers(0, 999_999))
def test_stamps_of_today_with_microseconds_come_back_bit_for_bit(
    seconds: int, microseconds: int
) -> None:
    stamp_s = float(f"{seconds}.{microseconds:06d}")
    back = there_and_back(OdometryReading(stamp_s, planar_pose(0.0, 0.0, 0.0)))
    assert back.stamp_s == stamp_s


@given(coordinates, coordinates, st.floats(-3.14, 3.14))
def test_odometry_comes_back_within_rounding(x: float, y: float, yaw: float) -> None:
    pose = planar_pose(x, y, yaw)
    back = there_and_back(OdometryReading(1.0, pose))
    assert isinstance(back, OdometryReading)
    np.testing.assert_allclose(back.odom_from_body, pose, rtol=0.0, atol=1e-14)


def test_a_range_at_the_limit_survives_the_detour_over_coordinates() -> None:
    angles = np.linspace(0.0, 6.0, 500)
    points = 30.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(500)], axis=1)
    back = there_and_back(Scan(1.0, points, np.zeros(3)))
    assert isinstance(back, Scan)
    assert len(back.points_in_body) == 500


@given(point_lists)
def test_scans_in_float32_come_back_as_float32(points: FloatArray) -> None:
    times = np.arange(len(points)) / 8.0
    back = decoded(encode(Scan(1.0, points, np.zeros(3), times), np.float32))
    assert isinstance(back, Decoded)
    assert isinstance(back.reading, Scan)
    np.testing.assert_array_equal(back.reading.points_in_body, points.astype(np.float32))
    np.testing.assert_array_equal(back.reading.point_times, times)


@pytest.mark.parametrize("times", [None, np.zeros(0)])
def test_a_scan_that_sees_nothing_comes_back(times: FloatArray | None) -> None:
    back = there_and_back(Scan(1.0, np.zeros((0, 3)), np.array([0.1, 0.0, 0.3]), times))
    assert isinstance(back, Scan)
    assert back.points_in_body.shape == (0, 3)


def test_a_stamp_that_is_no_number_cannot_be_sent() -> None:
    with pytest.raises(InvalidInput, match="nan"):
        encode(Scan(NAN, np.zeros((0, 3)), np.zeros(3)))


# ------------------------------------------------------------------ what is wrong


def without(message: Message, field: str) -> Message:
    message.ClearField(field)
    return message


def stamped(nanos: int) -> Message:
    message = laser_scan([1.0])
    message.timestamp.nanos = nanos
    return message


def posed(pose: PoseMessage) -> Message:
    message = laser_scan([1.0])
    message.pose.CopyFrom(pose)
    return message


def with_twin_field() -> Message:
    message = cloud(np.ones((2, 3)))
    message.fields[1].name = "x"
    return message


def with_sweep_share(share: float) -> Message:
    message = cloud(np.array([[1.0, 1.0, share]]))
    message.fields[2].name = "sweep_share"
    return message


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: laser_scan([]), Defect.EMPTY),
        (lambda: laser_scan([NAN, NAN, 1.0]), Defect.NAN_RANGES),
        (lambda: laser_scan([-1.0, -INF, 1.0]), Defect.NEGATIVE_RANGES),
        (lambda: laser_scan([-1.0, NAN, NAN, 1.0, 2.0]), Defect.NAN_RANGES),
        (lambda: changed(laser_scan([1.0]), frame_id="laser"), Defect.WRONG_FRAME),
        (lambda: changed(laser_scan([1.0]), frame_id=""), Defect.WRONG_FRAME),
        (lambda: changed(laser_scan([1.0, 1.0]), start_angle=NAN), Defect.BAD_GEOMETRY),
        (lambda: changed(laser_scan([1.0, 1.0]), end_angle=INF), Defect.BAD_GEOMETRY),
        (lambda: changed(laser_scan([1.0, 1.0]), end_angle=9.0), Defect.BAD_GEOMETRY),
        (lambda: changed(laser_scan([1.0]), start_angle=1e300), Defect.BAD_GEOMETRY),
        (lambda: without(laser_scan([1.0]), "timestamp"), Defect.BAD_STAMP),
        (lambda: stamped(-1), Defect.BAD_STAMP),
        (lambda: stamped(10**9), Defect.BAD_STAMP),
        (lambda: posed(PoseMessage(position=Vector3(x=NAN))), Defect.BAD_POSE),
        (lambda: posed(PoseMessage(position=Vector3(z=-1e300))), Defect.BAD_POSE),
        (lambda: posed(PoseMessage(orientation=Quaternion())), Defect.BAD_POSE),
        (lambda: posed(PoseMessage(orientation=Quaternion(x=1e300, w=1e300))), Defect.BAD_POSE),
        (lambda: cloud(np.zeros((0, 3))), Defect.EMPTY),
        (lambda: cloud(np.full((3, 3), NAN)), Defect.NAN_RANGES),
        (lambda: changed(cloud(np.ones((2, 3))), point_stride=0), Defect.BAD_GEOMETRY),
        (lambda: changed(cloud(np.ones((2, 3))), point_stride=8), Defect.BAD_GEOMETRY),
        (lambda: changed(cloud(np.ones((2, 3))), data=b"12345"), Defect.BAD_GEOMETRY),
        (lambda: without(cloud(np.ones((2, 3))), "fields"), Defect.BAD_GEOMETRY),
        (with_twin_field, Defect.BAD_GEOMETRY),
        (lambda: with_sweep_share(1.5), Defect.BAD_GEOMETRY),
        (lambda: with_sweep_share(NAN), Defect.BAD_GEOMETRY),
    ],
)
def test_a_wrong_scan_is_refused_with_the_reason(
    build: Callable[[], Message], reason: Defect
) -> None:
    assert decoded(build()) is reason


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (changed(odometry(), frame_id="map"), Defect.WRONG_FRAME),
        (changed(odometry(), body_frame_id="wheel"), Defect.WRONG_FRAME),
        (without(odometry(), "pose"), Defect.BAD_POSE),
        (odometry(x_m=1e8), Defect.BAD_POSE),
        (without(odometry(), "timestamp"), Defect.BAD_STAMP),
    ],
)
def test_wrong_odometry_is_refused_with_the_reason(message: Message, reason: Defect) -> None:
    assert decoded(message) is reason


def test_a_truncated_message_is_refused() -> None:
    payload = laser_scan([1.0] * 20).SerializeToString()[:-3]
    schema = LaserScan.DESCRIPTOR.full_name
    assert decode(schema, payload, min_range_m=0.0, max_range_m=1.0) is Defect.NOT_PROTOBUF


@given(st.binary(max_size=300), st.sampled_from([*SCAN_SCHEMAS, *ODOMETRY_SCHEMAS]))
def test_any_bytes_are_a_reading_or_a_defect(payload: bytes, schema: str) -> None:
    result = decode(schema, payload, min_range_m=0.0, max_range_m=1.0)
    assert isinstance(result, Decoded | Defect)


@given(st.data())
def test_a_damaged_message_is_a_reading_or_a_defect(data: st.DataObject) -> None:
    message = data.draw(st.sampled_from([laser_scan([1.0] * 5), cloud(np.ones((3, 3)))]))
    payload = bytearray(message.SerializeToString())
    for _ in range(data.draw(st.integers(1, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    schema = message.DESCRIPTOR.full_name
    result = decode(schema, bytes(payload), min_range_m=0.0, max_range_m=1.0)
    assert isinstance(result, Decoded | Defect)
