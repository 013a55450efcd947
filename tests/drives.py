"""A robot's drive through a simulated office as its recorder would have it: a bag of ROS 2."""

from __future__ import annotations

import math
from itertools import islice
from pathlib import Path

import numpy as np

from hmt_service.core.geometry import identity
from hmt_service.core.types import Scan
from hmt_service.io.mcap_writer import McapWriter
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.office import office
from tests.ros import BODY, Ros, Stamped, write_bag2

LASER_FRAME = "laser"
BEAMS = 361
HALF_RAD = math.radians(135.0)
"""Half of what the laser sees."""
BEGIN_S = 1_700_000_000.0
"""Stamp of the first scan: ROS has no stamp 0."""


def write_drive(
    path: Path, scans: int | None = None, *, has_tf: bool = True, is_stamped: bool = True
) -> Path:
    """Write a bag of `LaserScan`, `Odometry` and `tf_static`.

    Args:
        path: Folder of the bag.
        scans: How many scans; None for the whole drive, which comes back to where it began.
        has_tf: Whether anything says where the laser sits.
        is_stamped: Whether readings have stamps.
    """
    ros = Ros()
    body_from_laser = identity()
    body_from_laser[:3, 3] = 0.1, 0.0, 0.3
    sent: list[Stamped] = []
    for instant in islice(simulate(office(3), INDOOR_LASER, 3), scans):
        for reading in instant.readings:
            sent_s = BEGIN_S + reading.stamp_s
            stamp_s = sent_s if is_stamped else 0.0
            if isinstance(reading, Scan):
                message = ros.laser_scan(
                    _ranges_of(reading),
                    stamp_s=stamp_s,
                    frame=LASER_FRAME,
                    angle_min=-HALF_RAD,
                    angle_max=HALF_RAD,
                    angle_increment=2.0 * HALF_RAD / (BEAMS - 1),
                    range_max=20.0,
                )
                sent.append(("/scan", sent_s, message))
            else:
                message = ros.odometry(reading.odom_from_body, stamp_s=stamp_s)
                sent.append(("/odom", sent_s, message))
    if has_tf:
        tree = ros.transforms((BODY, LASER_FRAME, body_from_laser))
        sent.insert(0, ("/tf_static", sent[0][1], tree))
    return write_bag2(path, sent)


def write_log(path: Path, scans: int) -> None:
    """Write the beginning of the drive as an MCAP file of foxglove messages."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        for instant in islice(simulate(office(3), INDOOR_LASER, 3), scans):
            for reading in instant.readings:
                writer.write(reading)
        writer.finish()


def _ranges_of(scan: Scan) -> list[float]:
    """Return the range of each beam, infinite where nothing came back."""
    rays = scan.points_in_body - scan.sensor_in_body
    beams = np.rint((np.arctan2(rays[:, 1], rays[:, 0]) + HALF_RAD) / (2 * HALF_RAD) * (BEAMS - 1))
    ranges = np.full(BEAMS, np.inf)
    ranges[beams.astype(int)] = np.hypot(rays[:, 0], rays[:, 1])
    return list(ranges)
