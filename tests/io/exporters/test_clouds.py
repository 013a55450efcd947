"""PLY and PCD files, read by Open3D and compared with what the engine serves."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import KDTree

from hmt_service.core.geometry import FloatArray, inverse, transform_points
from hmt_service.core.types import MapMethod
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.registry import export_map
from tests.mapped import map_file_in, mapped


def served_points(reference_area: int) -> FloatArray:
    """Return the points of the engine's global map."""
    served = mapped().global_map(MapMethod.CONSISTENT, reference_area=reference_area)
    return np.concatenate(
        [transform_points(a.reference_from_area.mean, a.points_in_area) for a in served.areas]
    )


@pytest.mark.parametrize("form", [Format.PLY, Format.PCD])
@pytest.mark.parametrize("reference_area", [0, 1])
def test_cloud_is_that_of_the_engine(tmp_path: Path, form: Format, reference_area: int) -> None:
    path = tmp_path / f"out.{form}"
    export_map(map_file_in(tmp_path), path, form, reference_area=reference_area)
    read = np.asarray(o3d.io.read_point_cloud(str(path)).points)
    expected = served_points(reference_area)
    # Points of the file are rounded to 5 mm before one of each cell is chosen.
    distances, _ = KDTree(expected).query(read)
    assert len(read) == pytest.approx(len(expected), rel=0.1)
    assert len(read) > 500
    assert np.quantile(distances, 0.9) < 0.01
    assert np.max(distances) < 0.2


def test_frames_of_the_areas_differ() -> None:
    (hypothesis,) = mapped().stored().hypotheses
    moved = inverse(hypothesis.reference_from_visit[1])
    assert np.linalg.norm(moved[:3, 3]) > 3.0
