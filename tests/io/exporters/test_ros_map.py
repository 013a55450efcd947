"""map_server files, read by Pillow and yaml: known walls of the flat are where they should be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import yaml
from PIL import Image

from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, transform_points
from hmt_service.errors import InvalidInput
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.registry import export_map
from hmt_service.io.exporters.ros_map import export_ros_map
from hmt_service.io.placed_map import PlacedMap
from tests.flat import WALLS, path
from tests.mapped import SCANS, map_file_in, mapped

OCCUPIED, FREE, UNKNOWN = 0, 254, 205


@dataclass(frozen=True)
class Grid:
    """What map_server makes of the files."""

    pixels: npt.NDArray[np.uint8]
    resolution_m: float
    origin: tuple[float, float, float]

    @classmethod
    def read(cls, path: Path) -> Grid:
        meaning = yaml.safe_load(path.read_text())
        assert (meaning["negate"], meaning["mode"]) == (0, "trinary")
        # As map_server classifies: what is between the thresholds is unknown.
        shares = {value: (255 - value) / 255 for value in (OCCUPIED, FREE, UNKNOWN)}
        assert shares[OCCUPIED] > meaning["occupied_thresh"] > shares[UNKNOWN]
        assert shares[UNKNOWN] > meaning["free_thresh"] > shares[FREE]
        with Image.open(path.parent / meaning["image"]) as image:
            assert image.mode == "L"
            return cls(np.array(image), meaning["resolution"], tuple(meaning["origin"]))

    def at(self, points: FloatArray, *, around: int = 0) -> npt.NDArray[np.uint8]:
        """Return the darkest pixel within so many pixels of each point."""
        columns = np.floor((points[:, 0] - self.origin[0]) / self.resolution_m).astype(int)
        from_below = np.floor((points[:, 1] - self.origin[1]) / self.resolution_m).astype(int)
        rows = self.pixels.shape[0] - 1 - from_below
        steps = range(-around, around + 1)
        near = [self.pixels[rows + i, columns + j] for i in steps for j in steps]
        return np.asarray(np.min(near, axis=0))


def in_map(points_in_world: FloatArray, reference_from_first: Pose) -> FloatArray:
    """Return points of the flat in the frame of the map."""
    first_from_world = inverse(path(SCANS)[0])
    return transform_points(reference_from_first @ first_from_world, points_in_world)


def on_walls() -> FloatArray:
    """Return points every 0.1 m on the outer walls and on the wall between the rooms."""
    # Corners aside: they are seen at grazing angles.
    shares = np.linspace(0.05, 0.95, 60)[:, None]
    points = [wall[:2] + shares * (wall[2:] - wall[:2]) for wall in WALLS[:6]]
    return np.hstack([np.vstack(points), np.zeros((6 * 60, 1))])


@pytest.mark.parametrize("reference_area", [0, 1])
def test_walls_lie_on_their_pixels_and_rooms_are_free(tmp_path: Path, reference_area: int) -> None:
    target = tmp_path / "flat.yaml"
    export_map(map_file_in(tmp_path), target, Format.ROS_MAP, reference_area=reference_area)
    grid = Grid.read(target)
    (hypothesis,) = mapped().stored().hypotheses
    moved = inverse(hypothesis.reference_from_visit[reference_area])
    assert np.mean(grid.at(in_map(on_walls(), moved), around=1) == OCCUPIED) > 0.9
    inside = np.array([[4.0, 3.0, 0.0], [8.0, 3.0, 0.0], [12.0, 3.0, 0.0], [6.0, 2.0, 0.0]])
    assert list(grid.at(in_map(inside, moved), around=3)) == [FREE] * 4
    outside = np.array([[4.0, -0.15, 0.0], [4.0, 6.15, 0.0], [-0.15, 3.0, 0.0]])
    assert list(grid.at(in_map(outside, moved))) == [UNKNOWN] * 3


def test_wall_half_a_metre_away_would_be_noticed(tmp_path: Path) -> None:
    export_map(map_file_in(tmp_path), tmp_path / "flat.yaml", Format.ROS_MAP)
    grid = Grid.read(tmp_path / "flat.yaml")
    shifted = on_walls() * [1.0, -1.0, 1.0] + [0.0, 6.0 + 0.15, 0.0]
    assert np.mean(grid.at(in_map(shifted, identity()), around=1) == OCCUPIED) < 0.7


def test_map_of_a_lidar_is_refused(tmp_path: Path) -> None:
    spatial = load_config(Preset.INDOOR).model_dump_json()
    placed = PlacedMap.of(replace(mapped().stored(), config_json=spatial))
    with pytest.raises(InvalidInput, match="3-D"):
        export_ros_map(placed, tmp_path / "flat.yaml")
    assert list(tmp_path.iterdir()) == []


def test_only_yaml_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"flat\.pgm does not end in \.yaml"):
        export_map(map_file_in(tmp_path), tmp_path / "flat.pgm", Format.ROS_MAP)


def test_a_stray_point_far_away_is_an_error_with_numbers(tmp_path: Path) -> None:
    stored = mapped().stored()
    stray = np.array([[9e4, 9e4, 0.0]], dtype=np.float32)
    keyframes = (replace(stored.keyframes[0], points_in_body=stray), *stored.keyframes[1:])
    placed = PlacedMap.of(replace(stored, keyframes=keyframes))
    with pytest.raises(InvalidInput, match=r"a map of 18\d+ × 18\d+ cells of 0.05 m"):
        export_ros_map(placed, tmp_path / "flat.yaml")
