from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from hmt_service.core.geometry import transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import Laser2d
from hmt_service.sim.simulation import INDOOR_LASER, Instant, simulate
from hmt_service.sim.worlds.office import office
from hmt_service.sim.worlds.world import World


@cache
def world(seed: int) -> World:
    return office(seed)


@cache
def simulated(seed: int) -> tuple[Instant, ...]:
    return tuple(simulate(world(seed), INDOOR_LASER, seed))


def scan_of(instant: Instant) -> Scan:
    scan = instant.readings[1]
    assert isinstance(scan, Scan)
    return scan


def as_bytes(reading: Reading) -> bytes:
    match reading:
        case Scan():
            return reading.points_in_body.tobytes()
        case OdometryReading():
            return reading.odom_from_body.tobytes()


def odometry_errors(instants: Sequence[Instant]) -> np.ndarray:
    """Return the distance between dead reckoning and the truth at every pose, m."""
    start = instants[0].truth.reference_from_body
    reckoned = [
        (start @ reading.odom_from_body)[:2, 3]
        for instant in instants
        for reading in instant.readings
        if isinstance(reading, OdometryReading)
    ]
    true = [instant.truth.reference_from_body[:2, 3] for instant in instants]
    return np.asarray(np.linalg.norm(np.subtract(reckoned, true), axis=1))


def test_same_seed_sends_the_same_bytes() -> None:
    again = tuple(simulate(office(3), INDOOR_LASER, 3))
    for first, second in zip(simulated(3), again, strict=True):
        assert first.place == second.place
        for one, other in zip(first.readings, second.readings, strict=True):
            assert one.stamp_s == other.stamp_s
            assert as_bytes(one) == as_bytes(other)


def test_other_seed_sends_other_noise_from_the_same_places() -> None:
    other = tuple(simulate(world(3), INDOOR_LASER, 4))
    assert as_bytes(other[0].readings[1]) != as_bytes(simulated(3)[0].readings[1])
    for first, second in zip(simulated(3), other, strict=True):
        assert first.place == second.place
        assert np.array_equal(first.truth.reference_from_body, second.truth.reference_from_body)


def test_odometry_comes_right_before_the_scan_of_the_same_stamp() -> None:
    for instant in simulated(1):
        wheels, scan = instant.readings
        assert isinstance(wheels, OdometryReading)
        assert isinstance(scan, Scan)
        assert wheels.stamp_s == scan.stamp_s == instant.truth.stamp_s


@pytest.mark.parametrize("seed", range(6))
def test_robot_keeps_clear_of_every_wall(seed: int) -> None:
    positions = np.array([each.truth.reference_from_body[:3, 3] for each in simulated(seed)])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    # Shorter steps than the clearance: no wall can hide between two poses.
    assert steps.max() < 0.2
    at_laser_height = np.add(positions, [0.0, 0.0, 0.3])
    assert RayCaster(world(seed)).clearances(at_laser_height).min() > 0.2


def test_simulation_is_as_long_as_a_demo() -> None:
    instants = simulated(1)
    positions = [instant.truth.reference_from_body[:2, 3] for instant in instants]
    assert 150.0 < np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() < 230.0
    assert 1300 <= len(instants) <= 2100


@pytest.mark.parametrize("seed", range(3))
def test_odometry_drifts_by_metres(seed: int) -> None:
    errors = odometry_errors(simulated(seed))
    assert errors[0] == 0.0
    assert 1.0 < errors.max() < 15.0


def test_every_return_lies_on_a_surface_up_to_the_noise() -> None:
    caster = RayCaster(world(2))
    distances = np.concatenate(
        [
            caster.clearances(
                transform_points(instant.truth.reference_from_body, scan_of(instant).points_in_body)
            )
            for instant in simulated(2)[::100]
        ]
    )
    assert distances.max() < 5.5 * Laser2d().range_sigma_m
