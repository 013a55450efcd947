"""Simulated sensors: each turns the true motion into the readings that a robot would send.

References:
    Thrun et al., Probabilistic Robotics, 2005, sections 5.4 (odometry) and 6.3 (beams).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import Field

from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, planar_pose, yaw_of
from hmt_service.core.types import OdometryReading, Scan, StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.sim.declared import Declared, checked
from hmt_service.sim.people import Crowd
from hmt_service.sim.raycasting import Fans, RayCaster
from hmt_service.sim.trajectories import Motion

# Noise beyond does not happen in a run.
_MOST_SIGMAS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class _Pattern:
    """The rays of one sweep: a fan per column, a ray per row."""

    azimuths: FloatArray
    """Of the columns in the sensor frame, shape (C,), rad."""
    elevations: FloatArray
    """Of the rows, shape (R,), rad."""
    shares: FloatArray | None = None
    """When each column is taken, as a share of the sweep, shape (C,); None: all at its end."""

    @property
    def directions(self) -> FloatArray:
        """Unit vectors in the sensor frame, column by column, shape (C R, 3)."""
        azimuth, elevation = np.meshgrid(self.azimuths, self.elevations, indexing="ij")
        level = np.cos(elevation)
        parts = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        return np.stack(parts, axis=-1).reshape(-1, 3)

    @property
    def point_times(self) -> FloatArray | None:
        """When each ray is taken, as a share of the sweep, shape (C R,); None: all at its end."""
        return None if self.shares is None else self.shares.repeat(len(self.elevations))

    def times_s(self, stamps_s: FloatArray, period_s: float) -> FloatArray:
        """Return when each column is taken, shape (B, C); all at once: shape (B, 1).

        Args:
            stamps_s: Ends of the sweeps, shape (B,).
            period_s: What a sweep takes.
        """
        shares = np.ones(1) if self.shares is None else self.shares
        return stamps_s[:, None] + (shares - 1.0) * period_s

    def fans(self, world_from_body: FloatArray, sensor_in_body: FloatArray) -> Fans:
        """Return a fan per column of each sweep.

        Args:
            world_from_body: Pose of each sweep, shape (B, 1, 4, 4), or column, (B, C, 4, 4).
            sensor_in_body: Where the rays start, shape (3,), m.
        """
        rotation = world_from_body[..., :3, :3]
        ahead, aside, up = np.moveaxis(rotation, -1, 0)
        origins = rotation @ sensor_in_body + world_from_body[..., :3, 3]
        forward = ahead * np.cos(self.azimuths)[:, None] + aside * np.sin(self.azimuths)[:, None]
        return Fans(origins, up, forward, self.elevations)


class RangeSensor(Declared, ABC):
    """What a laser and a LiDAR have in common."""

    __slots__ = ()

    min_range_m: float
    max_range_m: float
    range_sigma_m: float
    sensor_in_body: tuple[float, float, float]

    def __post_init__(self) -> None:
        """Refuse an empty interval of ranges."""
        if self.min_range_m >= self.max_range_m:
            raise InvalidInput(f"ranges from {self.min_range_m:g} m to {self.max_range_m:g} m")

    @property
    @abstractmethod
    def rays(self) -> int:
        """Number of rays of a scan."""

    @property
    def reach_m(self) -> float:
        """Distance beyond which a surface gives no return, whatever the noise."""
        return self.max_range_m + _MOST_SIGMAS * self.range_sigma_m

    @abstractmethod
    def _pattern(self) -> _Pattern:
        """Return the rays of one sweep."""

    def observe(
        self,
        caster: RayCaster,
        crowd: Crowd,
        stretches: Iterable[tuple[FloatArray, Motion]],
        period_s: float,
        rng: np.random.Generator,
    ) -> Iterator[tuple[StampedPose, Scan]]:
        """Yield one scan per stamp and the true pose then; rays without return are left out.

        Args:
            caster: World that the robot moves in.
            crowd: People in it.
            stretches: Stamps of some scans, shape (B,), which are the ends of their sweeps, and the
                true motion in the frame of the world meanwhile.
            period_s: Time between two scans, all of which a sweep takes.
            rng: Source of the range noise.
        """
        pattern = self._pattern()
        directions, mount = pattern.directions, np.array(self.sensor_in_body)
        point_times = pattern.point_times
        for stamps_s, motion in stretches:
            times_s = pattern.times_s(stamps_s, period_s)
            fans = pattern.fans(motion.at(times_s), mount)
            ranges = caster.ranges(fans)
            crowd.occlude(ranges, fans, times_s, self.reach_m)
            noisy = rng.standard_normal((len(stamps_s), self.rays))
            noisy *= self.range_sigma_m
            noisy += ranges.reshape(noisy.shape)
            truths = map(StampedPose, stamps_s.tolist(), motion.at(stamps_s))
            for truth, each in zip(truths, noisy, strict=True):
                is_return = (each >= self.min_range_m) & (each <= self.max_range_m)
                (returns,) = np.nonzero(is_return)
                points = _points(directions, mount, each, returns)
                shares = None if point_times is None else point_times[returns]
                yield truth, Scan(truth.stamp_s, points, mount, shares)


@checked
class Laser2d(RangeSensor):
    """A planar laser that looks forward and takes a whole scan at once."""

    beams: int = Field(default=361, ge=2)
    """Number of beams."""
    field_of_view_rad: float = Field(default=math.radians(270.0), gt=0.0, le=math.tau)
    """Angle between the first and the last beam."""
    min_range_m: float = Field(default=0.1, ge=0.0)
    """Nearer surfaces give no return."""
    max_range_m: float = Field(default=20.0, gt=0.0)
    """Farther surfaces give no return."""
    range_sigma_m: float = Field(default=0.02, ge=0.0)
    """Standard deviation of one range."""
    sensor_in_body: tuple[float, float, float] = (0.1, 0.0, 0.3)
    """Where the laser sits on the robot, m; its plane is the robot's."""

    @property
    def rays(self) -> int:
        """Number of rays of a scan."""
        return self.beams

    def _pattern(self) -> _Pattern:
        half = self.field_of_view_rad / 2
        return _Pattern(np.linspace(-half, half, self.beams), np.zeros(1))


