"""Error of the motion over a stretch of path, by evo, without any alignment.

Unlike an absolute error it can be told of a straight line, and does not ask where a drive began.

References:
    Geiger et al., CVPR 2012 (relative error over distances).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from evo.core.filters import FilterException
from evo.core.metrics import PoseRelation

from benchmarks.trajectories import RELATIVE_OVER_M, evo_trajectory, relative_error
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class MotionErrors:
    """Mean errors of the motion over `RELATIVE_OVER_M` of the true path."""

    translation_m: float
    """Of the position."""
    rotation_deg: float
    """Of the attitude."""


def motion_errors(estimate: Sequence[StampedPose], truth: Sequence[StampedPose]) -> MotionErrors:
    """Return the relative errors of a trajectory.

    Args:
        estimate: Estimated poses in any frame.
        truth: True pose of each, at the same moment.

    Raises:
        InvalidInput: If the true path is shorter than `RELATIVE_OVER_M`.
    """
    try:
        means = [
            relative_error(evo_trajectory(truth), evo_trajectory(estimate), relation)
            for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
        ]
    except FilterException as error:
        raise InvalidInput(
            f"{len(truth)} true poses have no two {RELATIVE_OVER_M:g} m of path apart: {error}"
        ) from error
    return MotionErrors(*means)
