from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.aliased import aliased
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams

# One seed of each kind of building.
RING, TWIN_WINGS = 0, 1


def turning_points(world: World) -> list[tuple[FloatArray, FloatArray]]:
    """Return where the route turns back in a room, and the direction that it went in there."""
    turns = []
    for before, here, after in zip(
        world.route_m, world.route_m[1:], world.route_m[2:], strict=False
    ):
        if np.array_equal(before, after):
            turns.append((here, (here - before) / np.linalg.norm(here - before)))
    return turns


def views(world: World) -> FloatArray:
    """Return what a LiDAR sees from the end of each way into a room, relative to that way."""
    bearings, elevations = np.meshgrid(np.linspace(0.0, math.tau, 90), (-0.3, 0.0, 0.3))
    caster, seen = RayCaster(world), []
    for position, (x, y, _) in turning_points(world):
        heading = np.arctan2(y, x) + bearings.ravel()
        level = np.cos(elevations.ravel())
        directions = np.column_stack(
            [level * np.cos(heading), level * np.sin(heading), np.sin(elevations.ravel())]
        )
        eye = (position + (0.0, 0.0, 0.5))[None]
        seen.append(beams.ranges(caster, eye, directions)[0])
    return np.array(seen)


def places_visited(world: World) -> int:
    return len({tuple(position) for position, _ in turning_points(world)})


@pytest.mark.parametrize("seed", [RING, TWIN_WINGS])
def test_some_rooms_are_visited_again_and_some_once(seed: int) -> None:
    world = aliased(seed)
    assert len(turning_points(world)) >= 6
    assert 4 <= places_visited(world) < len(turning_points(world))


@pytest.mark.parametrize("seed", range(10))
def test_rooms_are_equal_at_severity_one(seed: int) -> None:
    seen = views(aliased(seed, severity=1.0))
    # Single rays meet an edge or pass it: rounding of their directions.
    is_equal = np.isclose(seen, seen[0], atol=1e-3)
    assert is_equal.mean(axis=1).min() > 0.98


@pytest.mark.parametrize("seed", range(10))
def test_rooms_are_copies_to_the_bit_at_severity_one(seed: int) -> None:
    world = aliased(seed, severity=1.0)
    furniture = {}
    for position, (x, y, _) in turning_points(world):
        forward, left = np.array([x, y]), np.array([-y, x])
        relative = world.vertices[:, :2].astype(np.float64) - position[:2]
        in_room = np.column_stack([relative @ forward, relative @ left])
        is_inside = (np.abs(in_room[:, 1]) < 1.9) & (in_room[:, 0] > -2.0) & (in_room[:, 0] < 2.0)
        rows = np.column_stack([in_room[is_inside], world.vertices[is_inside, 2]])
        furniture[tuple(position)] = {tuple(row) for row in rows.tolist()}
    first, *others = furniture.values()
    assert len(first) >= 16
    assert all(other == first for other in others)


@pytest.mark.parametrize("seed", range(10))
def test_no_room_is_like_another_at_severity_zero(seed: int) -> None:
    world = aliased(seed, severity=0.0)
    seen = dict(zip([tuple(p) for p, _ in turning_points(world)], views(world), strict=True))
    rooms = list(seen.values())
    for i, one in enumerate(rooms):
        for other in rooms[:i]:
            assert np.isclose(one, other, atol=0.05).mean() < 0.8


def test_severity_is_the_share_of_rooms_that_are_copies() -> None:
    # With each room that is not a copy goes a cabinet whose 4 upper corners are at 1.2 m.
    def cabinets(severity: float) -> float:
        worlds = [aliased(seed, severity) for seed in range(12)]
        return float(np.mean([(w.vertices[:, 2] == np.float32(1.2)).sum() / 4 for w in worlds]))

    none, all_rooms = cabinets(1.0), cabinets(0.0)
    assert none == 0.0
    assert all_rooms > 18.0
    assert cabinets(0.9) == pytest.approx(0.1 * all_rooms, rel=0.4)


def test_severity_changes_the_route_only_by_the_places_of_doors() -> None:
    mild, strong = aliased(3, 0.3), aliased(3, 0.6)
    assert len(mild.route_m) == len(strong.route_m)
    assert np.abs(mild.route_m - strong.route_m).max() <= 0.9


def test_rooms_are_at_least_four_metres_apart() -> None:
    for seed in range(10):
        positions = [position for position, _ in turning_points(aliased(seed, 1.0))]
        apart = [math.dist(a, b) for a, b in pairwise(sorted(map(tuple, positions))) if a != b]
        assert min(apart) >= 4.0


def test_seed_decides_between_a_ring_and_twin_wings() -> None:
    def has_link(seed: int) -> bool:
        # The twin wings are symmetric about their link.
        x = aliased(seed, 1.0).vertices[:, 0]
        return bool(x.min() == -x.max())

    kinds = [has_link(seed) for seed in range(10)]
    assert kinds[RING] is False
    assert kinds[TWIN_WINGS] is True
    assert 2 <= sum(kinds) <= 8
