"""A parking garage: floors that look alike, one above the other, joined by ramps.

References:
    own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.plan import (
    SLAB_M,
    Box,
    Mesh,
    ceiling,
    fences,
    floor,
    hexahedra,
    joined,
    mesh_of,
    parked_car,
    wall_along_x,
    wall_along_y,
)
from hmt_service.sim.worlds.world import World

_STALL_M = (2.5, 5.0)
"""Width and depth of a parking space."""
_AISLE_M = 6.0
_DEPTH_M = 4 * _STALL_M[1] + 2 * _AISLE_M
"""Of a floor along y: a row of spaces, an aisle, a double row, an aisle, a row."""
_SOUTH_M = _STALL_M[1] + _AISLE_M / 2
_NORTH_M = _DEPTH_M - _SOUTH_M
"""Middle of both aisles along x."""
_END_M = 4.0
"""From the end walls to the middle of the aisles along y."""
_COLUMN_M = 0.5
_BAY_M = 3 * _STALL_M[0]
"""From column to column."""
_OTHER_CARS_SHARE = 0.2
"""Of the spaces of a floor that are not as on the other floors."""

_RAMP_M = 5.0
"""Width of a straight ramp."""
_RAMP_BAYS = 4
"""Its length, in distances of columns."""
_RAMP_PILLARS = 6

_INNER_M, _OUTER_M = 5.0, 9.5
"""Radii of a spiral."""
_SECTORS = 36
"""Of one turn of a spiral."""
_FLAT_SECTORS = 3
"""Of a spiral, before and after each floor."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """What the floors share."""

    width: float
    """Of a floor along x."""
    storey: float
    """From floor to floor."""
    floors: int

    @property
    def levels(self) -> list[float]:
        """Height of each floor."""
        return [self.storey * floor for floor in range(self.floors)]

    @property
    def height(self) -> float:
        """Of the whole building."""
        return self.storey * self.floors

    @property
    def ground(self) -> Box:
        """Of one floor, without the ramps."""
        return Box(0.0, 0.0, self.width, _DEPTH_M)

    def at(self, level: int, points: list[tuple[float, float]]) -> list[list[float]]:
        """Return points on a floor."""
        return [[x, y, self.levels[level]] for x, y in points]

    def tall(self, *walls: Box) -> list[Box]:
        """Return walls that go through all floors."""
        return [Box(wall.x_min, wall.y_min, wall.x_max, wall.y_max, self.height) for wall in walls]


@dataclass(frozen=True, slots=True)
class _Ramps:
    """How the floors are joined."""

    mesh: Mesh
    """Ramps, with all walls except those in the south and west of the floors."""
    route_m: FloatArray
    """Through all floors and back to the first, shape (W, 3)."""
    kept_free: list[Box]
    """Ground on every floor where nobody may park."""


def garage(seed: int, floors: int = 3) -> World:
    """Draw floors with the same columns and, but for some, the same parked cars.

    They are joined by straight ramps along one side, or by a spiral, as the seed decides. The
    route goes up to the last floor, around each, and down again; it is 550 m to 650 m long with
    three floors, and 220 m to 250 m longer with each further one.

    Args:
        seed: The same seed gives the same world.
        floors: Number of floors, 2 or more.
    """
    rng = np.random.default_rng(seed)
    width = 4 * _END_M + _STALL_M[0] * rng.integers(14, 18)
    plan = _Plan(width, rng.uniform(2.8, 3.1), floors)
    ramps = (_straight_ramps if rng.random() < 0.5 else _spiral)(plan, rng)
    stairs_x = 2 * _END_M + _STALL_M[0] * rng.integers(2, 10)
    stairs = Box(stairs_x, _DEPTH_M / 2 - 3.0, stairs_x + 2 * _STALL_M[0], _DEPTH_M / 2 + 3.0)
    building = [
        *(floor(plan.ground, z) for z in plan.levels),
        ceiling(plan.ground, plan.height),
        *plan.tall(wall_along_x(0.0, width, 0.0), wall_along_y(0.0, 0.0, _DEPTH_M)),
        *plan.tall(stairs, *_columns(plan)),
    ]
    cars = _cars(plan, [stairs, *ramps.kept_free], rng)
    mesh = joined([mesh_of([*building, *cars]), ramps.mesh])
    return World(f"garage-{seed}", mesh.vertices, mesh.triangles, ramps.route_m)


def _columns(plan: _Plan) -> list[Box]:
    """Return the columns along both aisles."""
    half = _COLUMN_M / 2
    return [
        Box(x - half, y - half, x + half, y + half)
        for x in np.arange(2 * _END_M, plan.width - 2 * _END_M + half, _BAY_M).tolist()
        for aisle in (_SOUTH_M, _NORTH_M)
        for y in (aisle - _AISLE_M / 2 - half, aisle + _AISLE_M / 2 + half)
    ]


def _cars(plan: _Plan, kept_free: list[Box], rng: np.random.Generator) -> list[Box]:
    """Draw cars for one floor, park them on all floors, and change some on each."""
    cars = []
    spaces = np.arange(2 * _END_M, plan.width - 2 * _END_M, _STALL_M[0]) + _STALL_M[0] / 2
    offset = (_AISLE_M + _STALL_M[1]) / 2
    for x in spaces.tolist():
        for y in (_SOUTH_M - offset, _SOUTH_M + offset, _NORTH_M - offset, _NORTH_M + offset):
            usual = _space(x, y, rng)
            for z in plan.levels:
                other = _space(x, y, rng)
                car = other if rng.random() < _OTHER_CARS_SHARE else usual
                if not any(box.overlaps(area) for box in car for area in kept_free):
                    cars += [box.moved(0.0, 0.0, z=z) for box in car]
    return cars


def _space(x: float, y: float, rng: np.random.Generator) -> list[Box]:
    """Draw what stands in a parking space: a car, or nothing."""
    car = parked_car(rng.uniform(3.6, 4.7), rng.uniform(1.6, 1.9))
    shift_x, shift_y = rng.uniform(-0.15, 0.15, 2)
    quarter_turns = 1 + 2 * int(rng.integers(2))
    is_taken = rng.random() < 0.65
    return [box.moved(x + shift_x, y + shift_y, quarter_turns) for box in car if is_taken]


def _straight_ramps(plan: _Plan, rng: np.random.Generator) -> _Ramps:
    """Return ramps one above the other along the north side, all rising eastwards.

    The route drives around each floor from the upper end of one ramp to the lower end of the next;
    on its way down it takes the direct way.
    """
    low_x, high_x = 2 * _END_M, 2 * _END_M + _RAMP_BAYS * _BAY_M
    north, middle = _DEPTH_M + _RAMP_M, _DEPTH_M + _RAMP_M / 2
    opening = Box(high_x + 0.25, _NORTH_M + _AISLE_M / 2, high_x + _BAY_M - 0.25, _DEPTH_M)
    ramp = np.array([[x, y] for y in (_DEPTH_M, north) for x in (low_x, high_x)])
    corners = np.empty((plan.floors - 1, 8, 3))
    corners[:, :4, :2] = corners[:, 4:, :2] = ramp
    corners[:, 4::2, 2] = np.array(plan.levels[:-1])[:, None]
    corners[:, 5::2, 2] = np.array(plan.levels[1:])[:, None]
    corners[:, :4, 2] = corners[:, 4:, 2] - SLAB_M

    landings = Box(0.0, _DEPTH_M, low_x, north), Box(high_x, _DEPTH_M, plan.width, north)
    boxes = [
        *(floor(landing, z) for landing in landings for z in plan.levels),
        ceiling(Box(0.0, _DEPTH_M, plan.width, north), plan.height),
        *plan.tall(
            wall_along_x(low_x - 0.25, opening.x_min, _DEPTH_M),
            wall_along_x(opening.x_max, plan.width, _DEPTH_M),
            wall_along_x(0.0, plan.width, north),
            wall_along_y(0.0, _DEPTH_M, north),
            wall_along_y(plan.width, 0.0, north),
            *(_pillar(x, north) for x in rng.uniform(low_x, high_x, _RAMP_PILLARS)),
        ),
        # There is no ramp further up, and none further down.
        wall_along_y(low_x, _DEPTH_M, north).moved(0.0, 0.0, z=plan.levels[-1]),
        wall_along_y(high_x, _DEPTH_M, north),
    ]

    west, out_x, east = _END_M, high_x + _BAY_M / 2, plan.width - _END_M
    around = [(east, _NORTH_M), (east, _SOUTH_M), (west, _SOUTH_M), (west, _NORTH_M)]
    lower = [(west, _NORTH_M), (west, middle), (low_x, middle)]
    upper = [(high_x, middle), (out_x, middle), (out_x, _NORTH_M)]
    last = plan.floors - 1
    route = plan.at(0, lower[:1])
    for number in range(last):
        route += plan.at(number, around + lower[1:]) + plan.at(number + 1, upper)
    route += plan.at(last, [*around, upper[-1]])
    for number in reversed(range(last)):
        route += plan.at(number + 1, upper[-2::-1]) + plan.at(number, lower[::-1])
        if number > 0:
            route += plan.at(number, upper[-1:])
    mesh = joined([mesh_of(boxes), hexahedra(corners)])
    return _Ramps(mesh, np.array(route), [opening])


def _spiral(plan: _Plan, rng: np.random.Generator) -> _Ramps:
    """Return a spiral in a tower in the east, with a level part at each floor.

    The route drives around each floor, and down the spiral without leaving it.
    """
    middle = _DEPTH_M / 2
    centre = np.array([plan.width + _OUTER_M, middle])
    sectors = np.arange(-_FLAT_SECTORS, _SECTORS * (plan.floors - 1) + _FLAT_SECTORS + 1)
    rising = _SECTORS - 2 * _FLAT_SECTORS
    turns, within = np.divmod(sectors, _SECTORS)
    z = plan.storey * (turns + np.clip((within - _FLAT_SECTORS) / rising, 0.0, 1.0))
    angles = math.tau / _SECTORS * sectors
    # From the middle of the tower, angle 0 looks west, where the floors are.
    outwards = -np.column_stack([np.cos(angles), np.sin(angles)])
    inner, outer = centre + _INNER_M * outwards, centre + _OUTER_M * outwards
    corners = np.empty((len(sectors) - 1, 8, 3))
    for end, radius in enumerate((inner, outer)):
        corners[:, end::4, :2] = radius[:-1, None]
        corners[:, end + 2 :: 4, :2] = radius[1:, None]
    corners[:, 4:6, 2], corners[:, 6:8, 2] = z[:-1, None], z[1:, None]
    corners[:, :4, 2] = corners[:, 4:, 2] - SLAB_M

    first_turn = slice(_FLAT_SECTORS, _FLAT_SECTORS + _SECTORS + 1)
    core, shell = inner[first_turn], outer[first_turn][2:-2]
    south, north = shell[0], shell[-1]
    doorposts = np.array([[(plan.width, south[1]), south], [north, (plan.width, north[1])]])
    walls = fences(np.concatenate([_segments(core), _segments(shell), doorposts]), plan.height)
    ends = [
        fences(np.array([[inner[end], outer[end]]]), plan.storey, base)
        for end, base in ((0, 0.0), (-1, plan.levels[-1]))
    ]
    sill = Box(plan.width, south[1], plan.width + 1.0, north[1])
    tower = Box(plan.width, middle - _OUTER_M, plan.width + 2 * _OUTER_M, middle + _OUTER_M)
    boxes = [
        *(floor(sill, z) for z in plan.levels),
        ceiling(tower, plan.height),
        *plan.tall(
            wall_along_x(0.0, plan.width, _DEPTH_M),
            wall_along_y(plan.width, 0.0, south[1]),
            wall_along_y(plan.width, north[1], _DEPTH_M),
            *(_pillar(x, y) for x, y in shell[rng.choice(len(shell), _RAMP_PILLARS)].tolist()),
        ),
    ]

    west, east = _END_M, plan.width - _END_M
    around = [(east, _NORTH_M), (west, _NORTH_M), (west, _SOUTH_M), (east, _SOUTH_M)]
    gate = (east, middle)
    driven = np.column_stack([centre + (_INNER_M + _OUTER_M) / 2 * outwards, z])
    turn = driven[_FLAT_SECTORS : _FLAT_SECTORS + _SECTORS * (plan.floors - 1) + 1]
    route = []
    for number in range(plan.floors):
        route += plan.at(number, [gate, *around, gate])
        route += turn[_SECTORS * number : _SECTORS * (number + 1) + 1].tolist()
    route += turn[-2::-1].tolist() + plan.at(0, [gate])
    return _Ramps(joined([mesh_of(boxes), hexahedra(corners), walls, *ends]), np.array(route), [])


def _pillar(x: float, y: float) -> Box:
    """Return a pillar in the outer wall of a ramp: without any, a ramp looks the same all along."""
    return Box(x, y, x, y).grown(0.3)


def _segments(line: FloatArray) -> FloatArray:
    """Return the legs of a line, shape (N, 2), as pairs of ends, shape (N - 1, 2, 2)."""
    return np.stack([line[:-1], line[1:]], axis=1)
