from __future__ import annotations

import numpy as np
import pytest

from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.long import long
from tests.sim.worlds import beams


@pytest.mark.parametrize("areas", [*range(1, 20), 50, 99, 101])
def test_route_is_free_whatever_the_number_of_areas(areas: int) -> None:
    world = long(1, areas)
    points = beams.along(world, 0.1) + (0.0, 0.0, 0.6)
    assert RayCaster(world).clearances(points).min() > 0.4
    assert np.linalg.norm(np.diff(world.route_m, axis=0), axis=1).min() > 0.0


@pytest.mark.parametrize("areas", [100, 1000, 10_000])
def test_route_and_memory_grow_with_the_number_of_areas(areas: int) -> None:
    world = long(0, areas)
    assert 6.8 < beams.length_m(world) / areas < 8.2
    assert (world.vertices.nbytes + world.triangles.nbytes) / areas < 1500.0


def test_route_enters_every_area_once_in_the_order_of_rows() -> None:
    world = long(0, 25)
    # From row to row 5 m; rows of 5 areas.
    rows = np.round(world.route_m[:, 1] / 5.0).astype(int)
    assert sorted(set(rows.tolist())) == [0, 1, 2, 3, 4]
    for row in range(5):
        x = world.route_m[rows == row, 0]
        assert len(np.unique(np.round(x, 6))) >= 5


def test_most_rows_look_back_into_the_row_before() -> None:
    world = long(0, 400)
    rows = np.round(world.route_m[:, 1] / 5.0).astype(int)
    steps = np.diff(rows)
    assert set(steps.tolist()) == {-1, 0, 1}
    # Back down once per row, except after the first, and up again each time besides the turns.
    assert np.sum(steps == -1) == 19
    assert np.sum(steps == 1) == 2 * 19


def test_areas_differ() -> None:
    world = long(0, 100)
    caster = RayCaster(world)
    middles = beams.along(world, 7.0) + (0.0, 0.0, 0.3)
    seen = np.minimum(beams.ranges(caster, middles, beams.level(60)), 6.0)
    for index in range(1, len(seen)):
        assert np.abs(seen[:index] - seen[index]).mean(axis=1).min() > 0.05


def test_one_area_is_a_closed_room() -> None:
    world = long(0, 1)
    caster = RayCaster(world)
    assert beams.ranges(caster, world.route_m + (0.0, 0.0, 0.3), beams.level(90)).max() < 9.0


def test_last_row_may_be_short_but_is_closed() -> None:
    world = long(0, 102)
    end = world.route_m[-1:] + (0.0, 0.0, 0.3)
    ahead = world.route_m[-1:] - world.route_m[-2:-1]
    ahead /= np.linalg.norm(ahead)
    assert beams.ranges(RayCaster(world), end, ahead)[0, 0] < 2.0
