"""What every message of a robot is held to before it is a reading, whatever its format.

References:
    ROS REP 117 (what infinite and undefined ranges mean), REP 105 (names of frames).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray, Pose, pose_of, transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput

BODY_FRAMES = frozenset({"body", "base_link"})
"""Names of the body frame: ours and ROS's."""
MAX_SENSOR_OFFSET_M = 1e3
"""Farther than any sensor from its robot: beyond it numbers lose their meaning."""
NANOSECONDS = 10**9
"""Of a second."""
TIME_FIELDS = ("t", "time", "timestamp", "offset_time")
"""What drivers call the capture time of a point; the first of them is taken."""
LONGEST_SWEEP_S = 1.0
"""Times that say more than this are in a unit or of a clock that nobody knows."""
_SINCE_EPOCH_S = 1e8  # larger times count from an epoch, not from the stamp
_LARGEST_S = 1e12  # larger times are ns
_MAX_ODOMETRY_M = 1e7  # the same of any robot from its start
_MAX_WRONG_SHARE = 0.5
# A range written with centimetres and rebuilt from coordinates must not fall off the end of the
# sensor.
_RANGE_TOLERANCE_M = 1e-6
_FULL_TURN_RAD = 2.0 * np.pi + 1e-6


class Defect(StrEnum):
    """Why a message is no reading, or a reading does not fit those before it."""

    NOT_PROTOBUF = "not_protobuf"
    NOT_ROS = "not_ros"
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
    frame: str | None = None
    """Frame that the message is of: a scan's own, the body of odometry; None where it does not
    say."""
    dropped_beams: Mapping[Defect, int] = field(default_factory=lambda: MappingProxyType({}))
    """Beams that are left out of it because they are wrong; those without a return are not."""


class DefectError(Exception):
    """Carries a defect out of the checks below to the decoder that asked for them."""

    def __init__(self, defect: Defect) -> None:
        super().__init__(defect)
        self.defect = defect


