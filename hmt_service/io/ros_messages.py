"""ROS messages to readings, as ROS 2 sends and records them (CDR) and as ROS 1 recorded them.

A scan is a `sensor_msgs/LaserScan` or a `sensor_msgs/PointCloud2` in the frame of its sensor,
odometry a `nav_msgs/Odometry` of a body: no message says where the one sits on the other, so the
caller does (`Frames`).

ROS stamps a planar scan at its first beam, and a cloud at its beginning or its end, as the driver
likes; a reading is stamped at its end, which the times of the beams or points tell. The unit of a
point's time follows from its type: whole numbers are ns, others s (ns where they are too large for
that), since the stamp or since the epoch.

References:
    ROS common_interfaces; laser_geometry (a return is not nearer than `range_min` and nearer than
    `range_max`); REP 105 (frames), REP 117 (ranges).
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hmt_service.core.geometry import FloatArray, Pose, identity
from hmt_service.io.decoding import (
    LONGEST_SWEEP_S,
    TIME_FIELDS,
    Decoded,
    Defect,
    DefectError,
    Returns,
    check_angles,
    check_frame,
    cloud_scan,
    odometry_reading,
    planar_scan,
    row_type,
    stamp_of,
    wrong_beams,
)

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore
    from rosbags.typesys.stores.latest import nav_msgs__msg__Odometry as Odometry
    from rosbags.typesys.stores.latest import sensor_msgs__msg__LaserScan as LaserScan
    from rosbags.typesys.stores.latest import sensor_msgs__msg__PointCloud2 as PointCloud2
    from rosbags.typesys.stores.latest import std_msgs__msg__Header as Header


class Serialization(StrEnum):
    """How the bytes of a message are laid out; the names are those that MCAP gives."""

    CDR = "cdr"
    """ROS 2."""
    ROS1 = "ros1"
    """ROS 1."""


class RosType(StrEnum):
    """Messages that hold a reading."""

    LASER_SCAN = "sensor_msgs/msg/LaserScan"
    POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
    ODOMETRY = "nav_msgs/msg/Odometry"


SCAN_TYPES = frozenset({RosType.LASER_SCAN, RosType.POINT_CLOUD})
"""Those that hold a scan."""
TRANSFORMS = "tf2_msgs/msg/TFMessage"
"""Message that says where frames are."""
_TRANSFORMS_DEFINITION = "geometry_msgs/TransformStamped[] transforms"
_STORES = {Serialization.CDR: Stores.LATEST, Serialization.ROS1: Stores.ROS1_NOETIC}
# Poses in these frames may jump (REP 105).
_WORLD_FRAMES = frozenset({"map", "earth"})
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_FLOATS = (7, 8)


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Which frames the messages of one sender are in, and where the sensor sits on the body."""

    scan: Collection[str] | None = None
    """Frames that scans may be in; None for any."""
    body: Collection[str] | None = None
    """Bodies that odometry may be of; None for any."""
    body_from_sensor: Pose = field(default_factory=identity)
    """Pose of the sensor on the body, shape (4, 4)."""


@dataclass(frozen=True, slots=True)
class _Rules:
    """What the messages of one sender are held to."""

    returns: Returns
    frames: Frames


def decode(
    kind: RosType,
    payload: bytes,
    serialization: Serialization,
    *,
    min_range_m: float,
    max_range_m: float,
    frames: Frames,
) -> Decoded | Defect:
    """Return the reading in a message, or why there is none.

    Args:
        kind: What the message is.
        payload: The message, serialised.
        serialization: How.
        min_range_m: Nearer points count as no return.
        max_range_m: Farther points count as no return.
        frames: Frames that it may be in.
    """
    rules = _Rules(Returns(min_range_m, max_range_m), frames)
    try:
        return _READERS[kind](message_of(kind, payload, serialization), rules)
    except SerdeError:
        return Defect.NOT_ROS
    except DefectError as error:
        return error.defect


def message_of(type_name: str, payload: bytes, serialization: Serialization) -> Any:
    """Return a message of any type that ROS itself defines.

    Raises:
        SerdeError: If the bytes are no such message.
    """
    store = _store(serialization)
    if serialization is Serialization.ROS1:
        return store.deserialize_ros1(payload, type_name)
    return store.deserialize_cdr(payload, type_name)


@cache
def type_hash(kind: RosType) -> str:
    """Return the hash that ROS 2 knows the definition of a message by (REP 2016)."""
    return _store(Serialization.CDR).hash_rihs01(kind)


def type_name(name: str) -> str:
    """Return the name of a message's type as ROS 2 writes it; ROS 1 leaves out the middle."""
    package, _, message = name.partition("/")
    return f"{package}/msg/{message}" if message and "/" not in message else name


def frame_name(name: str) -> str:
    """Return a frame's name without the slash that old ROS writes before it."""
    return name.removeprefix("/")


