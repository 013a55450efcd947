"""Trajectory errors of hand-made trajectories, whose numbers follow from how they are made."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from benchmarks.trajectories import TrajectoryErrors, mean_errors, metrics_of, trajectory_errors
from hmt_service.core.geometry import FloatArray, Pose, planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput

ANYWHERE = planar_pose(30.0, -4.0, 2.0)


def square_path(scale: float = 1.0) -> list[Pose]:
    """Return poses every 0.5 m around a square of 20 m, looking along the path."""
    corners = np.array([[0, 0], [20, 0], [20, 20], [0, 20], [0, 0]])
    steps = np.arange(0.0, 1.0, 1.0 / 40.0).tolist()
    return [
        planar_pose(x + share * (to_x - x), y + share * (to_y - y), math.atan2(to_y - y, to_x - x))
        for (x, y), (to_x, to_y) in pairwise((corners * scale).tolist())
        for share in steps
    ]


def stamped(poses: list[Pose], *, late_s: float = 0.0) -> tuple[StampedPose, ...]:
    return tuple(StampedPose(0.2 * number + late_s, pose) for number, pose in enumerate(poses))


def moved(poses: list[Pose], by: FloatArray) -> list[Pose]:
    return [by @ pose for pose in poses]


def test_the_frame_of_the_estimate_does_not_matter() -> None:
    errors = trajectory_errors(stamped(moved(square_path(), ANYWHERE)), stamped(square_path()))
    assert errors.matched == 160
    assert errors.absolute_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert errors.relative_m == pytest.approx(0.0, abs=1e-9)
    assert errors.relative_deg == pytest.approx(0.0, abs=1e-4)


def test_wrong_scale_shows_in_both_errors() -> None:
    errors = trajectory_errors(stamped(square_path(1.02)), stamped(square_path()))
    # Aligned at its middle, a square of 20.4 m is off by 0.01 of the distance from there.
    offsets = np.array([pose[:2, 3] for pose in square_path()])
    offsets -= offsets.mean(axis=0)
    rms = math.sqrt(np.mean(np.sum((0.02 * offsets) ** 2, axis=1)))
    assert errors.absolute_rmse_m == pytest.approx(rms, rel=1e-6)
    # 2 % of 10 m on a side, less around a corner.
    assert 0.15 < errors.relative_m <= 0.2 + 1e-6


def test_wrong_heading_after_half_of_the_path_is_a_relative_error_near_there_only() -> None:
    path = square_path()
    turned = path[:80] + moved(path[80:], planar_pose(0.0, 0.0, math.radians(10.0)))
    errors = trajectory_errors(stamped(turned), stamped(path))
    # Of the pairs 10 m (20 steps) apart, 20 of 140 have one end on either side.
    assert errors.relative_deg == pytest.approx(10.0 * 20 / 140, rel=0.02)


def test_poses_without_truth_do_not_count() -> None:
    path = square_path()
    errors = trajectory_errors(stamped(path)[::2], stamped(path))
    assert errors.matched == 80


def test_trajectories_of_other_times_cannot_be_compared() -> None:
    path = square_path()
    with pytest.raises(InvalidInput, match="160 poses cannot be compared with 160 true ones"):
        trajectory_errors(stamped(path, late_s=1000.0), stamped(path))


def test_a_path_shorter_than_the_relative_distance_cannot_be_judged() -> None:
    path = square_path()[:10]
    with pytest.raises(InvalidInput, match="cannot be compared"):
        trajectory_errors(stamped(path), stamped(path))


def test_several_trajectories_are_as_bad_as_their_mean_and_their_worst_pose() -> None:
    errors = [TrajectoryErrors(5, 0.1, 0.9, 0.3, 2.0), TrajectoryErrors(7, 0.3, 0.4, 0.5, 1.0)]
    mean = mean_errors(errors)
    assert (mean.matched, mean.absolute_max_m) == (12, 0.9)
    assert (mean.absolute_rmse_m, mean.relative_m, mean.relative_deg) == pytest.approx(
        (0.2, 0.4, 1.5)
    )


def test_every_error_has_a_unit() -> None:
    metrics = list(metrics_of("office/0", TrajectoryErrors(5, 0.1, 0.2, 0.3, 0.4)))
    assert [(m.key, m.value, m.unit) for m in metrics] == [
        ("office/0/matched", 5.0, "1"),
        ("office/0/absolute_rmse", 0.1, "m"),
        ("office/0/relative_10m", 0.3, "m"),
        ("office/0/relative_10m_rotation", 0.4, "deg"),
        ("office/0/absolute_max", 0.2, "m"),
    ]
