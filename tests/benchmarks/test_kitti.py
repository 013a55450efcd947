"""A hand-made KITTI sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.kitti import read_kitti
from hmt_service.errors import InvalidLog

POSES = "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 5 1 0 0 -2 0 0 1.001 0.5\n"


def sequence(folder: Path, *, poses: str = POSES) -> Path:
    (folder / "velodyne").mkdir()
    for number in range(2):
        rows = [[3.0, 4.0, 0.0, 0.9], [0.1, 0.0, 0.0, 0.1], [90.0 + number, 0.0, 0.0, 0.1]]
        np.array(rows, dtype="<f4").tofile(folder / "velodyne" / f"{number:06d}.bin")
    (folder / "times.txt").write_text("0.0\n1.036e-01\n")
    (folder / "poses.txt").write_text(poses)
    return folder


def test_scans_hold_the_returns_within_the_ranges(tmp_path: Path) -> None:
    scans, _ = read_kitti(sequence(tmp_path), min_range_m=1.0, max_range_m=90.5)
    assert [scan.stamp_s for scan in scans] == [0.0, 0.1036]
    assert scans[0].points_in_body.tolist() == [[3.0, 4.0, 0.0], [90.0, 0.0, 0.0]]
    assert scans[1].points_in_body.tolist() == [[3.0, 4.0, 0.0]]


def test_true_poses_have_the_stamps_of_the_scans_and_proper_rotations(tmp_path: Path) -> None:
    _, truth = read_kitti(sequence(tmp_path), min_range_m=1.0, max_range_m=100.0)
    assert [pose.stamp_s for pose in truth] == [0.0, 0.1036]
    quarter = np.array([[0.0, -1, 0, 5], [1, 0, 0, -2], [0, 0, 1, 0.5], [0, 0, 0, 1]])
    np.testing.assert_allclose(truth[1].reference_from_body, quarter, atol=1e-12)


def test_a_scan_without_a_pose_is_refused(tmp_path: Path) -> None:
    folder = sequence(tmp_path, poses=POSES.splitlines()[0] + "\n")
    with pytest.raises(InvalidLog, match="2 scans, 2 stamps, 1 poses"):
        read_kitti(folder, min_range_m=1.0, max_range_m=100.0)


def test_a_folder_that_is_no_sequence_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidLog, match="is no KITTI sequence"):
        read_kitti(tmp_path, min_range_m=1.0, max_range_m=100.0)