@dataclass(frozen=True, slots=True)
class Returns:
    """Which points of a scan are returns."""

    min_range_m: float
    """Nearer points count as no return."""
    max_range_m: float
    """Farther points count as no return."""

    def among(self, ranges: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which of these ranges are returns, shape as given; NaN is none."""
        nearest = self.min_range_m - _RANGE_TOLERANCE_M
        farthest = self.max_range_m + _RANGE_TOLERANCE_M
        return (ranges >= nearest) & (ranges <= farthest)


def names_of_body(frame: str) -> Collection[str]:
    """Return what else a body of this name may be called by the same sender."""
    return BODY_FRAMES if frame in BODY_FRAMES else {frame}


def check_frame(frame: str, allowed: Collection[str] | None) -> None:
    """Check that a message is of one of these frames; None allows any.

    Raises:
        DefectError: If it is of another.
    """
    if allowed is not None and frame not in allowed:
        raise DefectError(Defect.WRONG_FRAME)


def stamp_of(seconds: int, nanoseconds: int) -> float:
    """Return a stamp in s.

    Raises:
        DefectError: If the nanoseconds are a second or more, or negative.
    """
    if not 0 <= nanoseconds < NANOSECONDS:
        raise DefectError(Defect.BAD_STAMP)
    return (seconds * NANOSECONDS + nanoseconds) / NANOSECONDS


def checked_pose(
    quaternion: tuple[float, float, float, float],
    translation_m: tuple[float, float, float],
    *,
    farthest_m: float,
) -> Pose:
    """Return a pose of a message.

    Args:
        quaternion: x, y, z, w; of any length but 0.
        translation_m: x, y, z.
        farthest_m: Largest coordinate that makes sense.

    Raises:
        DefectError: If it is no pose, or too far away.
    """
    try:
        with np.errstate(over="ignore"):
            pose = pose_of(np.array(quaternion), np.array(translation_m))
    except InvalidInput as error:
        raise DefectError(Defect.BAD_POSE) from error
    if np.abs(pose[:3, 3]).max() > farthest_m:
        raise DefectError(Defect.BAD_POSE)
    return pose


def odometry_reading(
    stamp_s: float,
    quaternion: tuple[float, float, float, float],
    translation_m: tuple[float, float, float],
) -> OdometryReading:
    """Return what odometry says, see `checked_pose`.

    Raises:
        DefectError: If it is no pose, or farther away than any robot comes.
    """
    pose = checked_pose(quaternion, translation_m, farthest_m=_MAX_ODOMETRY_M)
    return OdometryReading(stamp_s, pose)


def check_angles(start_rad: float, span_rad: float) -> None:
    """Check where the beams of a planar scan begin and end.

    Raises:
        DefectError: If they turn more than once, or these are no angles.
    """
    # NaN fails every comparison, and with it the check.
    if not (abs(span_rad) <= _FULL_TURN_RAD and abs(start_rad) <= 2.0 * _FULL_TURN_RAD):
        raise DefectError(Defect.BAD_GEOMETRY)


def wrong_beams(ranges: FloatArray) -> dict[Defect, int]:
    """Return how many beams are wrong, by reason; +inf says "no return" (REP 117) and is right.

    Raises:
        DefectError: If there is none, or most are wrong.
    """
    if len(ranges) == 0:
        raise DefectError(Defect.EMPTY)
    counts = {
        Defect.NAN_RANGES: int(np.count_nonzero(np.isnan(ranges))),
        Defect.NEGATIVE_RANGES: int(np.count_nonzero(ranges < 0.0)),
    }
    if sum(counts.values()) > _MAX_WRONG_SHARE * len(ranges):
        raise DefectError(max(counts, key=lambda reason: counts[reason]))
    return {reason: count for reason, count in counts.items() if count}


def planar_scan(
    stamp_s: float,
    ranges: FloatArray,
    angles_rad: FloatArray,
    has_return: npt.NDArray[np.bool_],
    body_from_sensor: Pose,
    point_times: FloatArray | None = None,
) -> Scan:
    """Return the scan of a planar laser.

    Args:
        stamp_s: Its stamp.
        ranges: Distance of each beam, shape (N,), m.
        angles_rad: Direction of each beam in the plane of the sensor, shape (N,).
        has_return: Which of them hit anything, shape (N,).
        body_from_sensor: Pose of the sensor.
        point_times: Capture time of each beam as a share of the sweep, shape (N,); None: at once.
    """
    angles, in_plane = angles_rad[has_return], np.zeros(np.count_nonzero(has_return))
    directions = np.stack([np.cos(angles), np.sin(angles), in_plane], axis=1)
    points = ranges[has_return, None] * directions
    times = None if point_times is None else point_times[has_return]
    points_in_body = transform_points(body_from_sensor, points)
    return Scan(stamp_s, points_in_body, body_from_sensor[:3, 3], times)


def cloud_scan(
    stamp_s: float,
    points: FloatArray,
    times: npt.NDArray[Any] | None,
    returns: Returns,
    body_from_sensor: Pose,
) -> tuple[Scan, dict[Defect, int]]:
    """Return the scan of a LiDAR, stamped at the end of its sweep, and how many points are wrong.

    Args:
        stamp_s: Its stamp.
        points: Points seen from the sensor, shape (N, 3), m; NaN or infinite without a return.
        times: Capture time of each point, shape (N,), see `_sweep_of`; None: nobody says.
        returns: Which points are returns.
        body_from_sensor: Pose of the sensor.

    Raises:
        DefectError: If all points are NaN, or a time is not finite.
    """
    ranges, dropped = ranges_of(points)
    has_return = returns.among(ranges)
    point_times, late_s = None, 0.0
    if times is not None:
        point_times, late_s = _sweep_of(times[has_return], stamp_s)
    points_in_body = transform_points(body_from_sensor, points[has_return])
    scan = Scan(stamp_s + late_s, points_in_body, body_from_sensor[:3, 3], point_times)
    return scan, dropped


def _sweep_of(times: npt.NDArray[Any], stamp_s: float) -> tuple[FloatArray | None, float]:
    """Return what the times of a cloud's points say.

    Their unit follows from their type: whole numbers are ns, others s (ns where they are too large
    for that), since the stamp or since the epoch.

    Args:
        times: Of the returns, shape (N,), in the unit that their type says.
        stamp_s: Stamp of the cloud.

    Returns:
        Capture times as shares of the sweep, shape (N,), None if there is no motion in them; and by
        how much its end is later than its stamp, s.

    Raises:
        DefectError: If a time is not finite.
    """
    if not len(times):
        return None, 0.0
    is_whole = times.dtype.kind in "iu"
    # NaN that signals.
    with np.errstate(invalid="ignore", over="ignore"):
        exact = times.astype(np.int64 if is_whole else np.float64)
        first, end = exact.min(), float(exact.max())
        since_first = (exact - first).astype(np.float64)
        took = since_first.max()
    # From one end of the numbers to the other is farther than any of them is large.
    if not (np.isfinite(first) and np.isfinite(end) and np.isfinite(took)) or took < 0.0:
        raise DefectError(Defect.BAD_GEOMETRY)
    end_s = end / NANOSECONDS if is_whole or abs(end) > _LARGEST_S else end
    late_s = end_s - stamp_s if end_s > _SINCE_EPOCH_S else end_s
    point_times = since_first / took if took > 0.0 else None
    return point_times, late_s if abs(late_s) <= LONGEST_SWEEP_S else 0.0


def row_type(fields: Mapping[str, tuple[str | None, int]], step: int) -> np.dtype[np.void]:
    """Return how one point of a cloud lies in its bytes.

    Args:
        fields: Type and offset, in bytes, of each value; None for a type that nobody knows.
        step: Bytes from one point to the next.

    Raises:
        DefectError: If a value has no known type, or does not end within the point.
    """
    known = {name: (np.dtype(kind), offset) for name, (kind, offset) in fields.items() if kind}
    if known.keys() != fields.keys() or any(o + k.itemsize > step for k, o in known.values()):
        raise DefectError(Defect.BAD_GEOMETRY)
    kinds, offsets = zip(*known.values(), strict=True)
    return np.dtype({"names": [*known], "formats": kinds, "offsets": offsets, "itemsize": step})


def ranges_of(points: FloatArray) -> tuple[FloatArray, dict[Defect, int]]:
    """Return the distance of each point of a cloud, and how many are wrong.

    Args:
        points: Points seen from the sensor, shape (N, 3), m.

    Raises:
        DefectError: If all of them are NaN.
    """
    # Huge numbers, and NaN that signal.
    with np.errstate(over="ignore", invalid="ignore"):
        ranges = np.linalg.norm(points, axis=1)
    # Organised clouds mark directions without a return by NaN: only a cloud of nothing else is
    # wrong.
    undefined = int(np.count_nonzero(np.isnan(ranges)))
    if undefined == len(points):
        raise DefectError(Defect.NAN_RANGES)
    return ranges, {Defect.NAN_RANGES: undefined} if undefined else {}
