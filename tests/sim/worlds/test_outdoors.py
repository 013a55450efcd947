from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.outdoors import Thing, building, car, hall, hedge, lamp, tree
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams

SMALL = (tree, lamp, hedge, car)


def below_head(thing: Thing) -> FloatArray:
    """Return the corners that a robot could touch."""
    return np.asarray(thing.mesh.vertices[thing.mesh.vertices[:, 2] < 2.0], dtype=np.float64)


@pytest.mark.parametrize("draw", SMALL)
def test_things_stand_on_their_footprint(draw: Callable[[np.random.Generator], Thing]) -> None:
    for seed in range(10):
        thing = draw(np.random.default_rng(seed))
        assert np.abs(below_head(thing)[:, 0]).max() <= thing.length / 2 + 1e-6
        assert np.abs(below_head(thing)[:, 1]).max() <= thing.width / 2 + 1e-6
        assert thing.mesh.vertices[:, 2].min() <= 0.0
        assert thing.mesh.vertices[:, 2].max() > 0.7


@pytest.mark.parametrize("seed", range(10))
def test_building_stands_on_its_footprint(seed: int) -> None:
    thing = building(30.0, 18.0, np.random.default_rng(seed))
    low, high = thing.mesh.vertices.min(axis=0), thing.mesh.vertices.max(axis=0)
    assert low[:2] == pytest.approx([-13.8, -9.0])
    assert high[:2] == pytest.approx([13.8, 9.0])
    assert 5.5 < high[2] < 17.5


def test_crowns_are_above_the_heads_of_those_who_pass() -> None:
    for seed in range(10):
        thing = tree(np.random.default_rng(seed))
        assert np.abs(below_head(thing)[:, :2]).max() <= 0.25


@pytest.mark.parametrize("seed", range(10))
def test_hall_is_open_from_end_to_end(seed: int) -> None:
    thing = hall(45.0, 15.6, np.random.default_rng(seed))
    caster = RayCaster(World("hall", *thing.mesh, np.zeros((2, 3))))
    outside, ahead = np.array([[-30.0, 0.0, 0.5]]), np.array([[1.0, 0.0, 0.0]])
    assert beams.ranges(caster, outside, ahead)[0, 0] == np.inf
    # Beside the entrance is the front.
    beside = outside + (0.0, 4.0, 0.0)
    assert beams.ranges(caster, beside, ahead)[0, 0] == pytest.approx(30.0 - 22.5, abs=1e-4)
    # Nothing of it reaches out of its walls, and there is a ceiling.
    assert np.abs(thing.mesh.vertices[:, :2]).max(axis=0) == pytest.approx([22.5, 7.8])
    up = beams.ranges(caster, np.array([[0.0, 0.0, 0.5]]), np.array([[0.0, 0.0, 1.0]]))
    assert up[0, 0] == pytest.approx(3.2 - 0.5, abs=1e-4)


def test_halls_have_rooms_beside_their_corridors() -> None:
    inside = np.column_stack([np.linspace(-20.0, 20.0, 80), np.zeros(80), np.full(80, 0.5)])
    sideways = np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    deep = 0
    for seed in range(10):
        thing = hall(45.0, 15.6, np.random.default_rng(seed))
        caster = RayCaster(World("hall", *thing.mesh, np.zeros((2, 3))))
        ranges = beams.ranges(caster, inside, sideways)
        assert ranges.min() > 0.9
        assert ranges.max() < 7.8
        deep += int(ranges.max() > 2.5)
    assert deep >= 7
