"""Parts of worlds: upright boxes, walls around free space, furniture, and the meshes they make.

References:
    own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray

WALL_M = 0.15
"""Thickness of a wall."""
CEILING_M = 2.5
"""Height of a storey."""
SLAB_M = 0.25
"""Thickness of a floor or ceiling."""
CLEARANCE_M = 0.8
"""Space kept free of furniture on both sides of a route."""
_RASTER_M = 1.0 / 1024.0
"""Corners of walls lie on multiples of this, which float32 holds exactly within 16 km."""
_TRIES = 8


class Mesh(NamedTuple):
    """Triangles that are a part of a world."""

    vertices: npt.NDArray[np.float32]
    """Shape (V, 3), m."""
    triangles: npt.NDArray[np.uint32]
    """Rows of `vertices`, shape (T, 3)."""


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box on the ground, all in m."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    height: float = CEILING_M
    base: float = 0.0
    """Height of its underside above the origin."""

    def overlaps(self, other: Box) -> bool:
        """Return whether the two share ground."""
        return (
            self.x_min < other.x_max
            and other.x_min < self.x_max
            and self.y_min < other.y_max
            and other.y_min < self.y_max
        )

    def grown(self, margin: float) -> Box:
        """Return the box with a margin on all four sides."""
        return Box(
            self.x_min - margin,
            self.y_min - margin,
            self.x_max + margin,
            self.y_max + margin,
            self.height,
            self.base,
        )

    def moved(self, x: float, y: float, quarter_turns: int = 0, z: float = 0.0) -> Box:
        """Return the box turned counter-clockwise about the origin, then shifted."""
        x_min, y_min, x_max, y_max = self.x_min, self.y_min, self.x_max, self.y_max
        for _ in range(quarter_turns % 4):
            x_min, y_min, x_max, y_max = -y_max, x_min, -y_min, x_max
        return Box(x + x_min, y + y_min, x + x_max, y + y_max, self.height, z + self.base)


def wall_along_x(x_min: float, x_max: float, y: float) -> Box:
    """Return a wall that runs along x, its middle at y."""
    half = WALL_M / 2
    return Box(x_min, y - half, x_max, y + half)


def wall_along_y(x: float, y_min: float, y_max: float) -> Box:
    """Return a wall that runs along y, its middle at x."""
    half = WALL_M / 2
    return Box(x - half, y_min - half, x + half, y_max + half)


def floor(area: Box, z: float = 0.0) -> Box:
    """Return a slab under an area, its upper side at z."""
    return Box(area.x_min, area.y_min, area.x_max, area.y_max, SLAB_M, z - SLAB_M)


def ceiling(area: Box, z: float = CEILING_M) -> Box:
    """Return a slab over an area, its underside at z."""
    return Box(area.x_min, area.y_min, area.x_max, area.y_max, SLAB_M, z)


def bounds(boxes: Sequence[Box]) -> Box:
    """Return the smallest area that holds all boxes."""
    return Box(
        min(box.x_min for box in boxes),
        min(box.y_min for box in boxes),
        max(box.x_max for box in boxes),
        max(box.y_max for box in boxes),
    )


def lanes(route: Sequence[tuple[float, float]], margin: float = CLEARANCE_M) -> list[Box]:
    """Return the ground within a margin of each leg of a route; legs run along x or y."""
    return [
        Box(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)).grown(margin)
        for (x0, y0), (x1, y1) in pairwise(route)
    ]


def on_floor(route: Sequence[tuple[float, float]] | FloatArray) -> FloatArray:
    """Return the waypoints, shape (W, 2), at height 0, each different from the one before."""
    points = np.column_stack([np.asarray(route, dtype=np.float64), np.zeros(len(route))])
    is_new = np.any(np.diff(points, axis=0) != 0.0, axis=1)
    return np.vstack([points[:1], points[1:][is_new]])


def furniture(
    room: Box, kept_free: Sequence[Box], pieces: int, rng: np.random.Generator
) -> list[Box]:
    """Draw desks, shelves and cupboards, most with their back to a wall.

    Args:
        room: Ground inside the walls.
        kept_free: No piece stands here.
        pieces: Number to draw; one that finds no place is left out.
        rng: Source of the draw.
    """
    standing: list[Box] = []
    for _ in range(pieces):
        for _ in range(_TRIES):
            length, depth = rng.uniform(0.5, 1.8), rng.uniform(0.35, 0.8)
            side = rng.integers(5)
            size_x, size_y = (length, depth) if side % 2 == 0 else (depth, length)
            size_x = min(size_x, room.x_max - room.x_min)
            size_y = min(size_y, room.y_max - room.y_min)
            x = rng.uniform(room.x_min, room.x_max - size_x)
            y = rng.uniform(room.y_min, room.y_max - size_y)
            if side < 2:
                x, y = (x, room.y_min) if side == 0 else (room.x_min, y)
            elif side < 4:
                x, y = (x, room.y_max - size_y) if side == 2 else (room.x_max - size_x, y)
            piece = Box(x, y, x + size_x, y + size_y, rng.uniform(0.7, 2.0))
            if not any(piece.overlaps(other) for other in (*kept_free, *standing)):
                standing.append(piece)
                break
    return standing


def parked_car(length: float, width: float) -> list[Box]:
    """Return a car that stands at the origin and looks along x."""
    body = Box(-length / 2, -width / 2, length / 2, width / 2, 0.85)
    cabin = Box(-0.35 * length, -0.42 * width, 0.2 * length, 0.42 * width, 0.6, 0.85)
    return [body, cabin]


# A unit box: bit 0 of a corner's number is x, bit 1 is y, bit 2 is z.
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=np.float64)
_QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
_FACES = np.array([face for a, b, c, d in _QUADS for face in ((a, b, c), (a, c, d))])


def mesh_of(boxes: Sequence[Box]) -> Mesh:
    """Return the closed surfaces of B boxes: 8 B vertices, 12 B triangles."""
    low = np.array([(box.x_min, box.y_min, box.base) for box in boxes])
    high = np.array([(box.x_max, box.y_max, box.base + box.height) for box in boxes])
    return mesh_between(low, high)


def mesh_between(low: FloatArray, high: FloatArray) -> Mesh:
    """Return the closed surfaces of B boxes, given their lowest and highest corners, (B, 3), m."""
    return hexahedra(low[:, None] + _CORNERS * (high - low)[:, None])


def hexahedra(corners: FloatArray) -> Mesh:
    """Return the closed surfaces of B boxes that may be turned or sheared.

    Args:
        corners: Shape (B, 8, 3), m; bit 0 of a corner's number is x, bit 1 is y, bit 2 is z.
    """
    triangles = _FACES + 8 * np.arange(len(corners))[:, None, None]
    return Mesh(
        corners.reshape(-1, 3).astype(np.float32), triangles.reshape(-1, 3).astype(np.uint32)
    )


def quads(corners: FloatArray) -> Mesh:
    """Return Q four-sided sheets, seen from both sides, from their corners, shape (Q, 4, 3), m."""
    triangles = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(corners))[:, None, None]
    return Mesh(
        corners.reshape(-1, 3).astype(np.float32), triangles.reshape(-1, 3).astype(np.uint32)
    )


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return all meshes as one."""
    firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        np.vstack([mesh.vertices for mesh in meshes]),
        np.vstack(
            [mesh.triangles + np.uint32(first) for mesh, first in zip(meshes, firsts, strict=True)]
        ),
    )


