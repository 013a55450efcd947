"""Simulated sensors: each turns the true trajectory into the readings that a robot would send.

References:
    Thrun et al., Probabilistic Robotics, 2005, sections 5.4 (odometry) and 6.3 (beams).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hmt_service.core.geometry import identity, inverse, planar_pose, transform_points, yaw_of
from hmt_service.core.types import OdometryReading, Scan, StampedPose
from hmt_service.sim.raycasting import RayCaster


@dataclass(frozen=True, slots=True)
class Laser2d:
    """A planar laser that looks forward."""

    beams: int = 361
    """Number of beams."""
    field_of_view_rad: float = math.radians(270.0)
    """Angle between the first and the last beam."""
    min_range_m: float = 0.1
    """Nearer surfaces give no return."""
    max_range_m: float = 20.0
    """Farther surfaces give no return."""
    range_sigma_m: float = 0.02
    """Standard deviation of one range."""
    sensor_in_body: tuple[float, float, float] = (0.1, 0.0, 0.3)
    """Where the laser sits on the robot, m; its plane is horizontal."""

    def observe(
        self, caster: RayCaster, trajectory: Sequence[StampedPose], rng: np.random.Generator
    ) -> Iterator[Scan]:
        """Yield one scan per pose; beams without return are left out.

        Args:
            caster: World that the robot moves in.
            trajectory: True poses in the frame of the world.
            rng: Source of the range noise.
        """
        half = self.field_of_view_rad / 2
        angles = np.linspace(-half, half, self.beams)
        directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
        mount = np.array(self.sensor_in_body)
        for pose in trajectory:
            world_from_body = pose.reference_from_body
            origin = transform_points(world_from_body, mount[None])[0]
            ranges = caster.ranges(origin, directions @ world_from_body[:3, :3].T)
            ranges += rng.normal(0.0, self.range_sigma_m, self.beams)
            is_return = (ranges >= self.min_range_m) & (ranges <= self.max_range_m)
            points = mount + directions[is_return] * ranges[is_return, None]
            yield Scan(pose.stamp_s, points, mount)


@dataclass(frozen=True, slots=True)
class WheelOdometry:
    """Dead reckoning of a wheeled robot: wrong wheel radii, unequal wheels, slip."""

    scale: float = 1.01
    """Measured over true distance."""
    drift_rad_per_m: float = 0.001
    """Systematic error of the heading."""
    sigma_m_per_sqrt_m: float = 0.02
    """Standard deviation of the position along and across the motion after 1 m."""
    sigma_rad_per_sqrt_m: float = 0.006
    """Standard deviation of the heading after 1 m."""
    sigma_rad_per_sqrt_rad: float = 0.015
    """Standard deviation of the heading after a turn of 1 rad."""

    def observe(
        self, trajectory: Sequence[StampedPose], rng: np.random.Generator
    ) -> Iterator[OdometryReading]:
        """Yield one reading per pose, in a frame that starts at the first one.

        Args:
            trajectory: True planar poses.
            rng: Source of the noise.
        """
        if not trajectory:
            return
        odom_from_body = identity()
        yield OdometryReading(trajectory[0].stamp_s, odom_from_body)
        for before, after in pairwise(trajectory):
            motion = inverse(before.reference_from_body) @ after.reference_from_body
            distance, turn = float(np.hypot(*motion[:2, 3])), yaw_of(motion)
            x, y = rng.normal(
                self.scale * motion[:2, 3], self.sigma_m_per_sqrt_m * math.sqrt(distance)
            )
            yaw = rng.normal(
                turn + self.drift_rad_per_m * distance,
                math.hypot(
                    self.sigma_rad_per_sqrt_m * math.sqrt(distance),
                    self.sigma_rad_per_sqrt_rad * math.sqrt(abs(turn)),
                ),
            )
            odom_from_body = odom_from_body @ planar_pose(x, y, yaw)
            yield OdometryReading(after.stamp_s, odom_from_body)
