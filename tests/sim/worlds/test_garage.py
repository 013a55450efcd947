from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.garage import garage
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams

# One seed of each kind of ramps.
STRAIGHT, SPIRAL = 0, 2


def levels(world: World) -> list[float]:
    """Return the heights at which the route runs level for more than 50 m, ascending."""
    route = world.route_m
    lengths = np.linalg.norm(np.diff(route, axis=0), axis=1)
    is_level = np.diff(route[:, 2]) == 0.0
    heights = np.round(route[1:, 2][is_level], 6)
    return [
        float(height)
        for height in np.unique(heights)
        if lengths[is_level][heights == height].sum() > 50.0
    ]


def slopes(world: World) -> FloatArray:
    steps = np.diff(world.route_m, axis=0)
    return np.asarray(np.abs(steps[:, 2]) / np.hypot(steps[:, 0], steps[:, 1]))


@pytest.mark.parametrize("floors", range(2, 7))
@pytest.mark.parametrize("seed", [STRAIGHT, SPIRAL])
def test_route_visits_every_floor_and_returns_to_the_first(seed: int, floors: int) -> None:
    world = garage(seed, floors)
    found = levels(world)
    assert len(found) == floors
    assert found[0] == 0.0
    assert np.all(np.diff(found) > 2.7)
    assert np.diff(found) == pytest.approx(found[1])
    assert world.route_m[-1, 2] == 0.0
    assert world.route_m[:, 2].max() == pytest.approx(found[-1])


@pytest.mark.parametrize("seed", range(10))
def test_ramps_climb_at_most_12_percent(seed: int) -> None:
    steepest = slopes(garage(seed)).max()
    assert 0.05 < steepest <= 0.12


@pytest.mark.parametrize("seed", [STRAIGHT, SPIRAL])
@pytest.mark.parametrize("floors", [2, 6])
def test_ramps_pass_through_the_floors_freely(seed: int, floors: int) -> None:
    world = garage(seed, floors)
    points = beams.along(world, 0.2)
    caster = RayCaster(world)
    up_and_down = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    overhead, ground = beams.ranges(caster, points + (0.0, 0.0, 1.0), up_and_down).T
    assert np.abs(ground - 1.0).max() < 0.05
    # A robot of 2 m passes everywhere; the last ramp has the roof above it, the others a ramp.
    assert overhead.min() > 1.0
    assert overhead.max() < 2 * levels(world)[1]


@pytest.mark.parametrize("seed", range(6))
def test_floors_look_alike_but_not_the_same(seed: int) -> None:
    world = garage(seed)
    caster, found = RayCaster(world), levels(world)
    on_first = beams.along(world, 3.0)
    on_first = on_first[(on_first[:, 2] == 0.0) & (on_first[:, 0] < 42.0)][:40]
    seen = [
        beams.ranges(caster, on_first + (0.0, 0.0, height + 0.5), beams.level(60))
        for height in found
    ]
    for other in seen[1:]:
        is_equal = np.isclose(other, seen[0], atol=0.01)
        assert 0.5 < is_equal.mean() < 0.98


def test_seed_decides_how_floors_are_joined() -> None:
    def is_spiral(seed: int) -> bool:
        return len(garage(seed).route_m) > 60

    kinds = [is_spiral(seed) for seed in range(10)]
    assert kinds[STRAIGHT] is False
    assert kinds[SPIRAL] is True


@pytest.mark.parametrize("seed", range(10))
def test_each_floor_is_driven_around(seed: int) -> None:
    world = garage(seed)
    for height in levels(world):
        floor = world.route_m[np.abs(world.route_m[:, 2] - height) < 1e-6]
        assert np.ptp(floor[:, 0]) > 40.0
        assert np.ptp(floor[:, 1]) >= 16.0
