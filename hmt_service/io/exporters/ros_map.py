"""An occupancy grid as map_server reads it: an image (`.pgm`) and what it means (`.yaml`).

Every keyframe has one vote per cell: occupied where one of its returns lies, free where its rays
pass and none does. Returns of what moved through are left out, as in submaps.

References:
    http://wiki.ros.org/map_server (the format; trinary: 0 occupied, 254 free, 205 unknown).
    Grisetti et al., GMapping, T-RO 2007: counts of hits and visits per cell.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import yaml

from hmt_service.core.geometry import FloatArray, transform_points
from hmt_service.errors import InvalidInput
from hmt_service.io.placed_map import PlacedMap
from hmt_service.io.whole_files import whole_files

RESOLUTION_M = 0.05
"""Edge of a cell, as usual for map_server."""
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
# A cell is occupied when such a share of the votes says so: walls are thinner than cells.
_OCCUPIED_SHARE = 0.25
_MARGIN_CELLS = 4
_MAX_CELLS = 2**28
_RAYS_AT_ONCE = 4096
_SUFFIXES = (".yaml", ".yml")

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """The cells that a map covers."""

    first_x: int
    """Column of the leftmost cell, counted from the origin of the frame."""
    first_y: int
    """Row of the lowest cell, counted from the origin of the frame."""
    width: int
    """Number of columns."""
    height: int
    """Number of rows."""

    def cells(self, points: FloatArray) -> npt.NDArray[np.int64]:
        """Return the number of the cell that each point is in, rows from below, shape (N,)."""
        at = np.floor(points[:, :2] / RESOLUTION_M).astype(np.int64)
        return (at[:, 1] - self.first_y) * self.width + (at[:, 0] - self.first_x)


def export_ros_map(placed: PlacedMap, path: Path) -> None:
    """Write `path`, and the image of the same name beside it.

    Raises:
        InvalidInput: If the map is not planar or too large, or `path` does not end in `.yaml`.
    """
    if not placed.config.sensor.is_planar:
        raise InvalidInput("a map of a 3-D sensor is no floor plan: ros-map is for planar maps")
    if path.suffix not in _SUFFIXES:
        raise InvalidInput(f"{path.name} does not end in {' or '.join(_SUFFIXES)}")
    image_path = path.with_suffix(".pgm")
    looks = list(_looks(placed))
    grid = _grid_around(looks)
    image = _image(looks, grid)
    meaning = {
        "image": image_path.name,
        "mode": "trinary",
        "resolution": RESOLUTION_M,
        "origin": [grid.first_x * RESOLUTION_M, grid.first_y * RESOLUTION_M, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        # Less than what 205 means, 50 of 255.
        "free_thresh": 0.196,
    }
    with whole_files(image_path, path) as (image_part, part):
        image_part.write_bytes(f"P5\n{grid.width} {grid.height}\n255\n".encode() + image.tobytes())
        part.write_text(yaml.safe_dump(meaning, sort_keys=False))


def _looks(placed: PlacedMap) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield position of the sensor and returns of every keyframe, (3,) and (N, 3), m."""
    from hmt_service.core.transients import without_transients

    for visit in placed.visits:
        reference_from_visit = placed.reference_from_visit[visit.visit]
        poses = [reference_from_visit @ pose.mean for pose in visit.visit_from_keyframe]
        clouds = without_transients(visit.keyframes, poses, placed.config)
        for keyframe, pose, cloud in zip(visit.keyframes, poses, clouds, strict=True):
            yield transform_points(pose, keyframe.sensor_in_body[None])[0], cloud


def _grid_around(looks: list[tuple[FloatArray, FloatArray]]) -> _Grid:
    """Return the smallest grid around everything that was seen, with a margin."""
    ends = [np.vstack([sensor[None], returns])[:, :2] for sensor, returns in looks]
    low = np.min([each.min(axis=0) for each in ends], axis=0)
    high = np.max([each.max(axis=0) for each in ends], axis=0)
    first_x, first_y = (math.floor(v / RESOLUTION_M) - _MARGIN_CELLS for v in low)
    last_x, last_y = (math.floor(v / RESOLUTION_M) + _MARGIN_CELLS for v in high)
    width, height = last_x - first_x + 1, last_y - first_y + 1
    if width * height > _MAX_CELLS:
        raise InvalidInput(
            f"a map of {width} × {height} cells of {RESOLUTION_M} m is larger than {_MAX_CELLS}"
        )
    return _Grid(first_x, first_y, width, height)


def _image(looks: list[tuple[FloatArray, FloatArray]], grid: _Grid) -> Image:
    """Return the pixels, the highest row first, shape (height, width)."""
    occupied = np.zeros(grid.width * grid.height, dtype=np.int32)
    free = np.zeros_like(occupied)
    for sensor, returns in looks:
        hit = np.unique(grid.cells(returns))
        passed = [grid.cells(points) for points in _along(sensor, returns)]
        occupied[hit] += 1
        free[np.setdiff1d(np.concatenate([np.zeros(0, np.int64), *passed]), hit)] += 1
    votes = occupied + free
    image = np.full(votes.shape, _UNKNOWN, dtype=np.uint8)
    image[votes > 0] = _FREE
    image[(occupied > 0) & (occupied >= _OCCUPIED_SHARE * votes)] = _OCCUPIED
    return image.reshape(grid.height, grid.width)[::-1]


def _along(sensor: FloatArray, returns: FloatArray) -> Iterator[FloatArray]:
    """Yield points on the rays half a cell apart, from the sensor to the returns."""
    step_m = 0.5 * RESOLUTION_M
    for first in range(0, len(returns), _RAYS_AT_ONCE):
        rays = returns[first : first + _RAYS_AT_ONCE] - sensor
        steps = np.ceil(np.linalg.norm(rays[:, :2], axis=1) / step_m).astype(np.int64)
        # Numbers 0, 1, ... within each ray.
        number = np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)
        shares = number / np.repeat(np.maximum(steps, 1), steps)
        yield sensor + shares[:, None] * np.repeat(rays, steps, axis=0)