@cache
def _store(serialization: Serialization) -> Typestore:
    # When it is first needed: it takes 0.2 s to load.
    store = get_typestore(_STORES[serialization])
    if TRANSFORMS not in store.fielddefs:  # in ROS 1 it is of a package of its own
        store.register(get_types_from_msg(_TRANSFORMS_DEFINITION, TRANSFORMS))
    return store


def _laser_scan(message: LaserScan, rules: _Rules) -> Decoded:
    frame = _checked_frame(message.header, rules.frames.scan)
    stamp_s = _stamp(message.header)
    with np.errstate(invalid="ignore"):  # NaN that signals
        ranges: FloatArray = message.ranges.astype(np.float64)
    dropped = wrong_beams(ranges)
    steps: FloatArray = np.arange(len(ranges), dtype=np.float64)
    check_angles(message.angle_min, message.angle_increment * (len(ranges) - 1))
    angles = message.angle_min + message.angle_increment * steps
    has_return = rules.returns.among(ranges)
    if message.range_min > 0.0:
        has_return &= ranges >= message.range_min
    if message.range_max > 0.0:
        has_return &= ranges < message.range_max
    point_times: FloatArray | None = None
    took_s = message.time_increment * (len(ranges) - 1)
    if 0.0 < took_s <= LONGEST_SWEEP_S:
        # A laser that looks forward only is blind for the rest of its turn.
        turn_s = message.scan_time if took_s < message.scan_time <= LONGEST_SWEEP_S else took_s
        point_times = 1.0 - (took_s - message.time_increment * steps) / turn_s
        stamp_s += took_s
    body_from_sensor = rules.frames.body_from_sensor
    scan = planar_scan(stamp_s, ranges, angles, has_return, body_from_sensor, point_times)
    return Decoded(scan, frame, dropped)


def _point_cloud(message: PointCloud2, rules: _Rules) -> Decoded:
    frame = _checked_frame(message.header, rules.frames.scan)
    stamp_s = _stamp(message.header)
    rows = _rows(message)
    names = rows.dtype.names or ()
    points = np.empty((len(rows), 3))
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate("xyz"):
            points[:, axis] = rows[name]
    times = next((rows[name] for name in TIME_FIELDS if name in names), None)
    scan, dropped = cloud_scan(stamp_s, points, times, rules.returns, rules.frames.body_from_sensor)
    return Decoded(scan, frame, dropped)


def _odometry(message: Odometry, rules: _Rules) -> Decoded:
    body = frame_name(message.child_frame_id)
    check_frame(body, rules.frames.body)
    if frame_name(message.header.frame_id) in _WORLD_FRAMES:
        raise DefectError(Defect.WRONG_FRAME)
    p, q = message.pose.pose.position, message.pose.pose.orientation
    stamp_s = _stamp(message.header)
    return Decoded(odometry_reading(stamp_s, (q.x, q.y, q.z, q.w), (p.x, p.y, p.z)), body)


_READERS: dict[RosType, Callable[[Any, _Rules], Decoded]] = {
    RosType.LASER_SCAN: _laser_scan,
    RosType.POINT_CLOUD: _point_cloud,
    RosType.ODOMETRY: _odometry,
}


def _rows(message: PointCloud2) -> npt.NDArray[np.void]:
    """Return coordinates and times of a cloud as a structured array, one row per point."""
    width, height, step = message.width, message.height, message.point_step
    order = ">" if message.is_bigendian else "<"
    kinds = {number: f"{order}{kind}" for number, kind in _TYPES.items()}
    floats = {kinds[number] for number in _FLOATS}
    fields = {
        name: (kinds.get(f.datatype), f.offset)
        for name in ("x", "y", "z", *TIME_FIELDS)
        for f in message.fields
        if f.name == name
    }
    if not len(message.data):
        raise DefectError(Defect.EMPTY)
    is_consistent = (
        width * height > 0
        and fields.keys() >= {"x", "y", "z"}
        and all(fields[axis][0] in floats for axis in "xyz")
        and message.row_step >= width * step
        and (height - 1) * message.row_step + width * step <= len(message.data)
    )
    if not is_consistent:
        raise DefectError(Defect.BAD_GEOMETRY)
    data = np.ascontiguousarray(message.data)
    strides = message.row_step, step
    rows = np.ndarray((height, width), row_type(fields, step), data, strides=strides)
    return rows.reshape(-1)


def _checked_frame(header: Header, allowed: Collection[str] | None) -> str:
    frame = frame_name(header.frame_id)
    check_frame(frame, allowed)
    return frame


def _stamp(header: Header) -> float:
    stamp = header.stamp
    # ROS's way of saying that there is none.
    if stamp.sec == 0 and stamp.nanosec == 0:
        raise DefectError(Defect.BAD_STAMP)
    return stamp_of(stamp.sec, stamp.nanosec)
