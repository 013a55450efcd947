from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hmt_service.core.geometry import exp, inverse, planar_pose, transform_points, yaw_of
from hmt_service.core.local_map import deskew
from hmt_service.core.types import OdometryReading, Scan, StampedPose
from hmt_service.sim.people import Crowd
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import DeadReckoning, Laser2d, Lidar3d, RangeSensor, WheelOdometry
from hmt_service.sim.trajectories import STEP_S, Motion
from hmt_service.sim.worlds.plan import Box, mesh_of
from hmt_service.sim.worlds.world import World

# One wall of 200 m x 2 m at y = 5 m.
WALL = World(
    "wall",
    np.array([[-100, 5, -1], [100, 5, -1], [100, 5, 1], [-100, 5, 1]], dtype=np.float32),
    np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
)
PERFECT_WHEELS = WheelOdometry(
    scale=1.0,
    drift_rad_per_m=0.0,
    sigma_m_per_sqrt_m=0.0,
    sigma_rad_per_sqrt_m=0.0,
    sigma_rad_per_sqrt_rad=0.0,
)


def stamped(poses: Sequence[np.ndarray]) -> tuple[StampedPose, ...]:
    return tuple(StampedPose(float(stamp), pose) for stamp, pose in enumerate(poses))


def straight(length_m: float, steps: int) -> tuple[StampedPose, ...]:
    return stamped([planar_pose(x, 0.0, 0.0) for x in np.linspace(0.0, length_m, steps + 1)])


def seen_by(
    sensor: RangeSensor, world_from_body: np.ndarray, *, scans: int = 1, seed: int = 0
) -> tuple[Scan, ...]:
    """Return what a robot sees that stands still in front of the wall, alone."""
    rng = np.random.default_rng(seed)
    nobody = Crowd(WALL.route_m, 0, rng)
    motion = Motion(0, world_from_body[None])
    stretches = [(np.arange(float(scans)), motion)]
    return tuple(scan for _, scan in sensor.observe(RayCaster(WALL), nobody, stretches, 1.0, rng))


def reckoned(
    wheels: WheelOdometry, trajectory: Sequence[StampedPose], rng: np.random.Generator
) -> list[OdometryReading]:
    """Return what wheels say of a trajectory."""
    reckoning = DeadReckoning(wheels, rng)
    return [reckoning.reading(pose) for pose in trajectory]


def test_exact_laser_sees_the_wall_where_it_is() -> None:
    laser = Laser2d(range_sigma_m=0.0)
    world_from_body = planar_pose(3.0, 1.0, math.pi / 2)
    (scan,) = seen_by(laser, world_from_body)
    points = transform_points(world_from_body, scan.points_in_body)
    assert points[:, 1] == pytest.approx(5.0, abs=1e-4)
    assert points[:, 2] == pytest.approx(laser.sensor_in_body[2])
    # Straight ahead: 5 m less 1 m of pose and 0.1 m of mount.
    ahead = scan.points_in_body[np.argmin(np.abs(scan.points_in_body[:, 1]))]
    assert ahead - scan.sensor_in_body == pytest.approx([3.9, 0.0, 0.0], abs=1e-4)


def test_beams_beyond_the_maximal_range_are_left_out() -> None:
    laser = Laser2d(range_sigma_m=0.0, max_range_m=8.0)
    facing = planar_pose(0.0, 1.0, math.pi / 2)
    (scan,) = seen_by(laser, facing)
    ranges = np.linalg.norm(scan.points_in_body - scan.sensor_in_body, axis=1)
    assert ranges.max() <= 8.0
    # The wall is 3.9 m away: returns come from within acos(3.9 / 8) of straight ahead.
    step = laser.field_of_view_rad / (laser.beams - 1)
    assert len(ranges) == 2 * math.floor(math.acos(3.9 / 8.0) / step) + 1


def test_laser_that_sees_nothing_sends_an_empty_scan() -> None:
    away = planar_pose(0.0, -40.0, -math.pi / 2)
    (scan,) = seen_by(Laser2d(), away)
    assert scan.points_in_body.shape == (0, 3)


