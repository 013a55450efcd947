"""Error of the motion over a stretch of path, by evo, without any alignment.

Unlike an absolute error it can be told of a straight line, and does not ask where a drive began.

References:
    Geiger et al., CVPR 2012 (relative error over distances).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from evo.core.filters import FilterException
from evo.core.metrics import RPE, PoseRelation, StatisticsType, Unit
from evo.core.trajectory import PoseTrajectory3D

from benchmarks.trajectories import RELATIVE_OVER_M
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput

_TOLERANCE = 0.1


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
    pair = _evo(truth), _evo(estimate)
    try:
        means = [
            _mean(pair, relation)
            for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
        ]
    except FilterException as error:
        raise InvalidInput(
            f"{len(truth)} true poses have no two {RELATIVE_OVER_M:g} m of path apart: {error}"
        ) from error
    return MotionErrors(*means)


def _mean(pair: tuple[PoseTrajectory3D, PoseTrajectory3D], relation: PoseRelation) -> float:
    errors = RPE(
        relation,
        delta=RELATIVE_OVER_M,
        delta_unit=Unit.meters,
        rel_delta_tol=_TOLERANCE,
        all_pairs=True,
        pairs_from_reference=True,
    )
    errors.process_data(pair)
    return float(errors.get_statistic(StatisticsType.mean))


def _evo(trajectory: Sequence[StampedPose]) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        poses_se3=[pose.reference_from_body for pose in trajectory],
        timestamps=np.array([pose.stamp_s for pose in trajectory]),
    )
