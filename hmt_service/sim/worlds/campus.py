"""A campus: paths between buildings, and through some of them, over gentle hills.

References:
    Blanco et al. 2008, section VI: 2 km through the campus of the University of Malaga.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.outdoors import Thing, building, car, hall, hedge, lamp, tree
from hmt_service.sim.worlds.plan import Box, joined
from hmt_service.sim.worlds.terrain import Footprint, Site, Terrain
from hmt_service.sim.worlds.world import World

_Node = tuple[int, int]
_Path = tuple[_Node, _Node]
_SPACING_M = (79.0, 87.0)
"""From node to node of the net of paths."""
_SHIFT_M = 7.0
"""A node is at most so far from its place in a regular net."""
_BEND_M = 5.0
"""The middle of a path is at most so far from the straight line."""
_TOUR: tuple[_Node, ...] = (
    # A long first loop,
    *((0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1), (0, 0)),
    # a path across it and two loops beside it,
    *((1, 0), (1, 1), (1, 2), (2, 2), (2, 1), (3, 1), (3, 2), (2, 2)),
    # and all around, back to where it began.
    *((1, 2), (0, 2), (0, 1), (1, 1), (2, 1), (3, 1), (3, 0), (2, 0), (1, 0), (0, 0)),
)
_PATHS: tuple[_Path, ...] = tuple(sorted({(min(leg), max(leg)) for leg in pairwise(_TOUR)}))
_INDOORS: tuple[tuple[_Path, ...], ...] = (
    (((1, 1), (2, 1)), ((0, 1), (0, 2)), ((3, 0), (3, 1))),
    (((0, 1), (1, 1)), ((2, 1), (2, 2)), ((2, 0), (3, 0))),
)
"""Paths that lead through a hall; the seed decides which."""
_HALL = 0.55, 15.6
"""Share of its path that is in the hall, and width of the hall, m."""
_MARGIN_M = 45.0
"""From the outermost nodes to the edge of the world."""
_PATH_M = 3.0
"""Width of a path; nothing stands on it."""
_WAYPOINTS_M = 2.0


@dataclass(frozen=True, slots=True)
class _Lining:
    """What stands in a row beside a path."""

    thing: Callable[[np.random.Generator], Thing]
    gap_m: tuple[float, float]
    """Between one and the next."""
    offset_m: tuple[float, float]
    """From the edge of the path."""


def _building(rng: np.random.Generator) -> Thing:
    length, width = rng.uniform((14.0, 9.0), (36.0, 18.0))
    return building(length, width, rng)


_FRONTS = _Lining(_building, (4.0, 25.0), (2.5, 9.0))
_LAMPS = _Lining(lamp, (20.0, 26.0), (0.2, 0.4))
_LININGS = (
    _Lining(tree, (5.0, 10.0), (0.5, 2.5)),
    _Lining(tree, (3.0, 16.0), (0.5, 6.0)),
    _Lining(hedge, (1.0, 8.0), (0.3, 2.0)),
    _Lining(car, (0.6, 6.0), (0.5, 1.0)),
)
_SCATTERED = ((_building, 40), (tree, 160))
"""What stands anywhere, and how many are tried."""
_PARKING_LOTS = 6


def campus(seed: int, relief_m: float = 1.5) -> World:
    """Draw a campus of 340 m x 260 m with seventeen paths, three of them through halls.

    The route of 1.8 km to 2.2 km closes a long loop first, then shorter ones beside and inside
    it, and drives nearly a third of its way on paths that it has driven before.

    Args:
        seed: The same seed gives the same world.
        relief_m: The ground is at most so far above or below its mean; halls are level. Paths
            climb at most 5 % where this is at most 1.5.
    """
    rng = np.random.default_rng(seed)
    nodes = _nodes(rng)
    indoors = _INDOORS[rng.integers(len(_INDOORS))]
    halls = {path: _along(nodes[path[0]], nodes[path[1]], *_HALL) for path in indoors}
    terrain = Terrain.drawn(relief_m, tuple(halls.values()), rng)
    corners = np.array(list(nodes.values()))
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    site = Site(Box(*low.tolist(), *high.tolist()), terrain)
    for place in halls.values():
        site.add(hall(place.length, place.width, rng).mesh, place)
    paths = {path: _bent(nodes, path, path in halls, rng) for path in _PATHS}
    _fill(
        site, [_along(*leg, 1.0, _PATH_M) for path in paths.values() for leg in pairwise(path)], rng
    )
    mesh = joined(site.meshes)
    return World(f"campus-{seed}", mesh.vertices, mesh.triangles, _route(paths, terrain))


def _nodes(rng: np.random.Generator) -> dict[_Node, FloatArray]:
    """Draw where paths meet: an irregular net, perhaps mirrored."""
    spacing, mirror = rng.uniform(*_SPACING_M, 2), rng.choice((-1.0, 1.0), 2)
    return {
        node: mirror * (spacing * node + rng.uniform(-_SHIFT_M, _SHIFT_M, 2))
        for node in sorted(set(_TOUR))
    }


def _along(start: FloatArray, end: FloatArray, share: float, width: float) -> Footprint:
    """Return the middle part of a straight path."""
    (x, y), way = (start + end) / 2, end - start
    return Footprint(x, y, share * math.hypot(*way), width, math.atan2(way[1], way[0]))


def _bent(
    nodes: Mapping[_Node, FloatArray], path: _Path, is_straight: bool, rng: np.random.Generator
) -> list[FloatArray]:
    """Draw the points of a path."""
    start, end = nodes[path[0]], nodes[path[1]]
    bend = rng.uniform(-_BEND_M, _BEND_M, 2)
    return [start, end] if is_straight else [start, (start + end) / 2 + bend, end]


def _fill(site: Site, paths: Sequence[Footprint], rng: np.random.Generator) -> None:
    """Draw what stands along paths, the large things first, then what stands anywhere."""
    for path in paths:
        site.take(path)
    for path in paths:
        for side in (-1.0, 1.0):
            _line(site, path, side, _FRONTS, rng)
    for _ in range(_PARKING_LOTS):
        _park(site, rng)
    for path in paths:
        _line(site, path, rng.choice((-1.0, 1.0)), _LAMPS, rng)
        for side in (-1.0, 1.0):
            _line(site, path, side, _LININGS[rng.integers(len(_LININGS))], rng)
    for thing, count in _SCATTERED:
        for _ in range(count):
            mesh, length, width = thing(rng)
            site.add(mesh, site.somewhere(length, width, rng))


def _line(
    site: Site, path: Footprint, side: float, lining: _Lining, rng: np.random.Generator
) -> None:
    """Draw a row on the left of a straight path, where `side` is 1, or on its right, where -1."""
    x = rng.uniform(0.0, 8.0) - path.length / 2
    while x < path.length / 2:
        mesh, length, width = lining.thing(rng)
        y = side * ((path.width + width) / 2 + rng.uniform(*lining.offset_m))
        middle_x, middle_y = path.to_world(np.array([x + length / 2, y])).tolist()
        place = Footprint(middle_x, middle_y, length, width, path.yaw_rad)
        is_there = site.add(mesh, place)
        x += (length if is_there else 0.0) + rng.uniform(*lining.gap_m)


def _park(site: Site, rng: np.random.Generator) -> None:
    """Draw a parking lot with two rows of spaces."""
    lot = site.somewhere(24.0, 16.0, rng)
    for x in np.arange(-10.4, 10.5, 2.6).tolist():
        for y in (-5.5, 5.5):
            mesh, length, width = car(rng)
            shift = rng.uniform(-0.2, 0.2, 2)
            if rng.random() < 0.7:
                car_x, car_y = lot.to_world(np.array([x, y]) + shift).tolist()
                yaw = lot.yaw_rad + math.pi / 2
                site.add(mesh, Footprint(car_x, car_y, length, width, yaw))


def _route(paths: Mapping[_Path, list[FloatArray]], terrain: Terrain) -> FloatArray:
    """Return the tour over the ground, shape (W, 3), m."""
    points = [paths[_TOUR[0], _TOUR[1]][0]]
    for leg in pairwise(_TOUR):
        path = paths[min(leg), max(leg)]
        for start, end in pairwise(path if leg[0] < leg[1] else path[::-1]):
            steps = math.ceil(math.dist(start, end) / _WAYPOINTS_M)
            points += list(np.linspace(start, end, steps + 1)[1:])
    flat = np.array(points)
    return np.column_stack([flat, terrain.heights(flat)])
