from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.families import Family, draw
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams

SEEDS = range(4)
UP = np.array([[0.0, 0.0, 1.0]])


@cache
def campus(seed: int, relief_m: float = 1.5) -> World:
    return draw(Family.CAMPUS, seed, relief_m=relief_m)


def slopes(route: FloatArray) -> FloatArray:
    steps = np.diff(route, axis=0)
    return np.asarray(np.abs(steps[:, 2]) / np.hypot(steps[:, 0], steps[:, 1]))


@pytest.mark.parametrize("seed", SEEDS)
def test_route_climbs_gently(seed: int) -> None:
    route = campus(seed).route_m
    assert 0.005 < slopes(route).max() <= 0.05
    assert 0.5 < np.ptp(route[:, 2]) <= 3.0
    assert np.linalg.norm(np.diff(route, axis=0), axis=1).max() <= 2.01


def test_without_relief_all_is_flat() -> None:
    world = campus(1, relief_m=0.0)
    assert np.all(world.route_m[:, 2] == 0.0)
    hills = campus(1)
    assert np.array_equal(world.route_m[:, :2], hills.route_m[:, :2])


@pytest.mark.parametrize("seed", SEEDS)
def test_route_leads_through_buildings_on_level_ground(seed: int) -> None:
    world = campus(seed)
    points = beams.along(world, 0.5)
    overhead = beams.ranges(RayCaster(world), points + (0.0, 0.0, 0.5), UP)[:, 0]
    is_indoors = np.isclose(overhead, 2.7, atol=0.02)
    # Three halls of more than 40 m, some of them more than once.
    assert is_indoors.sum() * 0.5 > 3 * 40.0
    entries = np.flatnonzero(np.diff(is_indoors.astype(int)) == 1)
    assert len(entries) >= 3
    for entry in entries:
        end = entry + 1 + np.argmin(is_indoors[entry + 1 :])
        assert np.ptp(points[entry + 1 : end, 2]) < 0.02
    assert np.mean(np.isinf(overhead)) > 0.5


@pytest.mark.parametrize("seed", SEEDS)
def test_there_is_something_to_see_within_30_m(seed: int) -> None:
    world = campus(seed)
    points = beams.along(world, 2.0) + (0.0, 0.0, 0.5)
    ranges = beams.ranges(RayCaster(world), points, beams.level(180))
    returns = np.sum(ranges < 30.0, axis=1)
    assert np.quantile(returns, 0.02) >= 45
    assert returns.min() >= 20


def test_first_loop_is_long_and_closes_where_the_route_began() -> None:
    for seed in SEEDS:
        world = campus(seed)
        back = np.flatnonzero(np.all(world.route_m == world.route_m[0], axis=1))
        legs = np.linalg.norm(np.diff(world.route_m, axis=0), axis=1)
        assert legs[: back[1]].sum() > 400.0
        assert back[-1] == len(world.route_m) - 1
