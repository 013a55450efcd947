"""What every family promises."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.families import RECIPES, Family, draw
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams

SEEDS = range(10)
CLEARANCE_M = 0.4
MEMORY_M = 20.0
"""A place seen so much earlier on the way is visited again, not still."""

all_worlds = pytest.mark.parametrize(
    ("family", "seed"), [(family, seed) for family in Family for seed in SEEDS]
)


@cache
def world(family: Family, seed: int) -> World:
    return draw(family, seed)


@cache
def caster(family: Family, seed: int) -> RayCaster:
    return RayCaster(world(family, seed))


def above(points: FloatArray, height: float) -> FloatArray:
    return np.asarray(points + (0.0, 0.0, height))


@all_worlds
def test_same_seed_draws_the_same_bytes(family: Family, seed: int) -> None:
    first, second = world(family, seed), draw(family, seed)
    assert first.name == second.name
    assert first.vertices.tobytes() == second.vertices.tobytes()
    assert first.triangles.tobytes() == second.triangles.tobytes()
    assert first.route_m.tobytes() == second.route_m.tobytes()


@pytest.mark.parametrize("family", Family)
def test_every_seed_draws_another_world(family: Family) -> None:
    assert len({world(family, seed).vertices.tobytes() for seed in SEEDS}) == len(SEEDS)
    assert len({world(family, seed).route_m.tobytes() for seed in SEEDS}) == len(SEEDS)


@all_worlds
def test_mesh_has_only_real_triangles(family: Family, seed: int) -> None:
    vertices, triangles = world(family, seed).vertices, world(family, seed).triangles
    assert vertices.dtype == np.float32
    assert triangles.dtype == np.uint32
    assert np.all(np.isfinite(vertices))
    assert triangles.max() == len(vertices) - 1
    a, b, c = (vertices[triangles[:, corner]].astype(np.float64) for corner in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-4


@all_worlds
def test_route_goes_on_from_waypoint_to_waypoint(family: Family, seed: int) -> None:
    route = world(family, seed).route_m
    assert route.shape[1] == 3
    assert np.all(np.isfinite(route))
    assert np.linalg.norm(np.diff(route, axis=0), axis=1).min() > 0.0


@all_worlds
def test_route_is_as_long_as_the_family_says(family: Family, seed: int) -> None:
    shortest, longest = RECIPES[family].route_m
    assert shortest <= beams.length_m(world(family, seed)) <= longest


@all_worlds
def test_nothing_is_near_the_route(family: Family, seed: int) -> None:
    points = beams.along(world(family, seed), 0.1)
    # At these heights the ground is farther away than anything may be.
    for height in (0.45, 0.6):
        assert caster(family, seed).clearances(above(points, height)).min() > CLEARANCE_M
    ranges = beams.ranges(caster(family, seed), above(points[::3], 0.3), beams.level(24))
    assert ranges.min() > CLEARANCE_M


@all_worlds
def test_ground_is_under_the_route(family: Family, seed: int) -> None:
    points = beams.along(world(family, seed), 0.1)
    depths = beams.ranges(caster(family, seed), above(points, 0.3), np.array([[0.0, 0.0, -1.0]]))
    assert np.abs(depths - 0.3).max() < 0.05


@all_worlds
def test_route_comes_back_to_where_it_was(family: Family, seed: int) -> None:
    points = beams.along(world(family, seed), 0.5)
    steps_back = round(MEMORY_M / 0.5)
    nearest = [
        np.linalg.norm(points[: now - steps_back] - points[now], axis=1).min()
        for now in range(steps_back + 1, len(points), 2)
    ]
    assert np.sum(np.array(nearest) < 1.0) >= 10


@all_worlds
def test_a_laser_always_sees_something(family: Family, seed: int) -> None:
    points = above(beams.along(world(family, seed), 2.0), 0.4)
    ranges = beams.ranges(caster(family, seed), points, beams.level(60))
    assert np.all(np.sum(ranges < 30.0, axis=1) >= 6)
