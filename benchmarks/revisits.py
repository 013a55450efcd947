"""How well a trajectory puts scans of the same place upon each other, where no truth is known.

Which scans are of one place is taken from the odometry, whose drift is smaller than a place: not
from the trajectory that is judged, which could hide its errors that way.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from hmt_service.core.geometry import FloatArray, transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan, StampedPose
from hmt_service.errors import InvalidInput

_SCANS_APART = 30
_WITHIN_M = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Revisit:
    """Two scans of one place, taken at different times."""

    before: Scan
    """The earlier one."""
    after: Scan
    """The later one."""


def revisits(readings: Iterable[Reading]) -> tuple[Revisit, ...]:
    """Return each scan that comes back to a place, with the nearest earlier scan of that place.

    Args:
        readings: Scans and odometry, in the order of time.
    """
    scans: list[Scan] = []
    positions: list[FloatArray] = []
    position: FloatArray | None = None
    for reading in readings:
        if isinstance(reading, OdometryReading):
            position = reading.odom_from_body[:3, 3]
        elif position is not None:
            scans.append(reading)
            positions.append(position)
    found = []
    for later in range(_SCANS_APART, len(scans)):
        away_m = np.linalg.norm(
            np.array(positions[: later - _SCANS_APART + 1]) - positions[later], axis=1
        )
        earlier = int(np.argmin(away_m))
        if away_m[earlier] <= _WITHIN_M:
            found.append(Revisit(scans[earlier], scans[later]))
    return tuple(found)


def gap_m(pairs: Sequence[Revisit], trajectory: Sequence[StampedPose]) -> float:
    """Return how far the points of the later scans are from those of the earlier ones.

    Args:
        pairs: What `revisits` returns.
        trajectory: The poses to judge.

    Returns:
        Median over the pairs of the median distance to the nearest point.

    Raises:
        InvalidInput: If no pair has poses.
    """
    poses = {pose.stamp_s: pose.reference_from_body for pose in trajectory}
    gaps = []
    for pair in pairs:
        before, after = poses.get(pair.before.stamp_s), poses.get(pair.after.stamp_s)
        if before is None or after is None:
            continue
        tree = KDTree(transform_points(before, pair.before.points_in_body))
        distances, _ = tree.query(transform_points(after, pair.after.points_in_body))
        gaps.append(float(np.median(distances)))
    if not gaps:
        raise InvalidInput(f"none of {len(pairs)} revisits has a pose in {len(trajectory)} poses")
    return float(np.median(gaps))
