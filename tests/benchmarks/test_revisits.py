"""Revisits on a line that is driven there and back."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.revisits import gap_m, revisits
from hmt_service.core.geometry import inverse, planar_pose, transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan, StampedPose
from hmt_service.errors import InvalidInput

POLES = np.array([[x, y, 0.0] for x in range(-10, 90, 10) for y in (-5.0, 5.0)])
THERE = 30
POSITIONS = [2.0 * step for step in range(THERE)] + [2.0 * step for step in range(THERE)][::-1]


def readings(*, drift_m: float = 0.0) -> list[Reading]:
    result: list[Reading] = []
    for number, x in enumerate(POSITIONS):
        points = transform_points(inverse(planar_pose(x, 0.0, 0.0)), POLES)
        odometry = planar_pose(x + drift_m * number / len(POSITIONS), 0.0, 0.0)
        result += [
            OdometryReading(float(number), odometry),
            Scan(float(number), points, np.zeros(3)),
        ]
    return result


def trajectory(*, shift_back_m: float = 0.0) -> list[StampedPose]:
    return [
        StampedPose(float(number), planar_pose(x + shift_back_m * (number >= THERE), 0.0, 0.0))
        for number, x in enumerate(POSITIONS)
    ]


def test_a_scan_is_paired_with_the_nearest_one_of_long_ago() -> None:
    pairs = revisits(readings())
    # The way back begins where the way there has just ended: too short ago to be a revisit.
    assert pairs[-1].before.stamp_s == 0.0
    assert pairs[-1].after.stamp_s == float(len(POSITIONS) - 1)
    assert all(pair.after.stamp_s - pair.before.stamp_s >= THERE for pair in pairs)
    assert len(pairs) > 10


def test_a_drive_that_never_comes_back_has_no_revisits() -> None:
    assert revisits(readings()[: 2 * THERE]) == ()


def test_odometry_that_drifts_a_little_finds_the_same_places() -> None:
    assert len(revisits(readings(drift_m=1.0))) > 10


def test_a_true_trajectory_leaves_no_gap() -> None:
    assert gap_m(revisits(readings()), trajectory()) == pytest.approx(0.0, abs=1e-9)


def test_a_trajectory_that_is_off_leaves_a_gap_of_that_size() -> None:
    assert gap_m(revisits(readings()), trajectory(shift_back_m=1.5)) == pytest.approx(1.5)


def test_without_poses_of_revisits_nothing_can_be_said() -> None:
    with pytest.raises(InvalidInput, match="has a pose in 3 poses"):
        gap_m(revisits(readings()), trajectory()[:3])
