"""Rays, and points along a route, for the tests of all families."""

from __future__ import annotations

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import Fans, RayCaster
from hmt_service.sim.worlds.world import World


def length_m(world: World) -> float:
    """Return the length of the route."""
    return float(np.linalg.norm(np.diff(world.route_m, axis=0), axis=1).sum())


def along(world: World, step_m: float) -> FloatArray:
    """Return points of the route at equal distances, shape (P, 3)."""
    legs = np.linalg.norm(np.diff(world.route_m, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(legs)])
    at = np.arange(0.0, travelled[-1], step_m)
    return np.column_stack([np.interp(at, travelled, axis) for axis in world.route_m.T])


def ranges(caster: RayCaster, origins_m: FloatArray, directions: FloatArray) -> FloatArray:
    """Return how far each ray gets: D directions from each of P origins, shape (P, D)."""
    fans = Fans(
        origins_m[:, None],
        np.zeros((len(origins_m), 1, 3)),
        np.broadcast_to(directions, (len(origins_m), *directions.shape)),
        np.zeros(1),
    )
    return np.asarray(caster.ranges(fans)[:, :, 0], dtype=np.float64)


def level(count: int) -> FloatArray:
    """Return horizontal directions all around, shape (count, 3)."""
    angles = np.arange(count) * 2.0 * np.pi / count
    return np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
