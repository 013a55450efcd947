from __future__ import annotations

import numpy as np
import pytest

from hmt_service.sim.worlds.corridors import lined
from hmt_service.sim.worlds.plan import Box

CORRIDOR = Box(0.0, 0.0, 60.0, 2.6)
CROSSING = Box(30.0, -40.0, 32.6, 40.0)
MIDDLE = [Box(0.0, 0.6, 60.0, 2.0), Box(30.6, -40.0, 32.0, 40.0)]


def inside(box: Box, areas: list[Box]) -> bool:
    return any(
        area.x_min <= box.x_min
        and area.y_min <= box.y_min
        and box.x_max <= area.x_max
        and box.y_max <= area.y_max
        for area in areas
    )


@pytest.mark.parametrize("seed", range(10))
def test_the_middle_of_corridors_stays_free(seed: int) -> None:
    _, standing = lined([CORRIDOR, CROSSING], np.random.default_rng(seed))
    assert len(standing) > 10
    assert not any(box.overlaps(lane) for box in standing for lane in MIDDLE)


@pytest.mark.parametrize("seed", range(10))
def test_everything_stands_on_free_ground(seed: int) -> None:
    free, standing = lined([CORRIDOR, CROSSING], np.random.default_rng(seed))
    grown = [box.grown(1e-9) for box in free]
    assert all(inside(box, grown) for box in standing)


@pytest.mark.parametrize("seed", range(10))
def test_rooms_and_niches_do_not_share_ground(seed: int) -> None:
    free, _ = lined([CORRIDOR, CROSSING], np.random.default_rng(seed))
    openings = free[2:]
    assert len(openings) > 5
    for index, opening in enumerate(openings):
        shared = [other for other in openings[:index] if opening.overlaps(other)]
        # Only a doorway shares ground, with its own room.
        assert len(shared) <= 1


def test_no_room_reaches_into_ground_that_is_kept() -> None:
    kept = [Box(-10.0, 2.8, 70.0, 20.0), Box(20.0, -20.0, 40.0, -0.2)]
    free, _ = lined([CORRIDOR], np.random.default_rng(1), kept)
    assert len(free) > 3
    assert not any(box.overlaps(area) for box in free for area in kept)


def test_corridors_are_the_first_of_the_free_ground() -> None:
    free, _ = lined([CORRIDOR, CROSSING], np.random.default_rng(0))
    assert free[:2] == [CORRIDOR, CROSSING]
