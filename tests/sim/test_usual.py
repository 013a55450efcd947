"""The usual robot of every family, in ten worlds each: it touches nothing, and sends numbers."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from hmt_service.core.types import Scan
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.simulation import simulate
from hmt_service.sim.usual import USUAL_ROBOTS
from hmt_service.sim.worlds.families import Family, draw

EVERY_S = 0.4
HEIGHT_M = 0.5
ROBOT_M = 0.25
SCANS = 20


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("family", list(Family))
def test_it_touches_nothing_and_sends_finite_numbers(family: Family, seed: int) -> None:
    world, robot = draw(family, seed), USUAL_ROBOTS[family]
    driven = list(robot.follower.drive(world.route_m))[:: round(EVERY_S / 0.02)]
    body = np.array([pose.reference_from_body[:3, 3] for pose in driven])
    assert np.linalg.norm(body[-1, :2] - world.route_m[-1, :2]) < 1.0
    assert np.linalg.norm(np.diff(body, axis=0), axis=1).max() < 2.0 * ROBOT_M + 0.2
    assert RayCaster(world).clearances(body + [0.0, 0.0, HEIGHT_M]).min() > ROBOT_M
    for instant in islice(simulate(world, robot, seed, people=2), SCANS):
        assert np.isfinite(instant.truth.reference_from_body).all()
        for reading in instant.readings:
            if isinstance(reading, Scan):
                assert len(reading.points_in_body) > SCANS
                assert np.isfinite(reading.points_in_body).all()
            else:
                assert np.isfinite(reading.odom_from_body).all()
