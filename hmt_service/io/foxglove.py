"""What robots send and record: foxglove messages to readings, with what is wrong, and back.

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
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

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
from google.protobuf.message import DecodeError, Message
from google.protobuf.timestamp_pb2 import Timestamp

from hmt_service.core.geometry import Pose, identity, quaternion_of, transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput
from hmt_service.io.decoding import (
    BODY_FRAMES,
    MAX_SENSOR_OFFSET_M,
    NANOSECONDS,
    Decoded,
    Defect,
    DefectError,
    Returns,
    check_angles,
    check_frame,
    checked_pose,
    odometry_reading,
    planar_scan,
    ranges_of,
    row_type,
    stamp_of,
    wrong_beams,
)

ODOMETRY_FRAME = "odom"
"""Name of the frame that odometry drifts in."""
_SWEEP_SHARE = "sweep_share"
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
_FLOATS = {4: PackedElementField.FLOAT32, 8: PackedElementField.FLOAT64}


@dataclass(frozen=True, slots=True)
class _Rules:
    """What the messages of one sender are held to."""

    returns: Returns
    body_frames: Collection[str] | None


def decode(
    schema: str,
    payload: bytes,
    *,
    min_range_m: float,
    max_range_m: float,
    body_frames: Collection[str] | None = BODY_FRAMES,
) -> Decoded | Defect:
    """Return the reading in a message, or why there is none.

    Args:
        schema: Full name of the message, one of `SCAN_SCHEMAS` or `ODOMETRY_SCHEMAS`.
        payload: The message, serialised.
        min_range_m: Nearer points count as no return.
        max_range_m: Farther points count as no return.
        body_frames: Names that the body may have; None for any.
    """
    message_type, read = _READERS[schema]
    try:
        return read(
            message_type.FromString(payload),
            _Rules(Returns(min_range_m, max_range_m), body_frames),
        )
    except DecodeError:
        return Defect.NOT_PROTOBUF
    except DefectError as error:
        return error.defect


def encode(
    reading: Reading, numbers: type[np.float64 | np.float32] = np.float64
) -> PointCloud | Odometry:
    """Return a reading as a message: a scan as `PointCloud`, odometry as `Odometry`.

    Stamps are rounded to ns. With float64, points come back bit for bit where the sensor is at the
    centre of the body, within rounding elsewhere.

    Args:
        reading: What to encode.
        numbers: Type of the coordinates, which count from the sensor, and of the times.

    Raises:
        InvalidInput: If the stamp is not finite.
    """
    if isinstance(reading, OdometryReading):
        return Odometry(
            timestamp=timestamp_of(reading.stamp_s),
            frame_id=ODOMETRY_FRAME,
            body_frame_id="body",
            pose=pose_message(reading.odom_from_body),
        )
    body_from_sensor = identity()
    body_from_sensor[:3, 3] = reading.sensor_in_body
    names = ["x", "y", "z"] if reading.point_times is None else ["x", "y", "z", _SWEEP_SHARE]
    points = len(reading.points_in_body)
    # A cloud of nothing is a broken sensor's; a scan without a return is a direction without one.
    data = np.full((max(1, points), len(names)), np.inf, np.dtype(numbers).newbyteorder("<"))
    for axis in range(3):  # one after the other takes a quarter of the time
        data[:points, axis] = reading.points_in_body[:, axis] - reading.sensor_in_body[axis]
    if reading.point_times is not None:
        data[:points, 3] = reading.point_times
    return cloud_message(reading.stamp_s, "body", data, body_from_sensor, names)


def cloud_message(
    stamp_s: float,
    frame: str,
    rows: npt.NDArray[np.floating],
    frame_from_points: Pose | None = None,
    names: Sequence[str] = ("x", "y", "z"),
) -> PointCloud:
    """Return points as a message.

    Args:
        stamp_s: Stamp; rounded to ns.
        frame: Name of the frame.
        rows: One row per point, little-endian, shape (N, len(names)), m.
        frame_from_points: Pose of the points' own origin in it; None for the identity.
        names: What the columns are.

    Raises:
        InvalidInput: If the stamp is not finite.
    """
    return PointCloud(
        timestamp=timestamp_of(stamp_s),
        frame_id=frame,
        pose=pose_message(identity() if frame_from_points is None else frame_from_points),
        point_stride=rows.itemsize * len(names),
        fields=[
            PackedElementField(
                name=name, offset=rows.itemsize * column, type=_FLOATS[rows.itemsize]
            )
            for column, name in enumerate(names)
        ],
        data=rows.tobytes(),
    )


def _laser_scan(message: LaserScan, rules: _Rules) -> Decoded:
    stamp_s = _stamp(message)
    body_from_sensor = _body_from_sensor(message, rules)
    ranges = np.array(message.ranges)
    dropped = wrong_beams(ranges)
    span = message.end_angle - message.start_angle
    check_angles(message.start_angle, span)
    angles = message.start_angle + span * np.arange(len(ranges)) / max(1, len(ranges) - 1)
    has_return = rules.returns.among(ranges)
    scan = planar_scan(stamp_s, ranges, angles, has_return, body_from_sensor)
    return Decoded(scan, message.frame_id, dropped)


def _point_cloud(message: PointCloud, rules: _Rules) -> Decoded:
    stamp_s = _stamp(message)
    body_from_sensor = _body_from_sensor(message, rules)
    rows = _rows(message)
    points = np.zeros((len(rows), 3))
    # Huge numbers, and NaN that signal.
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate("xyz"):
            if name in _names(rows):
                points[:, axis] = rows[name]
    ranges, dropped = ranges_of(points)
    has_return = rules.returns.among(ranges)
    point_times = None
    if _SWEEP_SHARE in _names(rows):
        point_times = rows[_SWEEP_SHARE][has_return].astype(np.float64)
        if not np.all((point_times >= 0.0) & (point_times <= 1.0)):
            raise DefectError(Defect.BAD_GEOMETRY)
    points_in_body = transform_points(body_from_sensor, points[has_return])
    scan = Scan(stamp_s, points_in_body, body_from_sensor[:3, 3], point_times)
    return Decoded(scan, message.frame_id, dropped)


def _odometry(message: Odometry, rules: _Rules) -> Decoded:
    check_frame(message.body_frame_id, rules.body_frames)
    return Decoded(_odometry_reading(message), message.body_frame_id)


def _pose_in_frame(message: PoseInFrame, _: _Rules) -> Decoded:
    return Decoded(_odometry_reading(message))


def _odometry_reading(message: Odometry | PoseInFrame) -> OdometryReading:
    stamp_s = _stamp(message)
    if message.frame_id != ODOMETRY_FRAME:
        raise DefectError(Defect.WRONG_FRAME)
    if not message.HasField("pose"):
        raise DefectError(Defect.BAD_POSE)
    return odometry_reading(stamp_s, _quaternion(message.pose), _position(message.pose))


_Reader = tuple[type[Message], Callable[[Any, _Rules], Decoded]]
_SCANS: dict[str, _Reader] = {
    LaserScan.DESCRIPTOR.full_name: (LaserScan, _laser_scan),
    PointCloud.DESCRIPTOR.full_name: (PointCloud, _point_cloud),
}
_ODOMETRY: dict[str, _Reader] = {
    Odometry.DESCRIPTOR.full_name: (Odometry, _odometry),
    PoseInFrame.DESCRIPTOR.full_name: (PoseInFrame, _pose_in_frame),
}
_READERS = _SCANS | _ODOMETRY
SCAN_SCHEMAS = frozenset(_SCANS)
"""Full names of the messages that hold a scan."""
ODOMETRY_SCHEMAS = frozenset(_ODOMETRY)
"""Full names of the messages that hold odometry."""


def _rows(message: PointCloud) -> npt.NDArray[np.void]:
    """Return a cloud as a structured array, one row per point."""
    stride, fields = message.point_stride, {f.name: f for f in message.fields}
    is_consistent = len(fields) == len(message.fields) and len(fields.keys() & {"x", "y", "z"}) >= 2
    if not is_consistent:
        raise DefectError(Defect.BAD_GEOMETRY)
    rows = row_type({f.name: (_TYPES.get(f.type), f.offset) for f in message.fields}, stride)
    if len(message.data) % stride:
        raise DefectError(Defect.BAD_GEOMETRY)
    if not message.data:
        raise DefectError(Defect.EMPTY)
    return np.frombuffer(message.data, dtype=rows)


def _names(rows: npt.NDArray[np.void]) -> tuple[str, ...]:
    return rows.dtype.names or ()


def _body_from_sensor(message: LaserScan | PointCloud, rules: _Rules) -> Pose:
    check_frame(message.frame_id, rules.body_frames)
    if not message.HasField("pose"):
        return identity()
    return checked_pose(
        _quaternion(message.pose), _position(message.pose), farthest_m=MAX_SENSOR_OFFSET_M
    )


def _quaternion(message: PoseMessage) -> tuple[float, float, float, float]:
    q = message.orientation
    return (q.x, q.y, q.z, q.w) if message.HasField("orientation") else (0.0, 0.0, 0.0, 1.0)


def _position(message: PoseMessage) -> tuple[float, float, float]:
    p = message.position
    return p.x, p.y, p.z


def pose_message(pose: Pose) -> PoseMessage:
    """Return a pose as a message."""
    qx, qy, qz, qw = quaternion_of(pose).tolist()
    x, y, z = pose[:3, 3].tolist()
    return PoseMessage(
        position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)
    )


def _stamp(message: LaserScan | PointCloud | Odometry | PoseInFrame) -> float:
    if not message.HasField("timestamp"):
        raise DefectError(Defect.BAD_STAMP)
    return stamp_of(message.timestamp.seconds, message.timestamp.nanos)


def timestamp_of(stamp_s: float) -> Timestamp:
    """Return a stamp as a message, rounded to ns.

    Raises:
        InvalidInput: If it is not finite.
    """
    if not math.isfinite(stamp_s):
        raise InvalidInput(f"stamp {stamp_s} s is not finite")
    whole = math.floor(stamp_s)
    # Exact: the difference of two floats so near has no rounding.
    seconds, nanos = divmod(round((stamp_s - whole) * NANOSECONDS), NANOSECONDS)
    return Timestamp(seconds=whole + seconds, nanos=nanos)