def test_range_noise_has_the_stated_sigma() -> None:
    laser = Laser2d(beams=3, field_of_view_rad=0.2, range_sigma_m=0.05)
    scans = seen_by(laser, planar_pose(0.0, 0.0, math.pi / 2), scans=4000, seed=1)
    ahead = [scan.points_in_body[1, 0] for scan in scans]
    ranges = np.array(ahead) - laser.sensor_in_body[0]
    # Five standard errors of a mean and of a standard deviation of 4000 draws.
    assert ranges.mean() == pytest.approx(4.9, abs=5 * 0.05 / math.sqrt(4000))
    assert ranges.std() == pytest.approx(0.05, rel=5 / math.sqrt(2 * 4000))


def test_perfect_wheels_report_the_motion_from_the_start() -> None:
    poses = [planar_pose(2.0 + t, math.sin(t), 0.3 * t) for t in np.linspace(0.0, 9.0, 40)]
    readings = tuple(reckoned(PERFECT_WHEELS, stamped(poses), np.random.default_rng(0)))
    assert len(readings) == len(poses)
    for pose, reading in zip(poses, readings, strict=True):
        assert reading.odom_from_body == pytest.approx(inverse(poses[0]) @ pose, abs=1e-9)


def test_biased_wheels_scale_the_distance_and_bend_the_path() -> None:
    wheels = WheelOdometry(
        scale=1.02,
        drift_rad_per_m=0.01,
        sigma_m_per_sqrt_m=0.0,
        sigma_rad_per_sqrt_m=0.0,
        sigma_rad_per_sqrt_rad=0.0,
    )
    *_, last = reckoned(wheels, straight(50.0, 5000), np.random.default_rng(0))
    # An arc of 51 m that turns by 0.5 rad.
    radius = 51.0 / 0.5
    expected = [radius * math.sin(0.5), radius * (1.0 - math.cos(0.5))]
    assert yaw_of(last.odom_from_body) == pytest.approx(0.5)
    assert last.odom_from_body[:2, 3] == pytest.approx(expected, abs=0.01)


def test_heading_noise_grows_with_the_root_of_the_distance() -> None:
    wheels = WheelOdometry(drift_rad_per_m=0.0, sigma_rad_per_sqrt_m=0.02)
    rng = np.random.default_rng(2)
    trajectory = straight(9.0, 30)
    yaws = [yaw_of(list(reckoned(wheels, trajectory, rng))[-1].odom_from_body) for _ in range(400)]
    assert np.std(yaws) == pytest.approx(0.02 * math.sqrt(9.0), rel=5 / math.sqrt(2 * 400))


def test_standing_wheels_report_nothing_new() -> None:
    standing = stamped([planar_pose(1.0, 2.0, 0.5)] * 3)
    for reading in reckoned(WheelOdometry(), standing, np.random.default_rng(0)):
        assert reading.odom_from_body == pytest.approx(np.eye(4), abs=1e-8)


def room() -> World:
    """Return a room of 20 m x 16 m x 4 m, its floor at z = 0, the origin in its middle."""
    vertices, triangles = mesh_of([Box(-10.0, -8.0, 10.0, 8.0, 4.0)])
    return World("room", vertices, triangles, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))


def swept(lidar: Lidar3d, poses: np.ndarray, stamps_s: list[float], period_s: float) -> list[Scan]:
    """Return what a LiDAR sends from the room, alone, while it moves."""
    rng = np.random.default_rng(0)
    world = room()
    stretches = [(np.array(stamps_s), Motion(0, poses))]
    nobody = Crowd(world.route_m, 0, rng)
    observed = lidar.observe(RayCaster(world), nobody, stretches, period_s, rng)
    return [scan for _, scan in observed]


EXACT_LIDAR = Lidar3d(rows=16, columns=360, range_sigma_m=0.0)


