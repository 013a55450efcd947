from __future__ import annotations

import math
import tracemalloc
from itertools import islice

import numpy as np
import pytest

from hmt_service.core.geometry import exp, yaw_of
from hmt_service.errors import InvalidInput
from hmt_service.sim.simulation import INDOOR_LASER, LIDAR, OUTDOOR_LASER, Robot
from hmt_service.sim.trajectories import STEP_S, Motion, PathFollower


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


def poses_on(route: np.ndarray, follower: PathFollower | None = None) -> np.ndarray:
    """Return the poses of a drive, shape (N, 4, 4)."""
    drive = (follower or PathFollower()).drive(route)
    return np.array([pose.reference_from_body for pose in drive])


RAMP = np.array([[0.0, 0.0, 1.0], [10.0, 0.0, 1.0], [20.0, 0.0, 3.0], [30.0, 0.0, 3.0]])


def test_robot_stands_on_the_ramp_and_looks_along_it() -> None:
    poses = poses_on(RAMP)
    x = poses[:, 0, 3]
    assert poses[:, 2, 3] == pytest.approx(np.interp(x, RAMP[:, 0], RAMP[:, 2]), abs=1e-9)
    on_ramp, level = (x > 10.25) & (x < 19.75), (x < 9.75) | (x > 20.25)
    up_the_ramp = np.array([1.0, 0.0, 0.2]) / math.hypot(1.0, 0.2)
    assert poses[on_ramp, :3, 0] == pytest.approx(np.tile(up_the_ramp, (on_ramp.sum(), 1)))
    assert np.array_equal(poses[level, :3, 0], np.tile([1.0, 0.0, 0.0], (level.sum(), 1)))


def test_attitude_changes_over_a_wheelbase_where_the_ramp_begins() -> None:
    pitches = np.arcsin(poses_on(RAMP)[:, 2, 0])
    # 0.2 of slope over 0.5 m, 0.012 m per step.
    assert np.abs(np.diff(pitches)).max() == pytest.approx(0.2 * 0.012 / 0.5, rel=0.05)


def test_attitude_is_a_rotation_without_roll() -> None:
    route = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 1.0], [6.0, 6.0, 0.5], [0.0, 6.0, 2.0]])
    rotations = poses_on(route)[:, :3, :3]
    products = np.einsum("nji,njk->nik", rotations, rotations)
    assert products == pytest.approx(np.broadcast_to(np.eye(3), products.shape), abs=1e-12)
    assert np.linalg.det(rotations) == pytest.approx(1.0)
    assert np.all(rotations[:, 2, 1] == 0.0)


def test_robot_that_turns_back_on_a_slope_stays_on_it() -> None:
    climb = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    poses = poses_on(climb)
    inside = (poses[:, 0, 3] > 0.3) & (poses[:, 0, 3] < 4.4)
    assert poses[inside, 2, 3] == pytest.approx(0.2 * poses[inside, 0, 3], abs=1e-6)
    # Up as well as down the nose follows the plane, also while the robot turns.
    nose = poses[inside, :3, 0]
    assert nose[:, 2] / np.hypot(nose[:, 0], nose[:, 1]) == pytest.approx(
        0.2 * nose[:, 0] / np.hypot(nose[:, 0], nose[:, 1]), abs=1e-6
    )
    assert nose[:, 0].min() < -0.9
    assert nose[:, 0].max() > 0.9


def test_height_and_attitude_never_jump() -> None:
    # A spiral ramp of two turns with sharp corners, and a way back down that turns on the spot.
    turn = [(0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (2.0, 2.0)]
    up = np.array([(x, y, 0.6 * step) for step, (x, y) in enumerate([*turn, *turn])])
    poses = poses_on(np.concatenate([up, up[-2::-1]]))
    assert np.abs(np.diff(poses[:, 2, 3])).max() < 0.02
    turns = np.einsum("nji,njk->nik", poses[:-1, :3, :3], poses[1:, :3, :3])
    angles = np.arccos(np.clip((np.trace(turns, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angles.max() < 0.04


def test_first_poses_of_a_long_route_need_no_memory_for_the_rest() -> None:
    route = level(*((float(x), float(x % 2)) for x in range(2000)))
    long = np.concatenate([route + (2000.0 * lap, 0.0, 0.0) for lap in range(50)])
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in islice(PathFollower().drive(long), 2000):
            pass
        peak = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    # Lengths, sums and differences of the waypoints; the points 2 cm apart would take 700 MB.
    assert peak < 8 * long.nbytes


@pytest.mark.parametrize("robot", [INDOOR_LASER, OUTDOOR_LASER, LIDAR])
def test_ready_made_robots_cut_corners_by_less_than_twenty_centimetres(robot: Robot) -> None:
    route = level((0.0, 0.0), (5.0, 0.0), (5.0, 4.0), (1.0, 4.0))
    positions = poses_on(route, robot.follower)[:, :2, 3]
    assert _distances_to_path(positions, route[:, :2]).max() < 0.2


def twisting(xi: np.ndarray, steps: int) -> np.ndarray:
    """Return poses one step apart that move by one twist per step."""
    return exp(np.arange(steps + 1)[:, None] * xi)


def test_motion_gives_its_poses_and_moves_steadily_in_between() -> None:
    xi = np.array([0.01, -0.02, 0.03, 0.02, 0.01, -0.01])
    poses = twisting(xi, 10)
    motion = Motion(150, poses)
    assert np.array_equal(motion.at(3.0 + STEP_S * np.arange(11.0)), poses)
    assert motion.at(np.array([3.0 + 2.25 * STEP_S])) == pytest.approx(exp(2.25 * xi[None]))


def test_robot_stands_still_before_and_after_a_motion() -> None:
    poses = twisting(np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0]), 3)
    at = Motion(50, poses).at(np.array([[-5.0, 0.99], [1.0 + 3 * STEP_S, 7.0]]))
    assert np.array_equal(at, np.array([[poses[0], poses[0]], [poses[3], poses[3]]]))


def _distances_to_path(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return the distance of each point to the nearest leg of a path."""
    starts, legs = path[:-1], np.diff(path, axis=0)
    along = np.einsum("pld,ld->pl", points[:, None] - starts, legs) / np.sum(legs**2, axis=1)
    nearest = starts + np.clip(along, 0.0, 1.0)[..., None] * legs
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=2).min(axis=1))
