from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from hmt_service.core.geometry import inverse, planar_pose, transform_points, yaw_of
from hmt_service.core.types import Scan, StampedPose
from hmt_service.sim.people import Crowd
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import Laser2d, RangeSensor, WheelOdometry
from hmt_service.sim.trajectories import Motion
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
    motion = Motion(0.0, world_from_body[None])
    return tuple(sensor.observe(RayCaster(WALL), nobody, motion, np.arange(float(scans)), 1.0, rng))


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
    readings = tuple(PERFECT_WHEELS.observe(stamped(poses), np.random.default_rng(0)))
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
    *_, last = wheels.observe(straight(50.0, 5000), np.random.default_rng(0))
    # An arc of 51 m that turns by 0.5 rad.
    radius = 51.0 / 0.5
    expected = [radius * math.sin(0.5), radius * (1.0 - math.cos(0.5))]
    assert yaw_of(last.odom_from_body) == pytest.approx(0.5)
    assert last.odom_from_body[:2, 3] == pytest.approx(expected, abs=0.01)


def test_heading_noise_grows_with_the_root_of_the_distance() -> None:
    wheels = WheelOdometry(drift_rad_per_m=0.0, sigma_rad_per_sqrt_m=0.02)
    rng = np.random.default_rng(2)
    trajectory = straight(9.0, 30)
    yaws = [yaw_of(list(wheels.observe(trajectory, rng))[-1].odom_from_body) for _ in range(400)]
    assert np.std(yaws) == pytest.approx(0.02 * math.sqrt(9.0), rel=5 / math.sqrt(2 * 400))


def test_standing_wheels_report_nothing_new() -> None:
    standing = stamped([planar_pose(1.0, 2.0, 0.5)] * 3)
    for reading in WheelOdometry().observe(standing, np.random.default_rng(0)):
        assert reading.odom_from_body == pytest.approx(np.eye(4), abs=1e-8)