@checked
class Lidar3d(RangeSensor):
    """A spinning LiDAR that nobody compensates: every column is taken from where the robot is then.

    A sweep takes the whole period between two scans, counter-clockwise from behind, and ends at the
    stamp of the scan. Column c of C is taken at the share (c + 1) / C of the sweep, and its points
    are expressed in the body frame of that moment. `core.local_map.deskew` carries all of them
    into the body frame at the end of the sweep: there is the true pose of the scan.
    """

    rows: int = Field(default=16, ge=1, le=256)
    """Number of lasers above each other."""
    columns: int = Field(default=720, ge=2)
    """Firings of all rows per turn."""
    vertical_fov_rad: float = Field(default=math.radians(30.0), gt=0.0, lt=math.pi)
    """Angle between the lowest and the highest row, half of it above the horizon."""
    min_range_m: float = Field(default=0.5, ge=0.0)
    """Nearer surfaces give no return."""
    max_range_m: float = Field(default=60.0, gt=0.0)
    """Farther surfaces give no return."""
    range_sigma_m: float = Field(default=0.02, ge=0.0)
    """Standard deviation of one range."""
    sensor_in_body: tuple[float, float, float] = (0.0, 0.0, 0.8)
    """Where the LiDAR sits on the robot, m; its axis is the robot's."""

    @property
    def rays(self) -> int:
        """Number of rays of a scan."""
        return self.rows * self.columns

    def _pattern(self) -> _Pattern:
        half = 0.0 if self.rows == 1 else self.vertical_fov_rad / 2
        return _Pattern(
            np.linspace(-math.pi, math.pi, self.columns, endpoint=False),
            np.linspace(-half, half, self.rows),
            np.arange(1, self.columns + 1) / self.columns,
        )


