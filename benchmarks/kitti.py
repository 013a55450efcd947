"""Reader for a sequence in the layout of the KITTI odometry benchmark, with its true poses.

    velodyne/000000.bin ...  four 32-bit floats per point: x, y, z, reflectance
    times.txt                one stamp per scan
    poses.txt                first three rows of the pose of each scan, in the frame of the points

References:
    Geiger et al., Are we ready for autonomous driving?, CVPR 2012.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmt_service.core.types import Scan, StampedPose
from hmt_service.errors import InvalidLog


def read_kitti(
    folder: Path, *, min_range_m: float, max_range_m: float
) -> tuple[tuple[Scan, ...], tuple[StampedPose, ...]]:
    """Return the scans of a sequence, and the true pose of each.

    Args:
        folder: The sequence.
        min_range_m: Returns nearer than this are left out.
        max_range_m: Returns farther than this are left out.

    Raises:
        InvalidLog: If a file is missing, or their numbers do not agree.
    """
    try:
        stamps_s = np.loadtxt(folder / "times.txt", ndmin=1)
        rows = np.loadtxt(folder / "poses.txt", ndmin=2).reshape(-1, 3, 4)
    except (OSError, ValueError) as error:
        raise InvalidLog(f"{folder.name} is no KITTI sequence: {error}") from error
    files = sorted((folder / "velodyne").glob("*.bin"))
    if not len(stamps_s) == len(rows) == len(files):
        raise InvalidLog(
            f"{folder.name}: {len(files)} scans, {len(stamps_s)} stamps, {len(rows)} poses"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    # The nearest rotations: those in the file are rounded.
    left, _, right = np.linalg.svd(rows[:, :, :3])
    poses[:, :3, :3] = left @ right
    scans = []
    for stamp_s, file in zip(stamps_s.tolist(), files, strict=True):
        points = np.fromfile(file, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
        ranges = np.linalg.norm(points, axis=1)
        is_return = (ranges >= min_range_m) & (ranges <= max_range_m)
        scans.append(Scan(stamp_s, points[is_return], np.zeros(3)))
    truth = zip(stamps_s.tolist(), poses, strict=True)
    return tuple(scans), tuple(StampedPose(stamp_s, pose) for stamp_s, pose in truth)
