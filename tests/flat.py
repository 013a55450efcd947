"""A flat with known walls, and what a robot that drives through it sends."""

from __future__ import annotations

import numpy as np

from hmt_service.core.geometry import FloatArray, Pose, inverse, planar_pose
from hmt_service.core.types import OdometryReading, Reading, Scan
from tests.core import factories

# Two rooms, 8 m x 6 m each, and a door of 1 m between them: x0, y0, x1, y1 of every wall, m.
WALLS = np.array(
    [
        [0.0, 0.0, 16.0, 0.0],
        [16.0, 0.0, 16.0, 6.0],
        [16.0, 6.0, 0.0, 6.0],
        [0.0, 6.0, 0.0, 0.0],
        [8.0, 0.0, 8.0, 2.5],
        [8.0, 3.5, 8.0, 6.0],
        # Furniture: without it the rooms would be symmetric.
        [2.0, 4.5, 3.5, 4.5],
        [12.0, 1.0, 12.0, 2.0],
        [13.5, 4.0, 15.0, 5.0],
    ]
)
BEAMS = 240
SETTINGS = "areas: {max_cut: 0.8}"
"""Makes two areas of the two rooms."""


def ranges_from(world_from_body: Pose, bearings_rad: FloatArray) -> FloatArray:
    """Return the distance to the nearest wall along every bearing, in closed form."""
    return factories.ranges_from(WALLS, world_from_body, bearings_rad)


def path(scans: int) -> list[Pose]:
    """Return poses 0.1 m apart from the left room to the right one, and back, and so on."""
    xs = [1.5 + 12.5 * (1.0 - abs(1.0 - i * 0.1 / 12.5 % 2.0)) for i in range(scans)]
    return [planar_pose(x, 3.0, 0.05 * np.sin(x)) for x in xs]


def readings(scans: int, *, start_s: float = 1000.0, period_s: float = 0.05) -> list[Reading]:
    """Return odometry and scan of a drive through both rooms, in the order of time."""
    bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    directions = np.stack([np.cos(bearings), np.sin(bearings), np.zeros(BEAMS)], axis=1)
    poses = path(scans)
    result: list[Reading] = []
    for index, world_from_body in enumerate(poses):
        stamp_s = start_s + index * period_s
        result.append(OdometryReading(stamp_s, inverse(poses[0]) @ world_from_body))
        points = ranges_from(world_from_body, bearings)[:, None] * directions
        result.append(Scan(stamp_s, points, np.zeros(3)))
    return result