@checked
class WheelOdometry(Declared):
    """Dead reckoning of a wheeled robot: wrong wheel radii, unequal wheels, noise, slip."""

    scale: float = Field(default=1.01, gt=0.0)
    """Measured over true distance."""
    drift_rad_per_m: float = 0.001
    """Systematic error of the heading."""
    sigma_m_per_sqrt_m: float = Field(default=0.02, ge=0.0)
    """Standard deviation of the position along and across the motion after 1 m."""
    sigma_rad_per_sqrt_m: float = Field(default=0.006, ge=0.0)
    """Standard deviation of the heading after 1 m."""
    sigma_rad_per_sqrt_rad: float = Field(default=0.015, ge=0.0)
    """Standard deviation of the heading after a turn of 1 rad."""
    slips_per_m: float = Field(default=0.0, ge=0.0)
    """Mean number of times per metre that the wheels slip (a Poisson process)."""
    slip_m: float = Field(default=0.0, ge=0.0)
    """Mean distance that the wheels turn too far in one slip (exponentially distributed)."""
    slip_sigma_rad: float = Field(default=0.0, ge=0.0)
    """Standard deviation of the heading error of one slip."""


class DeadReckoning:
    """What the wheels add up to, in a frame that starts at the first pose.

    The wheels know nothing of slopes: the readings are planar, and distances are along the ground.
    """

    def __init__(self, wheels: WheelOdometry, rng: np.random.Generator) -> None:
        """Start before the first pose.

        Args:
            wheels: Their errors.
            rng: Source of the noise.
        """
        self._wheels = wheels
        self._rng = rng
        (self._slip_rng,) = rng.spawn(1)
        self._before: StampedPose | None = None
        self._odom_from_body = identity()

    def reading(self, truth: StampedPose) -> OdometryReading:
        """Return the reading at the next true pose."""
        if self._before is not None:
            motion = inverse(self._before.reference_from_body) @ truth.reference_from_body
            self._odom_from_body = self._odom_from_body @ self._measured(motion)
        self._before = truth
        return OdometryReading(truth.stamp_s, self._odom_from_body)

    def _measured(self, motion: Pose) -> Pose:
        """Return what the wheels make of a motion, planar, shape (4, 4)."""
        wheels, rng = self._wheels, self._rng
        distance, turn = float(np.hypot(*motion[:2, 3])), yaw_of(motion)
        x, y = rng.normal(
            wheels.scale * motion[:2, 3], wheels.sigma_m_per_sqrt_m * math.sqrt(distance)
        )
        yaw = rng.normal(
            turn + wheels.drift_rad_per_m * distance,
            math.hypot(
                wheels.sigma_rad_per_sqrt_m * math.sqrt(distance),
                wheels.sigma_rad_per_sqrt_rad * math.sqrt(abs(turn)),
            ),
        )
        slips = self._slip_rng.poisson(wheels.slips_per_m * distance)
        if slips:
            # The sum of exponential draws is a gamma one.
            x += wheels.slip_m * self._slip_rng.gamma(slips)
            yaw += wheels.slip_sigma_rad * math.sqrt(slips) * self._slip_rng.standard_normal()
        return planar_pose(x, y, yaw)


def _points(
    directions: FloatArray, mount: FloatArray, ranges: FloatArray, returns: npt.NDArray[np.intp]
) -> FloatArray:
    """Return what some of the rays meet, in the body frame, shape (N, 3), m.

    One axis after the other takes a fifth of the time.
    """
    points = directions.take(returns, axis=0)
    met_at = ranges.take(returns)
    for axis in range(3):
        along = points[:, axis]
        along *= met_at
        along += mount[axis]
    return points
