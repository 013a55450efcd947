from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.core.geometry import yaw_of
from hmt_service.errors import InvalidInput
from hmt_service.sim.trajectories import STEP_S, PathFollower


def level(*waypoints: tuple[float, float]) -> np.ndarray:
    return np.array([(x, y, 0.0) for x, y in waypoints])


THERE_AND_BACK = level((0.0, 0.0), (5.0, 0.0), (5.0, 4.0), (5.0, 0.0), (9.0, 0.0))


def test_straight_drive_has_known_poses() -> None:
    poses = list(PathFollower(speed_m_s=0.5).drive(level((1.0, 2.0), (1.0, 6.0))))
    for number, pose in enumerate(poses[:300]):
        assert pose.stamp_s == pytest.approx(0.02 * number)
        assert pose.reference_from_body[:3, 3] == pytest.approx([1.0, 2.0 + 0.01 * number, 0.0])
        assert yaw_of(pose.reference_from_body) == pytest.approx(math.pi / 2)


def test_drive_ends_at_the_last_waypoint() -> None:
    *_, last = PathFollower().drive(THERE_AND_BACK)
    assert np.linalg.norm(last.reference_from_body[:3, 3] - THERE_AND_BACK[-1]) < 0.25


def test_speed_and_turn_stay_below_their_limits() -> None:
    follower = PathFollower(speed_m_s=0.6, turn_rad_s=0.9)
    poses = [pose.reference_from_body for pose in follower.drive(THERE_AND_BACK)]
    steps = np.diff([pose[:2, 3] for pose in poses], axis=0)
    turns = np.diff(np.unwrap([yaw_of(pose) for pose in poses]))
    assert np.linalg.norm(steps, axis=1).max() <= 0.6 * STEP_S + 1e-9
    assert np.abs(turns).max() <= 0.9 * STEP_S + 1e-9
    assert np.abs(turns).max() > 0.8 * STEP_S


def test_corners_are_cut_by_less_than_half_the_look_ahead() -> None:
    route = level((0.0, 0.0), (5.0, 0.0), (5.0, 4.0), (1.0, 4.0))
    follower = PathFollower(look_ahead_m=0.4)
    positions = np.array([pose.reference_from_body[:2, 3] for pose in follower.drive(route)])
    assert _distances_to_path(positions, route[:, :2]).max() < 0.2


def test_turning_back_stays_beside_the_route() -> None:
    follower = PathFollower(look_ahead_m=0.4)
    positions = np.array(
        [pose.reference_from_body[:2, 3] for pose in follower.drive(THERE_AND_BACK)]
    )
    assert _distances_to_path(positions, THERE_AND_BACK[:, :2]).max() < 0.3
    assert positions[:, 1].max() > 3.5


@pytest.mark.parametrize(
    "route",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        level((0.0, 0.0), (1.0, 0.0), (1.0, 0.0)),
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 2.0]]),
        level((0.0, 0.0), (math.nan, 0.0)),
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, math.inf]]),
        np.zeros((2, 2)),
    ],
)
def test_route_without_legs_is_refused(route: np.ndarray) -> None:
    with pytest.raises(InvalidInput, match="waypoints"):
        PathFollower().drive(route)


def _distances_to_path(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the nearest leg of a path."""
    starts, legs = path[:-1], np.diff(path, axis=0)
    along = np.einsum("pld,ld->pl", points[:, None] - starts, legs) / np.sum(legs**2, axis=1)
    nearest = starts + np.clip(along, 0.0, 1.0)[..., None] * legs
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1))
