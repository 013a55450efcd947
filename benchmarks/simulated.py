"""Simulated drives as the benchmarks take them.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from hmt_service.core.types import Reading, StampedPose
from hmt_service.sim.sensors import Laser2d, Lidar3d, WheelOdometry
from hmt_service.sim.simulation import LIDAR, Instant, Robot

BLIND = Robot(
    sensor=Laser2d(max_range_m=4.0),
    odometry=WheelOdometry(
        scale=1.1, drift_rad_per_m=0.03, slips_per_m=0.05, slip_m=0.3, slip_sigma_rad=0.1
    ),
)
"""Sees a door or two, only walls beside it in a corridor, and its wheels are always as wrong as the
motion model expects them to be now and then; every 20 m they slip."""
LIDAR_64 = Robot(follower=LIDAR.follower, sensor=Lidar3d(rows=64, columns=1024), scan_period_s=0.1)
"""64 rows of 1024 columns at 10 Hz: up to 65,536 points per scan."""


def readings_of(instants: Iterable[Instant], truth: list[StampedPose]) -> Iterator[Reading]:
    """Yield what the robot sends, and note where it is.

    Args:
        instants: The drive.
        truth: Gets the true pose of every instant.
    """
    for instant in instants:
        truth.append(instant.truth)
        yield from instant.readings
