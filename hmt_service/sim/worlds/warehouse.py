"""A warehouse: rows of equal racks, aisles between them, docks in front.

References:
    own.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.plan import (
    Box,
    Mesh,
    furniture,
    interior,
    joined,
    lanes,
    mesh_between,
    on_floor,
)
from hmt_service.sim.worlds.world import World

_AISLE_M = 3.0
_CROSS_AISLE_M = 4.0
_RACK_M = 1.1
"""Depth of a rack; two stand back to back in a row."""
_FLUE_M = 0.1
"""Gap between two racks back to back."""
_BAY_M = 2.8
_PALLETS_PER_BAY = 3
_PALLET_M = 0.85
_POST_M = 0.1
_BEAM_M = 0.12
_LEVELS_M = (0.0, 1.8, 3.6)
_HALL_M = 8.0
_DOCK_DOOR_M = 2.6
_PITCH_M = _AISLE_M + 2 * _RACK_M + _FLUE_M


@dataclass(frozen=True, slots=True)
class _Hall:
    """Ground plan; rows run along y, and row k has the aisles k and k + 1 beside it."""

    rows: int
    bays: int
    """Of each half of a row; a cross aisle lies between the halves."""
    dock_m: float
    """Depth of the dock area, y from 0."""

    @property
    def blocks(self) -> tuple[float, float]:
        """First y of both halves of the rows."""
        return self.dock_m, self.dock_m + self.bays * _BAY_M + _CROSS_AISLE_M

    @property
    def cross_aisles(self) -> tuple[float, float, float]:
        """Middle of the ways along x: past the docks, between the halves, and at the far wall."""
        second = self.blocks[1]
        far = second + self.bays * _BAY_M + _CROSS_AISLE_M / 2
        return self.dock_m - 2.5, second - _CROSS_AISLE_M / 2, far

    @property
    def ground(self) -> Box:
        """Everything between the walls."""
        return Box(
            0.0, 0.0, self.rows * _PITCH_M + _AISLE_M, self.cross_aisles[-1] + _CROSS_AISLE_M / 2
        )

    def aisle(self, number: int) -> float:
        """Return the middle of an aisle, x."""
        return number * _PITCH_M + _AISLE_M / 2


def warehouse(seed: int) -> World:
    """Draw a hall of 8 to 11 rows of racks, each a double one, with a cross aisle in the middle.

    The route of 300 m to 500 m runs up and down four aisles, then the first two again, and crosses
    from the third to the fourth in the middle.

    Args:
        seed: The same seed gives the same world.
    """
    rng = np.random.default_rng(seed)
    hall = _Hall(int(rng.integers(8, 12)), int(rng.integers(5, 7)), rng.uniform(9.0, 12.0))
    route = _route(hall, rng)
    doors = _dock_doors(hall, rng)
    staged = _staged(hall, doors, lanes(route), rng)
    mesh = joined([interior([hall.ground, *doors], staged, _HALL_M), _racks(hall, rng)])
    return World(f"warehouse-{seed}", mesh.vertices, mesh.triangles, on_floor(route))


def _route(hall: _Hall, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Draw the order of the aisles; all are among six neighbours."""
    near, middle, far = hall.cross_aisles
    first = int(rng.integers(0, hall.rows - 4))
    a, b, c, d = (hall.aisle(first + int(aisle)) for aisle in rng.permutation(6)[:4])
    ends = (near, far)
    passes = [
        (x, ends[(run + end) % 2]) for run, x in enumerate((a, b, c, d, a, b)) for end in range(2)
    ]
    return [*passes, (c, near), (c, middle), (d, middle), (d, far)]


def _dock_doors(hall: _Hall, rng: np.random.Generator) -> list[Box]:
    """Draw the doors in the wall y = 0, recessed by half a metre."""
    width = hall.ground.x_max
    xs = np.arange(rng.uniform(2.0, 5.0), width - _DOCK_DOOR_M - 2.0, rng.uniform(5.0, 7.0))
    return [Box(x, -0.5, x + _DOCK_DOOR_M, 0.1) for x in xs.tolist()]


def _staged(
    hall: _Hall, doors: list[Box], kept_free: list[Box], rng: np.random.Generator
) -> list[Box]:
    """Draw pallets in rows behind some dock doors, and packing tables and chargers elsewhere."""
    standing = []
    for door in doors:
        for column, row in product(range(2), range(rng.integers(0, 4))):
            x, y = door.x_min + 0.3 + 1.1 * column, 1.0 + 1.4 * row
            shift_x, shift_y = rng.uniform(-0.1, 0.1, 2)
            pallet = Box(x, y, x + 0.8, y + 1.2, rng.uniform(0.3, 1.8))
            standing.append(pallet.moved(shift_x, shift_y))
    docks = Box(0.0, 0.0, hall.ground.x_max, hall.dock_m)
    return standing + furniture(docks, [*standing, *doors, *kept_free], hall.rows, rng)


def _racks(hall: _Hall, rng: np.random.Generator) -> Mesh:
    """Return posts and beams, all alike, and the loads, which vary a little; some are missing."""
    fronts = np.array([hall.aisle(row) + _AISLE_M / 2 for row in range(hall.rows)])
    racks_x = np.concatenate([fronts, fronts + _RACK_M + _FLUE_M])
    height = _LEVELS_M[-1] + 1.8

    posts_y = np.concatenate([first + _BAY_M * np.arange(hall.bays + 1) for first in hall.blocks])
    posts_x = np.concatenate([racks_x, racks_x + _RACK_M - _POST_M])
    corners = _grid(posts_x, posts_y - _POST_M / 2, np.zeros(1))
    posts = mesh_between(corners, corners + (_POST_M, _POST_M, height))

    corners = _grid(posts_x, np.array(hall.blocks), np.array(_LEVELS_M[1:]) - _BEAM_M)
    beams = mesh_between(corners, corners + (_POST_M, hall.bays * _BAY_M, _BEAM_M))

    in_bay = _POST_M + (_BAY_M - _POST_M) / _PALLETS_PER_BAY * np.arange(_PALLETS_PER_BAY)
    bays_y = np.concatenate([first + _BAY_M * np.arange(hall.bays) for first in hall.blocks])
    corners = _grid(racks_x, np.add.outer(bays_y, in_bay).ravel(), np.array(_LEVELS_M))
    corners = corners[rng.random(len(corners)) < 0.85]
    corners[:, :2] += rng.uniform(0.0, 0.05, (len(corners), 2))
    sizes = rng.uniform((0.75, 0.9, 0.9), (_PALLET_M - 0.05, 1.0, 1.5), (len(corners), 3))[
        :, [1, 0, 2]
    ]
    return joined([posts, beams, mesh_between(corners, corners + sizes)])


def _grid(x: FloatArray, y: FloatArray, z: FloatArray) -> FloatArray:
    """Return all combinations, shape (X Y Z, 3)."""
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
