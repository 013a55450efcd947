from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import islice, pairwise

import numpy as np
import pytest

from hmt_service.core.geometry import inverse, transform_points
from hmt_service.core.local_map import deskew
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput
from hmt_service.sim import simulation
from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.sensors import Laser2d, Lidar3d
from hmt_service.sim.simulation import INDOOR_LASER, LIDAR, Instant, simulate
from hmt_service.sim.worlds.office import office
from hmt_service.sim.worlds.plan import Box, mesh_of
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


def corridor(length_m: float) -> World:
    """Return a straight corridor of a bend every 20 m, too long to be seen at once."""
    boxes = [
        Box(x, y, x + 5.0, y + 0.2)
        for number in range(int(length_m / 5.0))
        for x in (5.0 * number,)
        for y in (-2.0 - 0.3 * (number % 4), 2.0 + 0.2 * (number % 3))
    ]
    vertices, triangles = mesh_of(boxes)
    return World("corridor", vertices, triangles, np.array([[1.0, 0.0, 0.0], [length_m, 0.0, 0.0]]))


SPARSE = replace(INDOOR_LASER, sensor=Laser2d(beams=11, max_range_m=8.0))
SMALL_LIDAR = replace(LIDAR, sensor=Lidar3d(rows=4, columns=90))


def test_stretches_leave_no_trace_in_the_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    for robot in (SPARSE, replace(SMALL_LIDAR, drop_share=0.2)):
        at_once = list(simulate(corridor(30.0), robot, 5, people=4))
        with monkeypatch.context() as few:
            few.setattr(simulation, "_SCANS_AT_ONCE", 7)
            in_sevens = list(simulate(corridor(30.0), robot, 5, people=4))
        for one, other in zip(at_once, in_sevens, strict=True):
            assert one.truth.stamp_s == other.truth.stamp_s
            assert list(map(as_bytes, one.readings)) == list(map(as_bytes, other.readings))


@pytest.mark.parametrize("period_s", [0.05, 0.13, 0.2, 1.0])
def test_scans_come_once_per_period_until_the_drive_ends(period_s: float) -> None:
    robot = replace(SPARSE, scan_period_s=period_s)
    drive = list(robot.follower.drive(corridor(20.0).route_m))
    stamps = [instant.truth.stamp_s for instant in simulate(corridor(20.0), robot, 0)]
    assert stamps == [period_s * number for number in range(len(stamps))]
    assert drive[-1].stamp_s - period_s < stamps[-1] <= drive[-1].stamp_s + 1e-9


def test_truth_is_the_pose_of_the_drive_at_the_stamp() -> None:
    drive = {round(50 * pose.stamp_s): pose for pose in SPARSE.follower.drive(world(0).route_m)}
    for instant in islice(simulate(world(0), SPARSE, 0), 300):
        pose = drive[round(50 * instant.truth.stamp_s)].reference_from_body
        assert np.array_equal(instant.truth.reference_from_body, pose)


def test_declared_share_of_the_scans_is_lost_and_nothing_else_changes() -> None:
    whole = list(simulate(corridor(120.0), SPARSE, 2))
    lossy = list(simulate(corridor(120.0), replace(SPARSE, drop_share=0.3), 2))
    assert len(lossy) == len(whole) > 900
    for one, other in zip(whole, lossy, strict=True):
        kept = [as_bytes(reading) for reading in one.readings][: len(other.readings)]
        assert [as_bytes(reading) for reading in other.readings] == kept
    lost = np.mean([len(instant.readings) == 1 for instant in lossy])
    assert lost == pytest.approx(0.3, abs=5 * np.sqrt(0.3 * 0.7 / len(lossy)))


def test_all_scans_may_be_lost() -> None:
    blind = simulate(corridor(10.0), replace(SPARSE, drop_share=1.0), 0)
    assert {len(instant.readings) for instant in blind} == {1}


def test_people_hide_a_part_of_the_world_and_change_nothing_else() -> None:
    robot = replace(INDOOR_LASER, sensor=Laser2d(beams=181, min_range_m=0.0))
    empty, busy = (
        list(islice(simulate(world(1), robot, 1, people=people), 400)) for people in (0, 12)
    )
    hidden = 0
    for one, other in zip(empty, busy, strict=True):
        assert one.place == other.place
        assert as_bytes(one.readings[0]) == as_bytes(other.readings[0])
        alone = {point.tobytes() for point in scan_of(one).points_in_body}
        new = [p for p in scan_of(other).points_in_body if p.tobytes() not in alone]
        gone = len(alone) + len(new) - len(scan_of(other).points_in_body)
        assert gone <= len(new)
        hidden += len(new)
    assert hidden > 400


def test_places_are_numbered_as_found_and_found_again() -> None:
    places = [instant.place for instant in simulated(1)]
    first_seen = list(dict.fromkeys(places))
    assert first_seen == list(range(len(first_seen)))
    # The last third of the route repeats the first one.
    last = places[-len(places) // 4 :]
    assert np.mean(np.isin(last, places[: len(places) // 2])) > 0.9


def test_lidar_scan_belongs_where_the_truth_is_at_its_stamp() -> None:
    robot = replace(SMALL_LIDAR, sensor=Lidar3d(rows=4, columns=90, range_sigma_m=0.0))
    hall = corridor(20.0)
    caster = RayCaster(hall)
    for before, instant in pairwise(islice(simulate(hall, robot, 0), 40)):
        pose, scan = instant.truth.reference_from_body, scan_of(instant)
        assert scan.point_times is not None
        motion = inverse(before.truth.reference_from_body) @ pose
        points = deskew(scan.points_in_body, scan.point_times, motion)
        assert caster.clearances(transform_points(pose, points)).max() < 5e-3


def test_memory_does_not_grow_with_the_drive() -> None:
    # To and fro, so that the explored space does not grow either.
    ends = np.array([[1.0, 0.0, 0.0], [30.0, 0.0, 0.0]])
    shuttle = replace(corridor(30.0), route_m=np.tile(ends, (20, 1)))

    def peak(scans: int) -> int:
        instants = simulate(shuttle, SPARSE, 0, people=3)
        for _ in islice(instants, 300):
            pass
        tracemalloc.start()
        try:
            for _ in islice(instants, scans):
                pass
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    assert peak(1500) < 1.2 * peak(300)


def test_route_that_cannot_be_driven_is_refused_at_once() -> None:
    still = replace(corridor(10.0), route_m=np.zeros((2, 3)))
    with pytest.raises(InvalidInput, match="route"):
        simulate(still, SPARSE, 0)
    with pytest.raises(InvalidInput, match="people"):
        simulate(corridor(10.0), SPARSE, 0, people=-1)
