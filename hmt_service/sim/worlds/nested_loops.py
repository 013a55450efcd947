"""Long corridors with loops inside a loop, after the Killian Court buildings of MIT.

References:
    Bosse et al., An Atlas framework for scalable mapping, ICRA 2003, for the shape of the plan.
"""

from __future__ import annotations

import numpy as np

from hmt_service.sim.worlds.corridors import lined
from hmt_service.sim.worlds.plan import interior, lanes, on_floor
from hmt_service.sim.worlds.world import World

_CORRIDOR_M = 2.6

_Point = tuple[float, float]


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

    free, standing = lined(corridors, rng)
    mesh = interior(free, standing)
    return World(f"nested-loops-{seed}", mesh.vertices, mesh.triangles, on_floor(route))
