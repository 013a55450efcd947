"""What robots send: foxglove messages to readings, with a reason for every refusal, and back.

A scan is a `foxglove.LaserScan` or a `foxglove.PointCloud` whose `frame_id` is the body and whose
`pose` is the pose of the sensor on the body; a cloud may carry a field `sweep_share`, the capture
time of each point as a share of the sweep. Odometry is a `foxglove.Odometry` or a
`foxglove.PoseInFrame` in the frame "odom".

References:
    foxglove schemas; ROS REP 117 (what infinite and undefined ranges mean), REP 105 (names of
    frames).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from hmt_service.core.config import SensorConfig
from hmt_service.core.geometry import (
    FloatArray,
    Pose,
    identity,
    pose_of,
    quaternion_of,
    transform_points,
)
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput
from hmt_service.service.codec import Wire, encoding_of, wire
from hmt_service.service.keys import Input

BODY_FRAMES = frozenset({"body", "base_link"})
"""Names of the body frame: ours and ROS's."""
ODOMETRY_FRAME = "odom"
"""Name of the frame that odometry drifts in."""
_SWEEP_SHARE = "sweep_share"
_NANOSECONDS = 10**9
_MAX_WRONG_SHARE = 0.5
# A range written with centimetres and rebuilt from coordinates must not fall off the end of the
# sensor.
_RANGE_TOLERANCE_M = 1e-6
# Farther than any sensor from its robot, and any robot from its start: beyond it numbers lose their
# meaning.
_MAX_SENSOR_OFFSET_M = 1e3
_MAX_ODOMETRY_M = 1e7
_FULL_TURN_RAD = 2.0 * np.pi + 1e-6
_TYPES: dict[int, str] = {
    PackedElementField.UINT8: "u1",
    PackedElementField.INT8: "i1",
    PackedElementField.UINT16: "<u2",
    PackedElementField.INT16: "<i2",
    PackedElementField.UINT32: "<u4",
    PackedElementField.INT32: "<i4",
    PackedElementField.FLOAT32: "<f4",
    PackedElementField.FLOAT64: "<f8",
}


class Refusal(StrEnum):
    """Why a sample was not taken."""

    TOO_LARGE = "too_large"
    QUEUE_FULL = "queue_full"
    STOPPING = "stopping"
    UNKNOWN_KEY = "unknown_key"
    WRONG_ENCODING = "wrong_encoding"
    NOT_PROTOBUF = "not_protobuf"
    WRONG_FRAME = "wrong_frame"
    BAD_STAMP = "bad_stamp"
    BAD_POSE = "bad_pose"
    BAD_GEOMETRY = "bad_geometry"
    EMPTY = "empty"
    NAN_RANGES = "nan_ranges"
    NEGATIVE_RANGES = "negative_ranges"
    TIME_BACKWARDS = "time_backwards"
    TIME_JUMPED = "time_jumped"


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """A reading that passed every check that needs no other reading."""

    reading: Reading
    """What the robot said."""
    dropped_beams: Mapping[Refusal, int] = field(default_factory=lambda: MappingProxyType({}))
    """Beams that are left out of it because they are wrong; those without a return are not."""


class _RefusedError(Exception):
    """Carries a reason out of the checks below; never leaves this module."""

    def __init__(self, reason: Refusal) -> None:
        super().__init__(reason)
        self.reason = reason


def decode_reading(
    name: Input, payload: bytes, encoding: str, sensor: SensorConfig
) -> Decoded | Refusal:
    """Return the reading in a sample, or why it is refused.

    Args:
        name: What the sample was sent as.
        payload: Its bytes.
        encoding: How it says that they are encoded.
        sensor: What the sensor can see; returns outside of its range count as none.
    """
    decoders = _SCAN_DECODERS if name is Input.SCAN else _ODOMETRY_DECODERS
    if encoding not in decoders:
        return Refusal.WRONG_ENCODING
    try:
        return decoders[encoding](payload, sensor)
    except DecodeError:
        return Refusal.NOT_PROTOBUF
    except _RefusedError as refused:
        return refused.reason


