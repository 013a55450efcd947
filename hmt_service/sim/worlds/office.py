"""An office floor: rooms on both sides of a ring of corridors.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hmt_service.sim.worlds.plan import (
    Box,
    ceiling,
    floor,
    mesh_of,
    wall_along_x,
    wall_along_y,
)
from hmt_service.sim.worlds.world import World

_CORRIDOR_M = 2.2
_DOOR_M = 1.1
_OUTER_DEPTH_M = 4.5
"""Depth of the rooms along the outer walls."""
_REACH_M = 2.4
"""How far the route goes into a room, measured from its door."""
_CLEARANCE_M = 0.8
"""Space kept free of furniture around the route."""


@dataclass(frozen=True, slots=True)
class _Row:
    """Rooms side by side between x_min and x_max; their doors open into a corridor along x."""

    x_min: float
    x_max: float
    door_y: float
    """Middle of the wall with the doors."""
    depth: float
    """From the door wall to the back wall; negative where the rooms lie to the south of it."""


def office(seed: int, laps: int = 1) -> World:
    """Draw an office floor: a ring of corridors, one across its middle, rooms on both sides.

    The route of about 200 m runs the eastern loop, the western loop and most of the eastern loop
    again, and enters one room in each corridor with doors (the same room on every pass).

    Args:
        seed: The same seed gives the same world.
        laps: How often both loops are driven before the last part of the route, 1 or more.
    """
    rng = np.random.default_rng(seed)
    width, height = rng.uniform(28.0, 32.0), rng.uniform(18.0, 21.0)
    middle = width * rng.uniform(0.42, 0.58)
    south, north = _CORRIDOR_M / 2, height - _CORRIDOR_M / 2
    west, east = _CORRIDOR_M / 2, width - _CORRIDOR_M / 2
    inner_south, inner_north = _CORRIDOR_M, height - _CORRIDOR_M
    blocks = (
        (_CORRIDOR_M, middle - _CORRIDOR_M / 2),
        (middle + _CORRIDOR_M / 2, width - _CORRIDOR_M),
    )

    rows = [
        _Row(0.0, width, 0.0, -_OUTER_DEPTH_M),
        _Row(0.0, width, height, _OUTER_DEPTH_M),
    ]
    for x_min, x_max in blocks:
        rows.append(_Row(x_min, x_max, inner_south, rng.uniform(4.5, 6.0)))
        rows.append(_Row(x_min, x_max, inner_north, -rng.uniform(4.5, 6.0)))
    boxes: list[Box] = []
    doors: list[tuple[float, _Row]] = []
    for row in rows:
        for door_x, parts in _rooms(row, rng):
            boxes += parts
            doors.append((door_x, row))

    boxes += [wall_along_y(x, 0.0, height) for x in (0.0, width)]
    boxes += [wall_along_y(x, inner_south, inner_north) for block in blocks for x in block]
    # Without cabinets, the places along a corridor without doors would all look alike.
    for x in (west, middle, east):
        boxes += _cabinets(x, inner_south, inner_north, rng)

    entered = {
        (y, is_eastern): doors[rng.choice(_beside(doors, y, is_eastern, middle))]
        for y in (south, north)
        for is_eastern in (False, True)
    }
    start, junction = (middle, south), (middle, north)
    eastern_loop = [start, (east, south), (east, north), junction]
    western_loop = [start, (west, south), (west, north), junction]
    corners = [*(eastern_loop + western_loop) * laps, *eastern_loop[:3]]
    route = [start]
    for (x_from, y_from), (x_to, y_to) in pairwise(corners):
        if y_from == y_to:
            door_x, row = entered[y_from, max(x_from, x_to) > middle]
            inside = row.door_y + np.copysign(_REACH_M, row.depth)
            route += [(door_x, y_from), (door_x, inside), (door_x, y_from)]
        route.append((x_to, y_to))
    building = Box(0.0, -_OUTER_DEPTH_M, width, height + _OUTER_DEPTH_M)
    vertices, triangles = mesh_of([*boxes, floor(building), ceiling(building)])
    return World(f"office-{seed}", vertices, triangles, np.array([(x, y, 0.0) for x, y in route]))


def _beside(
    doors: Sequence[tuple[float, _Row]], corridor_y: float, is_eastern: bool, middle: float
) -> list[int]:
    """Return the positions of the doors into one half of a corridor, none near its ends."""
    return [
        position
        for position, (door_x, row) in enumerate(doors)
        if abs(row.door_y - corridor_y) < _CORRIDOR_M
        and (door_x > middle) == is_eastern
        and abs(door_x - middle) > _CORRIDOR_M
        and row.x_min + _CORRIDOR_M < door_x < row.x_max - _CORRIDOR_M
    ]


def _rooms(row: _Row, rng: np.random.Generator) -> Iterator[tuple[float, list[Box]]]:
    """Yield the middle of the door (x, m), the walls and the furniture of each room of a row."""
    length = row.x_max - row.x_min
    shares = rng.uniform(0.8, 1.2, max(2, round(length / 4.6)))
    edges = row.x_min + length * np.concatenate([[0.0], np.cumsum(shares) / shares.sum()])
    y_back = row.door_y + row.depth
    y_low, y_high = sorted((row.door_y, y_back))
    for left, right in pairwise(edges.tolist()):
        door_x = rng.uniform(left + 1.0, right - 1.0)
        lane = Box(
            door_x - _CLEARANCE_M,
            row.door_y - _REACH_M - _CLEARANCE_M,
            door_x + _CLEARANCE_M,
            row.door_y + _REACH_M + _CLEARANCE_M,
        )
        furniture = _furniture(left, right, y_low, y_high, rng)
        yield (
            door_x,
            [
                wall_along_x(left, door_x - _DOOR_M / 2, row.door_y),
                wall_along_x(door_x + _DOOR_M / 2, right, row.door_y),
                wall_along_x(left, right, y_back),
                wall_along_y(left, y_low, y_high),
                wall_along_y(right, y_low, y_high),
                *(box for box in furniture if not box.overlaps(lane)),
            ],
        )


def _furniture(
    left: float, right: float, y_low: float, y_high: float, rng: np.random.Generator
) -> list[Box]:
    """Draw desks and cupboards anywhere inside a room."""
    boxes = []
    for _ in range(rng.integers(4, 8)):
        size_x, size_y = rng.uniform(0.4, 1.5, 2)
        x = rng.uniform(left, right - size_x)
        y = rng.uniform(y_low, y_high - size_y)
        boxes.append(Box(x, y, x + size_x, y + size_y, rng.uniform(0.7, 2.0)))
    return boxes


def _cabinets(x: float, y_min: float, y_max: float, rng: np.random.Generator) -> list[Box]:
    """Draw shallow cabinets along both walls of a corridor that runs along y at `x`."""
    boxes = []
    for side in (-1.0, 1.0):
        for _ in range(rng.integers(2, 5)):
            length, depth = rng.uniform(0.5, 1.6), rng.uniform(0.15, 0.4)
            y = rng.uniform(y_min, y_max - length)
            wall, front = sorted((x + side * _CORRIDOR_M / 2, x + side * (_CORRIDOR_M / 2 - depth)))
            boxes.append(Box(wall, y, front, y + length, 1.2))
    return boxes
