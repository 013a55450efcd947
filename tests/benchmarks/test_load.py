"""Load: a lap that ends where it began, again and again, and a small daemon from end to end."""

from __future__ import annotations

from itertools import islice, pairwise

import numpy as np
import pytest

from benchmarks.clients import Question, ask_together
from benchmarks.load import Workload, closed, endless, loaded, there_and_back
from benchmarks.serving import serving
from hmt_service.core.geometry import Pose, inverse
from hmt_service.core.types import OdometryReading, Scan, StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.sim.simulation import Instant
from hmt_service.sim.worlds.families import Family, draw

PERIOD_S = 0.5


def round_and_round(steps: int, laps: int) -> tuple[Instant, ...]:
    """Drive on a circle of 1 m around; the wheels say that it is 10 % larger."""
    result = []
    for number in range(steps * laps):
        truth, wheels = (on_circle(radius, number / steps) for radius in (1.0, 1.1))
        stamp_s = PERIOD_S * number
        scan = Scan(stamp_s, np.ones((1, 3)), np.zeros(3))
        readings = (OdometryReading(stamp_s, wheels), scan)
        result.append(Instant(StampedPose(stamp_s, truth), 0, readings))
    return tuple(result)


def on_circle(radius_m: float, turns: float) -> Pose:
    pose = np.eye(4)
    sin, cos = np.sin(2.0 * np.pi * turns), np.cos(2.0 * np.pi * turns)
    pose[:2, :2] = [[cos, -sin], [sin, cos]]
    pose[:2, 3] = radius_m * cos, radius_m * sin
    return pose


def test_a_lap_ends_where_it_began() -> None:
    lap = closed(round_and_round(40, 3), PERIOD_S)
    assert len(lap.readings) == 2 * 40
    step = inverse(on_circle(1.0, 0.0)) @ on_circle(1.0, 1.0 / 40)
    assert lap.end_from_begin == pytest.approx(step, abs=1e-9)


def test_a_drive_that_never_returns_has_no_lap() -> None:
    with pytest.raises(InvalidInput, match=r"of 30 scans"):
        closed(round_and_round(40, 3)[:30], PERIOD_S)


def test_stamps_and_odometry_go_on_from_lap_to_lap() -> None:
    lap = closed(round_and_round(40, 3), PERIOD_S)
    readings = list(islice(endless(lap), 2 * 40 * 3))
    odometry = [r for r in readings if isinstance(r, OdometryReading)]
    assert [r.stamp_s for r in odometry] == pytest.approx(np.arange(120) * PERIOD_S)
    steps_m = [
        np.linalg.norm((inverse(a.odom_from_body) @ b.odom_from_body)[:3, 3])
        for a, b in pairwise(odometry)
    ]
    seams = [39, 79]
    chord_m = 2.0 * np.sin(np.pi / 40)
    assert np.delete(steps_m, seams) == pytest.approx(1.1 * chord_m)
    assert np.array(steps_m)[seams] == pytest.approx(chord_m)  # nobody's wheels saw the seam


def test_a_route_there_and_back_stays_on_the_way() -> None:
    world = draw(Family.OFFICE, 0)
    route = there_and_back(world, 5.0).route_m
    ways_m = np.linalg.norm(np.diff(route, axis=0), axis=1)
    assert route[0] == pytest.approx(route[-1])
    assert {tuple(point) for point in route} <= {tuple(point) for point in world.route_m}
    assert ways_m.sum() >= 6 * 5.0


def test_a_loaded_daemon_answers_everybody() -> None:
    result = loaded(Workload(Family.OFFICE, rows=0, rate_hz=10.0, way_m=3.0), 8.0)
    assert result["scans"] == 80
    assert result["lost"] == 0
    assert result["maps"] > 0
    assert result["areas"] >= 1
    assert all(0.0 < ms["p50"] <= ms["max"] for ms in result["ms"].values())
    assert 0.5 < result["growth"] < 2.0


def test_clients_that_ask_together_are_many() -> None:
    with serving() as endpoint:
        asked = ask_together(endpoint, Question.POSE, clients=3, period_s=0.1, for_s=0.3)
    assert asked == []  # nobody is anywhere yet, and that is no answer