def test_standing_lidar_sees_floor_and_walls_where_they_are() -> None:
    world_from_body = planar_pose(2.0, 1.0, 0.4)
    (scan,) = swept(EXACT_LIDAR, world_from_body[None], [0.0], 0.1)
    points = transform_points(world_from_body, scan.points_in_body)
    x, y, z = points.T
    on_wall = np.minimum(np.abs(np.abs(x) - 10.0), np.abs(np.abs(y) - 8.0))
    assert np.minimum(on_wall, np.minimum(np.abs(z), np.abs(z - 4.0))).max() < 1e-4
    # A ray falls to the floor, 0.8 m below, if its elevation reaches below the foot of the wall.
    assert np.count_nonzero(np.abs(z) < 1e-4) > 1000
    assert len(points) == EXACT_LIDAR.rays
    assert np.array_equal(scan.sensor_in_body, EXACT_LIDAR.sensor_in_body)


def test_rows_and_columns_have_the_declared_directions() -> None:
    lidar = Lidar3d(rows=3, columns=8, vertical_fov_rad=0.2, range_sigma_m=0.0)
    (scan,) = swept(lidar, np.eye(4)[None], [0.0], 0.1)
    rays = scan.points_in_body - scan.sensor_in_body
    azimuths = np.arctan2(rays[:, 1], rays[:, 0]).reshape(8, 3)
    elevations = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])).reshape(8, 3)
    assert elevations == pytest.approx(np.tile([-0.1, 0.0, 0.1], (8, 1)), abs=1e-6)
    expected = np.linspace(-math.pi, math.pi, 8, endpoint=False)
    assert np.cos(azimuths - expected[:, None]) == pytest.approx(1.0)
    assert scan.point_times == pytest.approx(np.repeat(np.arange(1, 9) / 8, 3))


def test_single_row_looks_level() -> None:
    (scan,) = swept(Lidar3d(rows=1, range_sigma_m=0.0), np.eye(4)[None], [0.0], 0.1)
    assert scan.points_in_body[:, 2] == pytest.approx(0.8, abs=1e-5)


def test_every_column_is_seen_from_where_the_robot_is_then() -> None:
    # 2 m/s along x: at share s of the sweep that ends at t = 0.2 s, x is 0.2 m + s * 0.2 m.
    poses = np.array([planar_pose(0.04 * step, 0.0, 0.0) for step in range(11)])
    (scan,) = swept(EXACT_LIDAR, poses, [0.2], 0.1)
    assert scan.point_times is not None
    ahead = np.abs(scan.points_in_body[:, 1]) < 0.05
    ahead &= np.abs(scan.points_in_body[:, 2] - 0.8) < 0.5
    ahead &= scan.points_in_body[:, 0] > 0.0
    x_then = 0.2 + 0.2 * scan.point_times[ahead]
    assert ahead.sum() >= 2
    assert scan.points_in_body[ahead, 0] == pytest.approx(10.0 - x_then, abs=1e-4)


def test_deskewed_points_lie_on_the_walls_and_others_do_not() -> None:
    # 2 m/s and 1.5 rad/s: 0.2 m and 9 degrees in one sweep of 0.1 s.
    xi = STEP_S * np.array([0.1, -0.05, 1.5, 2.0, 0.1, 0.05])
    poses = exp(np.arange(16)[:, None] * xi)
    (scan,) = swept(EXACT_LIDAR, poses, [0.3], 0.1)
    assert scan.point_times is not None
    truth, sweep = poses[15], exp(5 * xi)
    caster = RayCaster(room())
    deskewed = deskew(scan.points_in_body, scan.point_times, sweep)
    assert caster.clearances(transform_points(truth, deskewed)).max() < 1e-3
    skewed = caster.clearances(transform_points(truth, scan.points_in_body))
    assert np.percentile(skewed, 90) > 0.1


def test_lidar_range_noise_has_the_stated_sigma() -> None:
    noisy = Lidar3d(rows=16, columns=360, range_sigma_m=0.03)
    (scan,), (exact,) = (swept(each, np.eye(4)[None], [0.0], 0.1) for each in (noisy, EXACT_LIDAR))
    errors = np.linalg.norm(scan.points_in_body - scan.sensor_in_body, axis=1) - np.linalg.norm(
        exact.points_in_body - exact.sensor_in_body, axis=1
    )
    count = len(errors)
    assert count == noisy.rays
    assert errors.mean() == pytest.approx(0.0, abs=5 * 0.03 / math.sqrt(count))
    assert errors.std() == pytest.approx(0.03, rel=5 / math.sqrt(2 * count))


