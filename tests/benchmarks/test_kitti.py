"""True poses of a hand-made KITTI sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.kitti import read_truth
from hmt_service.errors import InvalidLog

POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 5 1 0 0 -2 0 0 1.001 0.5\n"


def sequence(folder: Path, *, poses: str = POSES) -> Path:
    (folder / "times.txt").write_text("0.0\n1.036e-01\n")
    (folder / "poses.txt").write_text(poses)
    return folder


def test_true_poses_have_the_stamps_of_the_scans_and_proper_rotations(tmp_path: Path) -> None:
    truth = read_truth(sequence(tmp_path))
    assert [pose.stamp_s for pose in truth] == [0.0, 0.1036]
    quarter = np.array([[0.0, -1, 0, 5], [1, 0, 0, -2], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    np.testing.assert_allclose(truth[1].reference_from_body, quarter, atol=1e-12)


def test_a_scan_without_a_pose_is_refused(tmp_path: Path) -> None:
    folder = sequence(tmp_path, poses=POSES.splitlines()[0] + "\n")
    with pytest.raises(InvalidLog, match="2 stamps, 1 poses"):
        read_truth(folder)


def test_a_folder_without_true_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidLog, match="has no true poses"):
        read_truth(tmp_path)
