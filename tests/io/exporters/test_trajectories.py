"""TUM and KITTI files, read by evo and compared with what the engine says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from hmt_service.core.geometry import inverse
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.registry import export_map
from tests.mapped import SCANS, map_file_in, mapped


def test_tum_is_the_trajectory_of_the_engine(tmp_path: Path) -> None:
    export_map(map_file_in(tmp_path), tmp_path / "out.tum", Format.TUM)
    read, expected = file_interface.read_tum_trajectory_file(tmp_path / "out.tum"), mapped()
    assert read.num_poses == SCANS
    for stamp_s, pose, known in zip(
        read.timestamps, read.poses_se3, expected.trajectory(), strict=True
    ):
        assert stamp_s == pytest.approx(known.stamp_s, abs=1e-6)
        np.testing.assert_allclose(pose, known.reference_from_body, atol=1e-8)


def test_kitti_is_the_trajectory_in_the_frame_of_the_chosen_area(tmp_path: Path) -> None:
    engine = mapped()
    export_map(map_file_in(tmp_path), tmp_path / "out.txt", Format.KITTI, reference_area=1)
    read = file_interface.read_kitti_poses_file(tmp_path / "out.txt").poses_se3
    area_from_first = inverse(engine.stored().hypotheses[0].reference_from_visit[1])
    assert len(read) == SCANS
    assert np.linalg.norm(area_from_first[:3, 3]) > 3.0
    for pose, known in zip(read, engine.trajectory(), strict=True):
        np.testing.assert_allclose(pose, area_from_first @ known.reference_from_body, atol=1e-8)