def test_returns_out_of_range_are_left_out_with_their_times() -> None:
    lidar = Lidar3d(rows=16, columns=360, min_range_m=5.0, max_range_m=9.0)
    (scan,) = swept(lidar, np.eye(4)[None], [0.0], 0.1)
    assert scan.point_times is not None
    assert 0 < len(scan.points_in_body) == len(scan.point_times) < lidar.rays
    ranges = np.linalg.norm(scan.points_in_body - scan.sensor_in_body, axis=1)
    assert ranges.min() >= 5.0
    assert ranges.max() <= 9.0


def test_slips_have_the_stated_rate_and_size() -> None:
    wheels = replace(PERFECT_WHEELS, slips_per_m=0.5, slip_m=0.2, slip_sigma_rad=0.0)
    length_m, runs = 40.0, 200
    rng = np.random.default_rng(5)
    trajectory = straight(length_m, 80)
    too_far = np.array(
        [[*reckoned(wheels, trajectory, rng)][-1].odom_from_body[0, 3] for _ in range(runs)]
    )
    too_far -= length_m
    # A compound Poisson process of exponential steps: mean r L m, variance 2 r L m^2.
    mean, variance = 0.5 * length_m * 0.2, 2 * 0.5 * length_m * 0.2**2
    assert too_far.mean() == pytest.approx(mean, abs=5 * math.sqrt(variance / runs))
    assert too_far.var() == pytest.approx(variance, rel=0.5)
    assert too_far.min() > 0.0


def test_wheels_slip_seldom_and_at_once() -> None:
    wheels = replace(PERFECT_WHEELS, slips_per_m=0.1, slip_m=0.5)
    readings = [*reckoned(wheels, straight(100.0, 1000), np.random.default_rng(6))]
    steps = np.diff([reading.odom_from_body[0, 3] for reading in readings])
    slips = steps > 0.1 + 1e-6
    # Poisson of mean 10: five standard deviations.
    assert 1 <= slips.sum() <= 26
    assert steps[~slips] == pytest.approx(0.1)


def test_slips_turn_the_heading_by_the_stated_sigma() -> None:
    wheels = replace(PERFECT_WHEELS, slips_per_m=1.0, slip_sigma_rad=0.05)
    rng = np.random.default_rng(7)
    trajectory = straight(9.0, 30)
    yaws = [yaw_of([*reckoned(wheels, trajectory, rng)][-1].odom_from_body) for _ in range(400)]
    assert np.std(yaws) == pytest.approx(0.05 * math.sqrt(9.0), rel=5 * math.sqrt(3 / (4 * 400)))


def test_slips_leave_the_other_noise_as_it_is() -> None:
    trajectory = straight(20.0, 100)
    steady, slipping = (
        [*reckoned(wheels, trajectory, np.random.default_rng(8))]
        for wheels in (WheelOdometry(), WheelOdometry(slips_per_m=0.05, slip_m=0.3))
    )
    motions = [
        [inverse(a.odom_from_body) @ b.odom_from_body for a, b in pairwise(readings)]
        for readings in (steady, slipping)
    ]
    same = [np.allclose(a, b, atol=1e-12) for a, b in zip(*motions, strict=True)]
    assert 90 <= sum(same) < 100


def test_wheels_measure_along_the_slope() -> None:
    # 1 m up a slope whose tangent is 0.75: 1.25 m of ground.
    nose_up = np.eye(4)
    nose_up[:3, 0], nose_up[:3, 2] = (0.8, 0.0, 0.6), (-0.6, 0.0, 0.8)
    end = nose_up.copy()
    end[:3, 3] = 1.0, 0.0, 0.75
    *_, last = reckoned(PERFECT_WHEELS, stamped([nose_up, end]), np.random.default_rng(0))
    assert last.odom_from_body == pytest.approx(planar_pose(1.25, 0.0, 0.0))
