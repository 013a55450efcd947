from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from hmt_service.core.geometry import transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import Laser2d
from hmt_service.sim.simulation import Simulation, simulate
from hmt_service.sim.worlds.office import office
from hmt_service.sim.worlds.world import World


@cache
def world(seed: int) -> World:
    return office(seed)


@cache
def simulated(seed: int) -> Simulation:
    return simulate(world(seed), seed)


def as_bytes(reading: Reading) -> bytes:
    match reading:
        case Scan():
            return reading.points_in_body.tobytes()
        case OdometryReading():
            return reading.odom_from_body.tobytes()


def odometry_errors(simulation: Simulation) -> np.ndarray:
    """Return the distance between dead reckoning and the truth at every pose, m."""
    start = simulation.truth[0].reference_from_body
    reckoned = [
        (start @ reading.odom_from_body)[:2, 3]
        for reading in simulation.readings
        if isinstance(reading, OdometryReading)
    ]
    true = [pose.reference_from_body[:2, 3] for pose in simulation.truth]
    return np.asarray(np.linalg.norm(np.subtract(reckoned, true), axis=1))


def test_same_seed_sends_the_same_bytes() -> None:
    again = simulate(office(3), 3)
    assert len(again.readings) == len(simulated(3).readings)
    for first, second in zip(simulated(3).readings, again.readings, strict=True):
        assert first.stamp_s == second.stamp_s
        assert as_bytes(first) == as_bytes(second)


def test_other_seed_sends_other_noise_from_the_same_places() -> None:
    other = simulate(world(3), 4)
    assert as_bytes(other.readings[1]) != as_bytes(simulated(3).readings[1])
    for first, second in zip(simulated(3).truth, other.truth, strict=True):
        assert np.array_equal(first.reference_from_body, second.reference_from_body)


def test_odometry_comes_right_before_the_scan_of_the_same_stamp() -> None:
    readings, truth = simulated(1).readings, simulated(1).truth
    assert len(readings) == 2 * len(truth)
    for wheels, scan, pose in zip(readings[::2], readings[1::2], truth, strict=True):
        assert isinstance(wheels, OdometryReading)
        assert isinstance(scan, Scan)
        assert wheels.stamp_s == scan.stamp_s == pose.stamp_s


@pytest.mark.parametrize("seed", range(6))
def test_robot_keeps_clear_of_every_wall(seed: int) -> None:
    positions = np.array([pose.reference_from_body[:3, 3] for pose in simulated(seed).truth])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    # Shorter steps than the clearance: no wall can hide between two poses.
    assert steps.max() < 0.2
    at_laser_height = np.add(positions, [0.0, 0.0, 0.3])
    assert RayCaster(world(seed)).clearances(at_laser_height).min() > 0.2


def test_simulation_is_as_long_as_a_demo() -> None:
    simulation = simulated(1)
    positions = [pose.reference_from_body[:2, 3] for pose in simulation.truth]
    assert 150.0 < np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() < 230.0
    assert 1300 <= len(simulation.truth) <= 2100


@pytest.mark.parametrize("seed", range(3))
def test_odometry_drifts_by_metres(seed: int) -> None:
    errors = odometry_errors(simulated(seed))
    assert errors[0] == 0.0
    assert 1.0 < errors.max() < 15.0


def test_every_return_lies_on_a_surface_up_to_the_noise() -> None:
    simulation = simulated(2)
    scans = [reading for reading in simulation.readings if isinstance(reading, Scan)]
    caster = RayCaster(world(2))
    distances = np.concatenate(
        [
            caster.clearances(transform_points(pose.reference_from_body, scan.points_in_body))
            for pose, scan in list(zip(simulation.truth, scans, strict=True))[::100]
        ]
    )
    assert distances.max() < 5.5 * Laser2d().range_sigma_m
