"""Long corridors with loops inside a loop, after the Killian Court buildings of MIT.

References:
    Bosse et al., An Atlas framework for scalable mapping, ICRA 2003, for the shape of the plan.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from hmt_service.sim.worlds.plan import WALL_M, Box, furniture, interior, lanes, on_floor
from hmt_service.sim.worlds.world import World

_CORRIDOR_M = 2.6
_DOOR_M = 1.1
_GAP_M = 0.4
"""Least distance between what stands or opens along the same wall."""

_Point = tuple[float, float]
_Lining = tuple[list[Box], list[Box]]
"""What opens into a wall, and what stands there; the wall is y = 0, the corridor below it."""


def nested_loops(seed: int, laps: int = 1) -> World:
    """Draw two small loops of corridors inside a large one of 300 m to 380 m.

    The route of 550 m to 800 m closes the first small loop, sets out on the large one, closes the
    second small one on its way and the large one late, and ends by a passage between the two small
    ones that it has passed before and never driven.

    Args:
        seed: The same seed gives the same world.
        laps: How often the loops are driven before the passage, 1 or more.
    """
    rng = np.random.default_rng(seed)
    width, height = rng.uniform(88.0, 112.0), rng.uniform(62.0, 80.0)
    a, b, c, d, e = width * rng.uniform((0.14, 0.54, 0.34, 0.82, 0.44), (0.2, 0.6, 0.4, 0.88, 0.5))
    low, high = height * rng.uniform((0.28, 0.66), (0.36, 0.72))
    is_flipped_x, is_flipped_y = rng.random(2) < 0.5

    def at(x: float, y: float) -> _Point:
        return width - x if is_flipped_x else x, height - y if is_flipped_y else y

    sides = [
        [at(0.0, 0.0), at(width, 0.0), at(width, height), at(0.0, height), at(0.0, 0.0)],
        [at(a, 0.0), at(a, low), at(b, low), at(b, 0.0)],
        [at(c, height), at(c, high), at(d, high), at(d, height)],
        [at(e, low), at(e, high)],
    ]
    corridors = [box for side in sides for box in lanes(side, _CORRIDOR_M / 2)]
    start, turn = at(a, 0.0), at(c, height)
    first_loop = [at(b, 0.0), at(b, low), at(a, low), start]
    second_loop = [turn, at(d, height), at(d, high), at(c, high), turn]
    large_loop = [at(0.0, 0.0), at(0.0, height), *second_loop, at(width, height), at(width, 0.0)]
    passage = [at(a, low), at(e, low), at(e, high), at(c, high)]
    route = [start, *(first_loop + [*large_loop, start]) * laps, *passage]

    free, standing = _lined(corridors, rng)
    mesh = interior(free, standing)
    return World(f"nested-loops-{seed}", mesh.vertices, mesh.triangles, on_floor(route))


def _lined(corridors: Sequence[Box], rng: np.random.Generator) -> _Lining:
    """Return the free space and what stands in it, with doors and cabinets along all corridors."""
    free, standing = list(corridors), []
    taken: list[Box] = []
    for own, x, y, quarter_turns in _spots(corridors, rng):
        lining = _LININGS[rng.choice(len(_LININGS), p=_SHARES)](rng)
        opens, stands = ([box.moved(x, y, quarter_turns) for box in boxes] for boxes in lining)
        claims = [box.grown(_GAP_M) for box in (*opens, *stands)]
        others = [*taken, *(corridor for corridor in corridors if corridor != own)]
        if not any(claim.overlaps(other) for claim in claims for other in others):
            free += opens
            standing += stands
            taken += claims
    return free, standing


def _spots(
    corridors: Sequence[Box], rng: np.random.Generator
) -> Iterator[tuple[Box, float, float, int]]:
    """Yield places on the walls: the corridor, a point (x, y) and the turns of its frame."""
    for corridor in corridors:
        size_x, size_y = corridor.x_max - corridor.x_min, corridor.y_max - corridor.y_min
        for side in range(2):
            along = rng.uniform(1.0, 6.0)
            while along < max(size_x, size_y):
                if size_x > size_y:
                    y = corridor.y_min if side else corridor.y_max
                    yield corridor, corridor.x_min + along, y, 2 * side
                else:
                    x = corridor.x_max if side else corridor.x_min
                    yield corridor, x, corridor.y_min + along, 1 + 2 * side
                along += 1.5 + rng.exponential(3.5)


def _closed_door(rng: np.random.Generator) -> _Lining:
    half, depth = rng.uniform(0.45, 0.9), rng.uniform(0.12, 0.3)
    return [Box(-half, -WALL_M, half, depth)], []


def _pillar(rng: np.random.Generator) -> _Lining:
    half, depth = rng.uniform(0.15, 0.35), rng.uniform(0.15, 0.3)
    return [], [Box(-half, -depth, half, 0.0)]


def _cabinet(rng: np.random.Generator) -> _Lining:
    half, depth = rng.uniform(0.3, 1.0), rng.uniform(0.25, 0.45)
    return [], [Box(-half, -depth, half, 0.0, rng.uniform(0.9, 2.0))]


def _bay(rng: np.random.Generator) -> _Lining:
    half, depth = rng.uniform(1.2, 2.5), rng.uniform(1.2, 3.0)
    bay = Box(-half, 0.0, half, depth)
    return [bay.grown(WALL_M)], furniture(bay, [], int(rng.integers(1, 5)), rng)


def _room(rng: np.random.Generator) -> _Lining:
    half, depth, door_x = rng.uniform(2.0, 3.5), rng.uniform(3.5, 6.0), rng.uniform(-1.0, 1.0)
    room = Box(-half, WALL_M, half, depth)
    doorway = Box(door_x - _DOOR_M / 2, -WALL_M, door_x + _DOOR_M / 2, 2 * WALL_M)
    return [room, doorway], furniture(room, [doorway.grown(0.5)], int(rng.integers(4, 9)), rng)


_LININGS: tuple[Callable[[np.random.Generator], _Lining], ...] = (
    _closed_door,
    _pillar,
    _cabinet,
    _bay,
    _room,
)
_SHARES = (0.3, 0.15, 0.2, 0.1, 0.25)
