"""What makes one stretch of a corridor different from the next.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from hmt_service.sim.worlds.plan import WALL_M, Box, furniture

_DOOR_M = 1.1
_GAP_M = 0.4
"""Least distance between what stands or opens along the same wall."""
_END_M = 1.0
"""Least distance from the end of a corridor to the middle of what stands or opens there."""

_Lining = tuple[list[Box], list[Box]]
"""What opens into a wall, and what stands there; the wall is y = 0, the corridor below it."""


def lined(
    corridors: Sequence[Box], rng: np.random.Generator, kept: Sequence[Box] = ()
) -> tuple[list[Box], list[Box]]:
    """Draw doors, pillars, cabinets, bays and open rooms along the walls of corridors.

    Args:
        corridors: Free ground along x or y.
        rng: Source of the draw.
        kept: Ground that no room reaches into.

    Returns:
        The free ground, corridors included, and what stands on it.
    """
    free, standing = list(corridors), []
    taken: list[Box] = []
    for own, x, y, quarter_turns in _spots(corridors, rng):
        lining = _LININGS[rng.choice(len(_LININGS), p=_SHARES)](rng)
        opens, stands = ([box.moved(x, y, quarter_turns) for box in boxes] for boxes in lining)
        claims = [box.grown(_GAP_M) for box in (*opens, *stands)]
        others = [*taken, *kept, *(corridor for corridor in corridors if corridor != own)]
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
            along = rng.uniform(_END_M, 6.0)
            while along < max(size_x, size_y) - _END_M:
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
