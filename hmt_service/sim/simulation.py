"""One robot's day: world -> motion -> sensors -> readings, with the truth beside them.

References:
    own.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from pydantic import Field

from hmt_service.core.geometry import FloatArray, Pose
from hmt_service.core.types import Reading, Scan, StampedPose
from hmt_service.sim.declared import Declared, checked
from hmt_service.sim.people import Crowd
from hmt_service.sim.places import RADIUS_M as PLACE_RADIUS_M
from hmt_service.sim.places import Places
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import DeadReckoning, Laser2d, Lidar3d, WheelOdometry
from hmt_service.sim.trajectories import Motion, PathFollower, steps_of
from hmt_service.sim.worlds.world import World

# What is cast at once: enough to keep the threads busy, little enough to stay in small memory.
_RAYS_AT_ONCE = 1 << 16
_SCANS_AT_ONCE = 64


@checked
class Robot(Declared):
    """What drives through a world, and what it declares of its errors."""

    follower: PathFollower = Field(default_factory=PathFollower)
    """How it moves."""
    sensor: Laser2d | Lidar3d = Field(default_factory=Laser2d)
    """What it sees."""
    odometry: WheelOdometry = Field(default_factory=WheelOdometry)
    """What its wheels say."""
    scan_period_s: float = Field(default=0.2, gt=0.0)
    """Time between two scans."""
    drop_share: float = Field(default=0.0, ge=0.0, le=1.0)
    """Probability that a scan is lost; the odometry of its stamp is not."""


INDOOR_LASER = Robot()
"""Slow, in buildings: 270 degrees, 361 beams, 20 m."""
SHORT_SIGHTED = Robot(
    sensor=Laser2d(max_range_m=8.0),
    odometry=WheelOdometry(scale=1.04, drift_rad_per_m=math.radians(0.5)),
)
"""For worlds whose places look alike: neither its laser nor its wheels tell them apart."""
OUTDOOR_LASER = Robot(
    follower=PathFollower(speed_m_s=1.2, turn_rad_s=1.2, caution=4.0),
    sensor=Laser2d(field_of_view_rad=math.pi, max_range_m=30.0),
)
"""Walking pace, between buildings: 180 degrees, 361 beams, 30 m."""
LIDAR = Robot(
    follower=PathFollower(speed_m_s=1.5, turn_rad_s=1.2, caution=4.0),
    sensor=Lidar3d(),
)
"""Up and down ramps: 16 rows of 720 columns, 60 m."""


@dataclass(frozen=True, slots=True, eq=False)
class Instant:
    """What happens at the stamp of one scan."""

    truth: StampedPose
    """True pose in the frame of the world."""
    place: int
    """The place that it is in, numbered from 0 in the order of their discovery."""
    readings: tuple[Reading, ...]
    """The odometry, then the scan unless it was lost; all have the stamp of the truth."""


def simulate(world: World, robot: Robot, seed: int, *, people: int = 0) -> Iterator[Instant]:
    """Drive a robot along the route of a world and yield what happens, one scan after the other.

    Nothing is kept but the places: memory does not grow with the length of the drive.

    Args:
        world: Where it drives.
        robot: What drives.
        seed: Of all noise; the same world, robot and seed give the same bits. The noise of the
            ranges, the odometry, the losses and the people do not depend on each other.
        people: How many people walk up and down beside the route.

    Raises:
        InvalidInput: If the route cannot be driven, or there are fewer people than none.
    """
    range_rng, odometry_rng, drop_rng, crowd_rng = np.random.default_rng(seed).spawn(4)
    drive = robot.follower.drive(world.route_m)
    crowd = Crowd(world.route_m, people, crowd_rng)
    caster = RayCaster(world, max(robot.sensor.reach_m, PLACE_RADIUS_M))
    at_once = min(max(1, _RAYS_AT_ONCE // robot.sensor.rays), _SCANS_AT_ONCE)
    stretches = _stretches(drive, robot.scan_period_s, at_once)
    scans = robot.sensor.observe(caster, crowd, stretches, robot.scan_period_s, range_rng)
    wheels = DeadReckoning(robot.odometry, odometry_rng)
    return _instants(scans, wheels, Places(caster), robot.drop_share, drop_rng)


def _instants(
    scans: Iterator[tuple[StampedPose, Scan]],
    wheels: DeadReckoning,
    places: Places,
    drop_share: float,
    rng: np.random.Generator,
) -> Iterator[Instant]:
    for truth, scan in scans:
        readings: tuple[Reading, ...] = (wheels.reading(truth), scan)
        is_lost = rng.random() < drop_share
        place = places.at(truth.reference_from_body[:3, 3])
        yield Instant(truth, place, readings[:1] if is_lost else readings)


def _stretches(
    drive: Iterator[StampedPose], period_s: float, scans: int
) -> Iterator[tuple[FloatArray, Motion]]:
    """Yield the stamps of so many scans at a time, and the motion from one period before them."""
    poses: deque[Pose] = deque()
    first = number = 0
    while True:
        stamps_s = np.arange(number, number + scans, dtype=np.float64) * period_s
        steps = steps_of(stamps_s)
        missing = math.ceil(steps[-1]) + 1 - first - len(poses)
        poses.extend(each.reference_from_body for each in islice(drive, missing))
        driven = steps <= first + len(poses) - 1
        if driven.any():
            yield stamps_s[driven], Motion(first, np.stack(poses))
        if not driven.all():
            return
        number += scans
        while first + 1 <= steps[-1]:
            poses.popleft()
            first += 1
