"""A hall with a floor, walls and pillars, and what a LiDAR with 16 rows sees in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmt_service.core.geometry import FloatArray

HEIGHT_M = 1.7
"""Of the sensor over the floor."""
ROWS, COLUMNS, SCANS = 16, 180, 20


def hall_seen_from(x_m: float, *, half_m: float, length_m: float = 400.0) -> FloatArray:
    """Return the points of one sweep in the sensor's frame, shape (N, 3), in closed form.

    Args:
        x_m: Where along the hall the sensor is.
        half_m: Half of the distance between its two walls; no ceiling.
        length_m: Length, the sensor's x being 0 in the middle.
    """
    azimuth = np.radians(np.arange(COLUMNS) * 360.0 / COLUMNS + 0.3)
    elevation = np.radians(np.linspace(-15.0, 15.0, ROWS))
    level, turn = (grid.ravel() for grid in np.meshgrid(elevation, azimuth, indexing="ij"))
    rays = np.stack(
        [np.cos(level) * np.cos(turn), np.cos(level) * np.sin(turn), np.sin(level)], axis=1
    )
    with np.errstate(divide="ignore"):
        to_wall = half_m / np.abs(rays[:, 1])
        ends = np.where(rays[:, 0] > 0.0, 0.5 * length_m - x_m, 0.5 * length_m + x_m)
        to_end = ends / np.abs(rays[:, 0])
        to_floor = np.where(rays[:, 2] < 0.0, -HEIGHT_M / rays[:, 2], np.inf)
    ranges = np.minimum(np.minimum(to_wall, to_end), to_floor)
    # Every 10 m of the walls there is a pillar 1 m deep.
    along = np.floor((x_m + ranges * rays[:, 0]) / 10.0) % 2.0 == 0.0
    is_pillar = along & (ranges == to_wall)
    ranges = np.where(is_pillar, ranges * (half_m - 1.0) / half_m, ranges)
    return np.asarray(ranges[:, None] * rays)


def write_hall(folder: Path, *, half_m: float, scale: float = 1.0, z_sign: float = 1.0) -> Path:
    """Write 20 scans of a drive of 1 m each through a hall, in the layout of KITTI."""
    (folder / "velodyne").mkdir(parents=True)
    for number in range(SCANS):
        points = hall_seen_from(float(number), half_m=half_m) * scale * [1.0, 1.0, z_sign]
        rows = np.column_stack([points, np.zeros(len(points))])
        rows.astype("<f4").tofile(folder / "velodyne" / f"{number:06d}.bin")
    (folder / "times.txt").write_text("".join(f"{0.1 * n:.3f}\n" for n in range(SCANS)))
    return folder
