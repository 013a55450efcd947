"""True poses of a sequence in the layout of the KITTI odometry benchmark.

    times.txt   one stamp per scan
    poses.txt   first three rows of the pose of each scan, in the frame of the points

References:
    Geiger et al., Are we ready for autonomous driving?, CVPR 2012.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidLog


def read_truth(folder: Path) -> tuple[StampedPose, ...]:
    """Return the true pose of each scan of a sequence.

    Args:
        folder: The sequence.

    Raises:
        InvalidLog: If a file is missing, or their numbers do not agree.
    """
    try:
        stamps_s = np.loadtxt(folder / "times.txt", ndmin=1)
        rows = np.loadtxt(folder / "poses.txt", ndmin=2).reshape(-1, 3, 4)
    except (OSError, ValueError) as error:
        raise InvalidLog(f"{folder.name} has no true poses: {error}") from error
    if len(stamps_s) != len(rows):
        raise InvalidLog(f"{folder.name}: {len(stamps_s)} stamps, {len(rows)} poses")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows
    # The nearest rotations: those in the file are rounded.
    left, _, right = np.linalg.svd(rows[:, :, :3])
    poses[:, :3, :3] = left @ right
    truth = zip(stamps_s.tolist(), poses, strict=True)
    return tuple(StampedPose(stamp_s, pose) for stamp_s, pose in truth)
