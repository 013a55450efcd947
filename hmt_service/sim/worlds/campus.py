"""A campus: paths between buildings, and through some of them, over gentle hills.

References:
    Blanco et al. 2008, section VI: 2 km through the campus of the University of Malaga.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
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
_MARGIN_M = 35.0
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


_LAMPS = _Lining(lamp, (20.0, 26.0), (0.2, 0.4))
_LININGS = (
    _Lining(tree, (5.0, 10.0), (0.5, 2.5)),
    _Lining(tree, (3.0, 16.0), (0.5, 6.0)),
    _Lining(hedge, (1.0, 8.0), (0.3, 2.0)),
    _Lining(car, (0.6, 6.0), (0.5, 1.0)),
)
_BUILDINGS = ((20, (24.0, 42.0), (14.0, 24.0)), (24, (10.0, 20.0), (8.0, 14.0)))
"""How many are tried, and ranges of length and width, m."""
_TRIES = 20
_PARKING_LOTS = 6
_SCATTERED_TREES = 160


def campus(seed: int, relief_m: float = 1.5) -> World:
    """Draw a campus of 320 m x 240 m with seventeen paths, three of them through halls.

    The route of 1.8 km to 2.2 km closes a long loop first, then shorter ones beside and inside
    it, and drives a third of its way on paths that it has driven before.

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
    legs = [leg for path in paths.values() for leg in pairwise(path)]
    for start, end in legs:
        site.take(_along(start, end, 1.0, _PATH_M))
    _build(site, rng)
    for start, end in legs:
        _line(site, start, end, rng)
    for _ in range(_SCATTERED_TREES):
        _plant(site, rng)
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


def _build(site: Site, rng: np.random.Generator) -> None:
    """Draw buildings, the large ones first, then parking lots."""
    for count, lengths, widths in _BUILDINGS:
        for _ in range(count):
            length, width = rng.uniform(*lengths), rng.uniform(*widths)
            thing = building(length, width, rng)
            for _ in range(_TRIES):
                if site.add(thing.mesh, site.somewhere(length, width, rng)):
                    break
    for _ in range(_PARKING_LOTS):
        lot = site.somewhere(24.0, 16.0, rng)
        for x in np.arange(-10.4, 10.5, 2.6):
            for y in (-5.5, 5.5):
                if rng.random() < 0.7:
                    thing = car(rng)
                    x_car, y_car = lot.to_world(np.array([x, y]) + rng.uniform(-0.2, 0.2, 2))
                    yaw = lot.yaw_rad + math.pi / 2
                    site.add(thing.mesh, Footprint(x_car, y_car, thing.length, thing.width, yaw))


def _line(site: Site, start: FloatArray, end: FloatArray, rng: np.random.Generator) -> None:
    """Draw rows of things on both sides of a straight piece of path, and lamps on one."""
    path = _along(start, end, 1.0, _PATH_M)
    sides = [(side, _LININGS[rng.integers(len(_LININGS))]) for side in (-1.0, 1.0)]
    for side, lining in ((rng.choice((-1.0, 1.0)), _LAMPS), *sides):
        x = rng.uniform(0.0, 8.0) - path.length / 2
        while x < path.length / 2:
            thing = lining.thing(rng)
            y = side * (_PATH_M / 2 + rng.uniform(*lining.offset_m) + thing.width / 2)
            x_thing, y_thing = path.to_world(np.array([x + thing.length / 2, y]))
            place = Footprint(x_thing, y_thing, thing.length, thing.width, path.yaw_rad)
            site.add(thing.mesh, place)
            x += thing.length + rng.uniform(*lining.gap_m)


def _plant(site: Site, rng: np.random.Generator) -> None:
    """Draw a tree anywhere."""
    thing = tree(rng)
    site.add(thing.mesh, site.somewhere(thing.length, thing.width, rng))


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
