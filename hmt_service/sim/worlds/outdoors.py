"""What stands on a campus: buildings, trees, hedges, lamps and cars, each around its own origin.

References:
    own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hmt_service.sim.worlds.corridors import lined
from hmt_service.sim.worlds.plan import Box, Mesh, joined, mesh_of, parked_car, walls_around

_ROOT_M = 0.5
"""Everything reaches so far below its origin: the ground may slope."""
_CORRIDOR_M = 2.8
_ENTRANCE_M = 1.8
_STOREY_M = 3.2


class Thing(NamedTuple):
    """Something that stands on the ground."""

    mesh: Mesh
    """Its origin is in the middle and on the ground."""
    length: float
    """Of its footprint along x, m."""
    width: float
    """Of its footprint along y, m."""


def tree(rng: np.random.Generator) -> Thing:
    """Draw a trunk and a crown above head height."""
    trunk, clear = rng.uniform(0.1, 0.25), rng.uniform(2.2, 3.0)
    crown = _prism(8, rng.uniform(1.0, 2.0), clear, clear + rng.uniform(2.0, 4.0))
    return Thing(joined([_prism(6, trunk, -_ROOT_M, clear), crown]), 1.5, 1.5)


def lamp(_rng: np.random.Generator) -> Thing:
    """Return a lamp post; all are alike."""
    return Thing(_prism(6, 0.08, -_ROOT_M, 5.0), 0.4, 0.4)


def hedge(rng: np.random.Generator) -> Thing:
    """Draw a trimmed hedge."""
    length, width = rng.uniform(3.0, 11.0), rng.uniform(0.6, 1.1)
    return Thing(mesh_of([_standing(length, width, rng.uniform(0.8, 1.6))]), length, width)


def car(rng: np.random.Generator) -> Thing:
    """Draw a parked car."""
    length, width = rng.uniform(3.6, 4.7), rng.uniform(1.6, 1.9)
    return Thing(mesh_of(parked_car(length, width)), length, width)


def building(length: float, width: float, rng: np.random.Generator) -> Thing:
    """Draw a building with a staircase tower and parts that stand out from its front and back."""
    height, half = rng.uniform(3.5, 14.0), width / 2
    boxes = [_standing(length - 2.4, width - 2.4, height)]
    for side in (-1.0, 1.0):
        at = -length / 2 + rng.uniform(1.2, 4.0)
        while (end := at + rng.uniform(0.6, 5.0)) < length / 2 - 1.2:
            depth = rng.uniform(0.2, 1.2)
            y_min, y_max = sorted((side * (half - 1.2), side * (half - 1.2 + depth)))
            boxes.append(Box(at, y_min, end, y_max, height + _ROOT_M, -_ROOT_M))
            at = end + rng.uniform(1.0, 7.0)
    x = rng.uniform(-0.3, 0.3) * length
    boxes.append(Box(x - 2.0, -half, x + 2.0, half, height + 2.5, -_ROOT_M))
    return Thing(mesh_of(boxes), length, width)


def hall(length: float, width: float, rng: np.random.Generator) -> Thing:
    """Draw a building with a corridor through it along x, open at both ends, and rooms."""
    half_x, half_y = length / 2, width / 2
    corridor = Box(0.4 - half_x, -_CORRIDOR_M / 2, half_x - 0.4, _CORRIDOR_M / 2)
    entrances = Box(-half_x, -_ENTRANCE_M / 2, half_x, _ENTRANCE_M / 2)
    outside = Box(-half_x, -half_y, half_x, half_y).grown(1.0)
    around = [
        Box(outside.x_min, outside.y_min, -half_x, outside.y_max),
        Box(half_x, outside.y_min, outside.x_max, outside.y_max),
        Box(outside.x_min, outside.y_min, outside.x_max, -half_y),
        Box(outside.x_min, half_y, outside.x_max, outside.y_max),
    ]
    free, standing = lined([corridor], rng, kept=[box.grown(0.2) for box in around])
    walls = walls_around([*free, entrances, *around], _STOREY_M, is_open=True)
    upper = Box(-half_x, -half_y, half_x, half_y, rng.uniform(0.4, 7.0), _STOREY_M)
    return Thing(joined([walls, mesh_of([*standing, upper])]), length, width)


def _standing(length: float, width: float, height: float) -> Box:
    """Return a box around the origin."""
    return Box(-length / 2, -width / 2, length / 2, width / 2, height + _ROOT_M, -_ROOT_M)


def _prism(sides: int, radius: float, low: float, high: float) -> Mesh:
    """Return an upright prism around the origin."""
    unit = _UNIT_PRISMS[sides]
    vertices = unit.vertices * (radius, radius, high - low) + (0.0, 0.0, low)
    return Mesh(vertices.astype(np.float32), unit.triangles)


def _unit_prism(sides: int) -> Mesh:
    """Return a prism of radius 1 and height 1 that stands on the origin."""
    angles = math.tau / sides * np.arange(sides)
    ring = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    here, after = np.arange(sides), (np.arange(sides) + 1) % sides
    fan = np.column_stack([np.zeros(sides - 2, dtype=np.int64), here[1:-1], here[2:]])
    triangles = [
        np.column_stack([here, after, after + sides]),
        np.column_stack([here, after + sides, here + sides]),
        fan[:, ::-1],
        fan + sides,
    ]
    vertices = np.concatenate([ring, ring + (0.0, 0.0, 1.0)])
    return Mesh(vertices.astype(np.float32), np.concatenate(triangles).astype(np.uint32))


_UNIT_PRISMS = {sides: _unit_prism(sides) for sides in (6, 8)}
