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
from hmt_service.sim.simulation import simulate
from hmt_service.sim.usual import USUAL_ROBOTS
from hmt_service.sim.worlds.families import Family, draw
from hmt_service.sim.worlds.world import World


def borders_of(world: World) -> FloatArray:
    """Return where the robot truly was when it entered each area but the first, (B, 3), m."""
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
    return np.array([positions[visit.first_keyframe] for visit in engine.stored().visits[1:]])


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
