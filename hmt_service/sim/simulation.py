"""One robot's day: world -> trajectory -> sensors -> readings, with the truth beside them.

References:
    own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_service.core.types import Reading, StampedPose
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import Laser2d, WheelOdometry
from hmt_service.sim.trajectories import PathFollower
from hmt_service.sim.worlds.world import World


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """What the robot sent, and where it really was."""

    readings: tuple[Reading, ...]
    """In the order of their stamps; at each stamp the odometry, then the scan."""
    truth: tuple[StampedPose, ...]
    """True poses in the frame of the world, one per scan."""


def simulate(
    world: World,
    seed: int,
    *,
    follower: PathFollower | None = None,
    laser: Laser2d | None = None,
    odometry: WheelOdometry | None = None,
) -> Simulation:
    """Drive a robot along the route of a world.

    Args:
        world: Where it drives.
        seed: Of all noise; the same world and seed give the same bits.
        follower: How it moves; None: a slow indoor robot.
        laser: What it sees; None: a 2-D laser of 270 degrees and 20 m.
        odometry: What its wheels say; None: several metres of drift over an office.
    """
    laser_rng, odometry_rng = np.random.default_rng(seed).spawn(2)
    truth = (follower or PathFollower()).drive(world.route_m[:, :2])
    scans = (laser or Laser2d()).observe(RayCaster(world), truth, laser_rng)
    wheels = (odometry or WheelOdometry()).observe(truth, odometry_rng)
    readings = (reading for pair in zip(wheels, scans, strict=True) for reading in pair)
    return Simulation(tuple(readings), truth)