def placed(mesh: Mesh, x: float, y: float, z: float, yaw_rad: float = 0.0) -> Mesh:
    """Return a mesh turned about the upright axis of the origin, then shifted."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    vertices = mesh.vertices @ turn.T + (x, y, z)
    return Mesh(vertices.astype(np.float32), mesh.triangles)


def walls_around(free: Sequence[Box], height: float = CEILING_M, *, is_open: bool = False) -> Mesh:
    """Return the walls of a building as a robot inside sees them: the border of all free space.

    Args:
        free: Ground of corridors, rooms and doorways; what they share is one space.
        height: Of the walls, which stand at height 0.
        is_open: Whether there are no walls on the rectangle around all of it.
    """
    ground = np.array([(box.x_min, box.y_min, box.x_max, box.y_max) for box in free])
    ground = np.round(ground / _RASTER_M) * _RASTER_M
    xs, ys = np.unique(ground[:, [0, 2]]), np.unique(ground[:, [1, 3]])
    # Cell (i, j) lies left of xs[i] and below ys[j]; those at the edge are outside of everything.
    is_free = np.zeros((len(xs) + 1, len(ys) + 1), dtype=np.int8)
    first_x, first_y = (np.searchsorted(xs, ground[:, 0]), np.searchsorted(ys, ground[:, 1]))
    last_x, last_y = (np.searchsorted(xs, ground[:, 2]), np.searchsorted(ys, ground[:, 3]))
    for x0, y0, x1, y1 in zip(first_x, first_y, last_x, last_y, strict=True):
        is_free[x0 + 1 : x1 + 1, y0 + 1 : y1 + 1] = 1
    x, low, high = _borders(is_free, xs, ys)
    along_y = np.stack([np.column_stack([x, low]), np.column_stack([x, high])], axis=1)
    y, low, high = _borders(is_free.T, ys, xs)
    along_x = np.stack([np.column_stack([low, y]), np.column_stack([high, y])], axis=1)
    walls = np.concatenate([along_y, along_x])
    if is_open:
        is_outermost = (walls == (xs[0], ys[0])) | (walls == (xs[-1], ys[-1]))
        walls = walls[~is_outermost.all(axis=1).any(axis=1)]
    return fences(walls, height)


def interior(free: Sequence[Box], standing: Sequence[Box], height: float = CEILING_M) -> Mesh:
    """Return the walls around free space, what stands in it, one floor and one ceiling."""
    area = bounds(free)
    return joined(
        [walls_around(free, height), mesh_of([*standing, floor(area), ceiling(area, height)])]
    )


def fences(segments: FloatArray, height: float, base: float = 0.0) -> Mesh:
    """Return upright sheets over segments, shape (S, 2, 2), m, from `base` upwards."""
    corners = np.empty((len(segments), 4, 3))
    corners[:, :2, :2], corners[:, 2:, :2] = segments, segments[:, ::-1]
    corners[:, :2, 2], corners[:, 2:, 2] = base, base + height
    return quads(corners)


def _borders(
    is_free: npt.NDArray[np.int8], across: FloatArray, along: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, start and end of each straight border that is crossed by the first axis."""
    steps = np.diff(is_free, axis=0)
    inner = steps[:, 1:-1]
    is_start = (inner != 0) & (inner != steps[:, :-2])
    is_end = (inner != 0) & (inner != steps[:, 2:])
    line, start = np.nonzero(is_start)
    _, end = np.nonzero(is_end)
    return across[line], along[start], along[end + 1]
