"""How far an estimated trajectory is from the true one, by evo.

References:
    Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012 (absolute and
    relative error); Geiger et al., CVPR 2012 (relative error over distances).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
from evo.core.filters import FilterException
from evo.core.geometry import GeometryException
from evo.core.metrics import APE, RPE, PoseRelation, StatisticsType, Unit
from evo.core.sync import SyncException, associate_trajectories
from evo.core.trajectory import PoseTrajectory3D

from benchmarks.metric import Direction, Metric
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput

RELATIVE_OVER_M = 10.0
"""Distance along the true path that the relative error is taken over."""
_RELATIVE_TOLERANCE = 0.1
_LARGEST_GAP_S = 0.005
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER
_METRIC_TOLERANCE = 0.15


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of the poses that both trajectories have."""

    matched: int
    """Number of poses compared."""
    absolute_rmse_m: float
    """Root mean square distance between the positions, after the best rigid alignment."""
    absolute_max_m: float
    """Largest of these distances."""
    relative_m: float
    """Mean translational error of the motion over `RELATIVE_OVER_M`."""
    relative_deg: float
    """Mean rotational error of the motion over `RELATIVE_OVER_M`."""


def trajectory_errors(
    estimate: Sequence[StampedPose], truth: Sequence[StampedPose]
) -> TrajectoryErrors:
    """Return the absolute and the relative error of a trajectory.

    Args:
        estimate: Estimated poses in any frame; those without a true pose within 5 ms do not count.
        truth: True poses in the order of time.

    Raises:
        InvalidInput: If nothing can be matched, all true positions lie on a line, or the true path
            is shorter than `RELATIVE_OVER_M`.
    """
    try:
        true, estimated = associate_trajectories(
            evo_trajectory(truth), evo_trajectory(estimate), max_diff=_LARGEST_GAP_S
        )
        relative = [
            relative_error(true, estimated, relation)
            for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
        ]
        estimated.align(true)
    except (SyncException, GeometryException, FilterException) as error:
        raise InvalidInput(
            f"{len(estimate)} poses cannot be compared with {len(truth)} true ones: {error}"
        ) from error
    absolute = APE(PoseRelation.translation_part)
    absolute.process_data((true, estimated))
    return TrajectoryErrors(
        matched=true.num_poses,
        absolute_rmse_m=float(absolute.get_statistic(StatisticsType.rmse)),
        absolute_max_m=float(absolute.get_statistic(StatisticsType.max)),
        relative_m=relative[0],
        relative_deg=relative[1],
    )


def mean_errors(errors: Sequence[TrajectoryErrors]) -> TrajectoryErrors:
    """Return the errors of several trajectories as one: means, but all poses and the largest."""
    return TrajectoryErrors(
        matched=sum(each.matched for each in errors),
        absolute_rmse_m=fmean(each.absolute_rmse_m for each in errors),
        absolute_max_m=max(each.absolute_max_m for each in errors),
        relative_m=fmean(each.relative_m for each in errors),
        relative_deg=fmean(each.relative_deg for each in errors),
    )


def metrics_of(prefix: str, errors: TrajectoryErrors) -> Iterator[Metric]:
    """Yield the numbers as metrics.

    Args:
        prefix: What they were measured on.
        errors: The numbers.
    """
    yield Metric(f"{prefix}/matched", float(errors.matched), "1", _HIGHER, 0.0)
    for name, value, unit in (
        ("absolute_rmse", errors.absolute_rmse_m, "m"),
        ("relative_10m", errors.relative_m, "m"),
        ("relative_10m_rotation", errors.relative_deg, "deg"),
    ):
        yield Metric(f"{prefix}/{name}", value, unit, _LOWER, _METRIC_TOLERANCE)
    yield Metric(f"{prefix}/absolute_max", errors.absolute_max_m, "m", _LOWER, None)


def relative_error(
    true: PoseTrajectory3D, estimated: PoseTrajectory3D, relation: PoseRelation
) -> float:
    """Return the mean error of the motion over `RELATIVE_OVER_M` of the true path.

    Raises:
        FilterException: If the true path is shorter.
    """
    errors = RPE(
        relation,
        delta=RELATIVE_OVER_M,
        delta_unit=Unit.meters,
        rel_delta_tol=_RELATIVE_TOLERANCE,
        all_pairs=True,
        pairs_from_reference=True,
    )
    errors.process_data((true, estimated))
    return float(errors.get_statistic(StatisticsType.mean))


def evo_trajectory(trajectory: Sequence[StampedPose]) -> PoseTrajectory3D:
    """Return a trajectory as evo's."""
    return PoseTrajectory3D(
        poses_se3=[pose.reference_from_body for pose in trajectory],
        timestamps=np.array([pose.stamp_s for pose in trajectory]),
    )