def encode_reading(reading: Reading) -> Wire:
    """Return a reading as it is sent: a scan as `PointCloud` of float64, odometry as `Odometry`.

    Stamps are rounded to ns. Points come back bit for bit where the sensor is at the centre of the
    body, within rounding elsewhere.

    Raises:
        InvalidInput: If the stamp is not finite.
    """
    if isinstance(reading, OdometryReading):
        return wire(
            Odometry(
                timestamp=_timestamp(reading.stamp_s),
                frame_id=ODOMETRY_FRAME,
                body_frame_id="body",
                pose=_pose_to_proto(reading.odom_from_body),
            )
        )
    body_from_sensor = identity()
    body_from_sensor[:3, 3] = reading.sensor_in_body
    columns = [reading.points_in_body - reading.sensor_in_body]
    names = ["x", "y", "z"]
    if reading.point_times is not None:
        columns.append(reading.point_times[:, None])
        names.append(_SWEEP_SHARE)
    data = np.hstack(columns, dtype="<f8")
    return wire(
        PointCloud(
            timestamp=_timestamp(reading.stamp_s),
            frame_id="body",
            pose=_pose_to_proto(body_from_sensor),
            point_stride=data.itemsize * len(names),
            fields=[
                PackedElementField(
                    name=name, offset=data.itemsize * column, type=PackedElementField.FLOAT64
                )
                for column, name in enumerate(names)
            ],
            data=data.tobytes(),
        )
    )


def _laser_scan(payload: bytes, sensor: SensorConfig) -> Decoded:
    message = LaserScan.FromString(payload)
    stamp_s = _stamp(message)
    body_from_sensor = _body_from_sensor(message)
    ranges = np.array(message.ranges)
    dropped = _wrong_beams(ranges)
    span = message.end_angle - message.start_angle
    # NaN fails every comparison, and with it the check.
    if not (abs(span) <= _FULL_TURN_RAD and abs(message.start_angle) <= 2.0 * _FULL_TURN_RAD):
        raise _RefusedError(Refusal.BAD_GEOMETRY)
    angles = message.start_angle + span * np.arange(len(ranges)) / max(1, len(ranges) - 1)
    has_return = _is_in_range(ranges, sensor)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1)
    points = ranges[has_return, None] * directions[has_return]
    points_in_body = transform_points(body_from_sensor, points)
    return Decoded(Scan(stamp_s, points_in_body, body_from_sensor[:3, 3]), dropped)


def _point_cloud(payload: bytes, sensor: SensorConfig) -> Decoded:
    message = PointCloud.FromString(payload)
    stamp_s = _stamp(message)
    body_from_sensor = _body_from_sensor(message)
    rows = _rows(message)
    points = np.zeros((len(rows), 3))
    for axis, name in enumerate("xyz"):
        if name in _names(rows):
            points[:, axis] = rows[name]
    with np.errstate(over="ignore"):
        ranges = np.linalg.norm(points, axis=1)
    # Organised clouds mark directions without a return by NaN: only a cloud of nothing else is
    # wrong.
    undefined = int(np.count_nonzero(np.isnan(ranges)))
    if undefined == len(rows):
        raise _RefusedError(Refusal.NAN_RANGES)
    has_return = _is_in_range(ranges, sensor)
    point_times = None
    if _SWEEP_SHARE in _names(rows):
        point_times = rows[_SWEEP_SHARE][has_return].astype(np.float64)
        if not np.all((point_times >= 0.0) & (point_times <= 1.0)):
            raise _RefusedError(Refusal.BAD_GEOMETRY)
    points_in_body = transform_points(body_from_sensor, points[has_return])
    scan = Scan(stamp_s, points_in_body, body_from_sensor[:3, 3], point_times)
    return Decoded(scan, {Refusal.NAN_RANGES: undefined} if undefined else {})


def _odometry(payload: bytes, _: SensorConfig) -> Decoded:
    message = Odometry.FromString(payload)
    if message.body_frame_id not in BODY_FRAMES:
        raise _RefusedError(Refusal.WRONG_FRAME)
    return _odometry_reading(message)


def _pose_in_frame(payload: bytes, _: SensorConfig) -> Decoded:
    return _odometry_reading(PoseInFrame.FromString(payload))


def _odometry_reading(message: Odometry | PoseInFrame) -> Decoded:
    stamp_s = _stamp(message)
    if message.frame_id != ODOMETRY_FRAME:
        raise _RefusedError(Refusal.WRONG_FRAME)
    if not message.HasField("pose"):
        raise _RefusedError(Refusal.BAD_POSE)
    return Decoded(OdometryReading(stamp_s, _pose(message.pose, farthest_m=_MAX_ODOMETRY_M)))


