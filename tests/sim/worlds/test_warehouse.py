from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from hmt_service.sim.worlds.warehouse import warehouse
from hmt_service.sim.worlds.world import World


def passes(world: World) -> list[tuple[float, int]]:
    """Return the aisle, x, and the direction of each pass along y, whole aisles only."""
    legs = np.diff(world.route_m, axis=0)
    longest = np.abs(legs[:, 1]).max()
    return [
        (round(float(start[0]), 3), int(np.sign(leg[1])))
        for start, leg in zip(world.route_m, legs, strict=False)
        if abs(leg[1]) == pytest.approx(longest)
    ]


@pytest.mark.parametrize("seed", range(10))
def test_aisles_are_driven_up_and_down_and_two_of_them_again(seed: int) -> None:
    found = passes(warehouse(seed))
    assert [direction for _, direction in found] == [1, -1, 1, -1, 1, -1]
    assert sorted(Counter(aisle for aisle, _ in found).values()) == [1, 1, 2, 2]


@pytest.mark.parametrize("seed", range(10))
def test_aisles_are_three_metres_wide_between_equal_racks(seed: int) -> None:
    world = warehouse(seed)
    # Posts are the only boxes of 10 cm x 10 cm.
    corners = world.vertices[: len(world.vertices) // 4 * 4]
    tall = np.isclose(corners[:, 2], 5.4)
    xs = np.unique(np.round(corners[tall, 0].astype(float), 2))
    gaps = np.round(np.diff(xs), 2)
    # Post, inside of a rack, post, flue, post, inside, post, aisle.
    assert set(gaps.tolist()) == {0.1, 0.9, 3.0}
    for aisle, _ in passes(world):
        assert np.abs(xs - aisle).min() == pytest.approx(1.5, abs=0.01)


def test_loads_vary_and_some_are_missing() -> None:
    first, second = warehouse(4), warehouse(5)
    for world in (first, second):
        heights = world.vertices[:, 2]
        on_top = heights[(heights > 3.6 + 0.8) & (heights < 3.6 + 1.6)]
        assert len(np.unique(on_top)) > 100
