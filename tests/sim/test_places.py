from __future__ import annotations

import math

import numpy as np

from hmt_service.sim.places import Places
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.plan import Box, mesh_of
from hmt_service.sim.worlds.world import World


def places(*boxes: Box, radius_m: float = 2.0) -> Places:
    """Return no places yet in a world of boxes, far away from which there is one more."""
    vertices, triangles = mesh_of([Box(900.0, 900.0, 901.0, 901.0), *boxes])
    return Places(RayCaster(World("boxes", vertices, triangles, np.zeros((2, 3)))), radius_m)


def at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return np.array([x, y, z])


def test_place_reaches_as_far_as_its_radius() -> None:
    here = places(radius_m=2.0)
    assert [here.at(at(x)) for x in (0.0, 1.0, 2.0, 2.001, 4.0, 4.002)] == [0, 0, 0, 1, 1, 2]


def test_robot_that_returns_is_in_the_same_place() -> None:
    here = places()
    there = [here.at(at(x)) for x in np.arange(0.0, 20.0, 0.3)]
    back = [here.at(at(x, 0.1)) for x in np.arange(19.8, -0.1, -0.3)]
    assert max(there) == 9
    assert max(back) == 9
    assert here.at(at(0.0)) == 0


def test_nearest_of_several_places_wins() -> None:
    here = places(radius_m=2.0)
    assert [here.at(at(0.0)), here.at(at(2.5)), here.at(at(1.3)), here.at(at(1.2))] == [0, 1, 1, 0]


def test_wall_between_near_positions_makes_two_places() -> None:
    here = places(Box(-5.0, 0.45, 5.0, 0.55))
    assert [here.at(at(0.0, 0.0)), here.at(at(0.0, 1.0))] == [0, 1]
    assert [here.at(at(0.3, 0.1)), here.at(at(0.3, 0.9))] == [0, 1]


def test_open_door_joins_what_the_wall_divides() -> None:
    here = places(Box(-5.0, 0.45, -0.5, 0.55), Box(0.5, 0.45, 5.0, 0.55))
    assert [here.at(at(0.0, 0.0)), here.at(at(0.0, 1.0))] == [0, 0]


def test_low_step_does_not_hide_a_place() -> None:
    assert [(here := places(Box(0.4, -1.0, 0.6, 1.0, 0.3))).at(at(0.0)), here.at(at(1.0))] == [0, 0]


def test_nearer_place_behind_a_wall_does_not_count() -> None:
    here = places(Box(-5.0, 0.45, 5.0, 0.55))
    assert here.at(at(0.0, 1.0)) == 0
    assert here.at(at(-1.8, 0.3)) == 1
    # 0.7 m from the first, which is behind the wall, and 1.8 m from the second.
    assert here.at(at(0.0, 0.3)) == 1


def test_floors_above_each_other_are_different_places() -> None:
    here = places(Box(-5.0, -5.0, 5.0, 5.0, 0.2, base=2.4), radius_m=4.0)
    assert [here.at(at(0.0)), here.at(at(0.0, 0.0, 2.6)), here.at(at(1.0))] == [0, 1, 0]


def test_standing_still_stays_in_the_place() -> None:
    here = places()
    assert {here.at(at(3.0, 4.0)) for _ in range(5)} == {0}


def test_positions_across_cells_are_found_like_by_comparing_with_all() -> None:
    here = places(radius_m=1.5)
    founded: list[np.ndarray] = []
    for position in np.random.default_rng(0).uniform(-6.0, 6.0, (600, 3)) * (1.0, 1.0, 0.2):
        distances = [math.dist(position, each) for each in founded]
        near = min(distances, default=math.inf) <= 1.5
        if not near:
            founded.append(position)
        expected = int(np.argmin(distances)) if near else len(founded) - 1
        assert here.at(position) == expected
    assert len(founded) > 40
