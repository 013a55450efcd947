from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.nested_loops import nested_loops
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams


def closures(world: World) -> list[tuple[float, float]]:
    """Return, for each waypoint that was one before, when it was and when it is again, m."""
    legs = np.linalg.norm(np.diff(world.route_m, axis=0), axis=1)
    at: FloatArray = np.concatenate([[0.0], np.cumsum(legs)])
    first: dict[tuple[float, ...], float] = {}
    found = []
    for point, travelled in zip(map(tuple, world.route_m.tolist()), at.tolist(), strict=True):
        if point in first:
            found.append((first[point], travelled))
        first.setdefault(point, travelled)
    return found


@pytest.mark.parametrize("seed", range(10))
def test_building_is_as_large_as_killian_court(seed: int) -> None:
    width, height = np.ptp(nested_loops(seed).route_m[:, :2], axis=0)
    assert 80.0 <= width <= 120.0
    assert 60.0 <= height <= 90.0


@pytest.mark.parametrize("seed", range(10))
def test_small_loops_close_before_the_large_one_around_them(seed: int) -> None:
    (first_start, first_end), (second_start, second_end), (large_start, large_end), *_ = closures(
        nested_loops(seed)
    )
    assert first_start == large_start == 0.0
    assert 80.0 < first_end < 200.0
    assert first_end < second_start < second_end < large_end
    assert 80.0 < second_end - second_start < 200.0
    assert large_end - first_end > 300.0


@pytest.mark.parametrize("seed", range(10))
def test_last_passage_is_new_ground_that_ends_on_old(seed: int) -> None:
    world = nested_loops(seed)
    *before, entry, middle, end = world.route_m
    assert not any(
        np.array_equal(middle, point) or np.array_equal(entry, point) for point in before
    )
    assert any(np.array_equal(end, point) for point in before)


def test_seeds_mirror_the_building() -> None:
    firsts = {
        tuple(np.sign(np.diff(nested_loops(seed).route_m, axis=0)[:2].sum(axis=0)))
        for seed in range(12)
    }
    assert len(firsts) == 4


def test_more_laps_are_longer_by_the_closed_loops() -> None:
    once, twice = nested_loops(0), nested_loops(0, laps=2)
    assert beams.length_m(twice) - beams.length_m(once) == pytest.approx(closures(once)[2][1])