_Decoder = Callable[[bytes, SensorConfig], Decoded]
_SCAN_DECODERS: dict[str, _Decoder] = {
    encoding_of(LaserScan): _laser_scan,
    encoding_of(PointCloud): _point_cloud,
}
_ODOMETRY_DECODERS: dict[str, _Decoder] = {
    encoding_of(Odometry): _odometry,
    encoding_of(PoseInFrame): _pose_in_frame,
}


def _wrong_beams(ranges: FloatArray) -> dict[Refusal, int]:
    """Return how many beams are wrong, by reason; +inf says "no return" (REP 117) and is right."""
    if len(ranges) == 0:
        raise _RefusedError(Refusal.EMPTY)
    counts = {
        Refusal.NAN_RANGES: int(np.count_nonzero(np.isnan(ranges))),
        Refusal.NEGATIVE_RANGES: int(np.count_nonzero(ranges < 0.0)),
    }
    if sum(counts.values()) > _MAX_WRONG_SHARE * len(ranges):
        raise _RefusedError(max(counts, key=lambda reason: counts[reason]))
    return {reason: count for reason, count in counts.items() if count}


def _is_in_range(ranges: FloatArray, sensor: SensorConfig) -> npt.NDArray[np.bool_]:
    nearest = sensor.min_range_m - _RANGE_TOLERANCE_M
    farthest = sensor.max_range_m + _RANGE_TOLERANCE_M
    return (ranges >= nearest) & (ranges <= farthest)


def _rows(message: PointCloud) -> npt.NDArray[np.void]:
    """Return a cloud as a structured array, one row per point."""
    stride, fields = message.point_stride, {f.name: f for f in message.fields}
    is_consistent = (
        len(fields) == len(message.fields)
        and len(fields.keys() & {"x", "y", "z"}) >= 2
        and all(
            f.type in _TYPES and f.offset + np.dtype(_TYPES[f.type]).itemsize <= stride
            for f in message.fields
        )
        and len(message.data) % stride == 0
    )
    if not is_consistent:
        raise _RefusedError(Refusal.BAD_GEOMETRY)
    if not message.data:
        raise _RefusedError(Refusal.EMPTY)
    dtype = np.dtype(
        {
            "names": list(fields),
            "formats": [_TYPES[f.type] for f in fields.values()],
            "offsets": [f.offset for f in fields.values()],
            "itemsize": stride,
        }
    )
    return np.frombuffer(message.data, dtype=dtype)


def _names(rows: npt.NDArray[np.void]) -> tuple[str, ...]:
    return rows.dtype.names or ()


def _body_from_sensor(message: LaserScan | PointCloud) -> Pose:
    if message.frame_id not in BODY_FRAMES:
        raise _RefusedError(Refusal.WRONG_FRAME)
    if not message.HasField("pose"):
        return identity()
    return _pose(message.pose, farthest_m=_MAX_SENSOR_OFFSET_M)


def _pose(message: PoseMessage, *, farthest_m: float) -> Pose:
    p, q = message.position, message.orientation
    quaternion = [q.x, q.y, q.z, q.w] if message.HasField("orientation") else [0.0, 0.0, 0.0, 1.0]
    try:
        with np.errstate(over="ignore"):
            pose = pose_of(np.array(quaternion), np.array([p.x, p.y, p.z]))
    except InvalidInput as error:
        raise _RefusedError(Refusal.BAD_POSE) from error
    if np.abs(pose[:3, 3]).max() > farthest_m:
        raise _RefusedError(Refusal.BAD_POSE)
    return pose


def _pose_to_proto(pose: Pose) -> PoseMessage:
    qx, qy, qz, qw = quaternion_of(pose).tolist()
    x, y, z = pose[:3, 3].tolist()
    return PoseMessage(
        position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)
    )


def _stamp(message: LaserScan | PointCloud | Odometry | PoseInFrame) -> float:
    stamp = message.timestamp
    if not message.HasField("timestamp") or not 0 <= stamp.nanos < _NANOSECONDS:
        raise _RefusedError(Refusal.BAD_STAMP)
    return (stamp.seconds * _NANOSECONDS + stamp.nanos) / _NANOSECONDS


def _timestamp(stamp_s: float) -> Timestamp:
    if not math.isfinite(stamp_s):
        raise InvalidInput(f"stamp {stamp_s} s is not finite")
    whole = math.floor(stamp_s)
    # Exact: the difference of two floats so near has no rounding.
    seconds, nanos = divmod(round((stamp_s - whole) * _NANOSECONDS), _NANOSECONDS)
    return Timestamp(seconds=whole + seconds, nanos=nanos)
