"""Areas come out alike whichever way the robot passes through a building."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree

from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredMap
from hmt_service.sim.simulation import simulate
from hmt_service.sim.usual import USUAL_ROBOTS
from hmt_service.sim.worlds.families import Family, draw
from hmt_service.sim.worlds.plan import Box, interior, on_floor
from hmt_service.sim.worlds.world import World


def mapped(world: World) -> tuple[StoredMap, FloatArray]:
    """Return the map of a world, and where the robot truly was at each keyframe, (K, 3), m."""
    odometry, engine = Odometry(load_config()), Engine(load_config())
    positions = []
    for instant in simulate(world, USUAL_ROBOTS[Family.OFFICE], 0):
        for reading in instant.readings:
            tracking = odometry.process(reading)
            if tracking is None:
                continue
            engine.process(tracking)
            if tracking.keyframe is not None:
                positions.append(instant.truth.reference_from_body[:3, 3])
    engine.finish()
    return engine.stored(), np.array(positions)


def borders_of(world: World) -> FloatArray:
    """Return where the robot truly was when it entered each area but the first, (B, 3), m."""
    stored, positions = mapped(world)
    return np.array([positions[visit.first_keyframe] for visit in stored.visits[1:]])


def room_with_two_doors() -> World:
    """Return a room in the middle of a ring of corridors, entered from the west, then the east."""
    room = Box(0.0, 0.0, 8.0, 6.0)
    doors = [Box(-0.4, 2.4, 0.0, 3.6), Box(8.0, 2.4, 8.4, 3.6)]
    ring = [
        Box(-2.4, -14.0, -0.4, 12.0),
        Box(8.4, -14.0, 10.4, 12.0),
        Box(-2.4, -14.0, 10.4, -12.0),
        Box(-2.4, 10.0, 10.4, 12.0),
    ]
    standing = [
        Box(0.0, 0.0, 1.5, 0.8),
        Box(5.0, 5.2, 7.5, 6.0),
        Box(3.6, 0.0, 4.4, 1.2),
        Box(1.2, 5.0, 1.8, 6.0),
        Box(-2.4, -8.0, -1.9, -6.0),
        Box(9.9, -3.0, 10.4, -1.5),
        Box(2.0, -14.0, 3.0, -13.6),
        Box(6.0, 11.5, 8.0, 12.0),
    ]
    middle = [(4.0, 3.0), (4.0, 4.0), (2.5, 3.0)]
    route = [
        (-1.4, -11.0),
        (-1.4, 3.0),
        *middle,
        (-1.4, 3.0),
        (-1.4, -13.0),
        (9.4, -13.0),
        (9.4, 3.0),
        *reversed(middle),
        (9.4, 3.0),
        (9.4, 9.0),
    ]
    mesh = interior([room, *doors, *ring], standing)
    return World("two doors", mesh.vertices, mesh.triangles, on_floor(route))


@pytest.mark.parametrize("seed", [0, 1])
def test_borders_lie_where_they_lie_on_the_way_back(seed: int) -> None:
    world = draw(Family.OFFICE, seed)
    there = borders_of(world)
    back = borders_of(replace(world, route_m=np.asarray(world.route_m)[::-1]))
    assert abs(len(there) - len(back)) <= 1
    # Where nothing marks a border, as in the middle of a corridor, it may lie anywhere.
    for one, other in ((there, back), (back, there)):
        distances_m, _ = KDTree(other).query(one)
        assert np.median(distances_m) < 2.0
        assert np.mean(distances_m < 3.0) > 0.8


def test_room_is_one_area_whichever_door_it_is_entered_by() -> None:
    stored, positions = mapped(room_with_two_doors())
    best = stored.hypotheses[0]
    assert np.exp(best.log_weight) > 0.9
    is_inside = (np.abs(positions[:, :2] - (4.0, 3.0)) < (3.5, 2.5)).all(axis=1)
    area_of = np.concatenate(
        [
            np.full(visit.last_keyframe - visit.first_keyframe + 1, assignment.area)
            for visit, assignment in zip(stored.visits, best.assignments, strict=True)
        ]
    )
    inside = np.flatnonzero(is_inside)
    # The two stays, with the way around between them.
    first, second = np.split(inside, [int(np.argmax(np.diff(inside))) + 1])
    assert second[0] - first[-1] > 20
    areas = [np.bincount(area_of[stay]).argmax() for stay in (first, second)]
    assert areas[0] == areas[1]
    for stay in (first, second):
        assert np.mean(area_of[stay] == areas[0]) > 0.7
