"""A robot that wakes up in one of two identical rooms is undecided until it sees a difference."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray, Pose, inverse, planar_pose
from hmt_service.core.hypotheses import Hypothesis
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Reading, Scan
from hmt_service.sim.sensors import Laser2d
from hmt_service.sim.simulation import Robot, simulate
from hmt_service.sim.worlds.plan import Box, interior, on_floor
from hmt_service.sim.worlds.world import World

APART_M = 16.0
"""From one room to the other."""
ASLEEP_S = 30.0
ROBOT = Robot(sensor=Laser2d(max_range_m=8.0))
Y_M = -0.4
"""The middle of the corridor."""


def building(route_m: Sequence[tuple[float, float]]) -> World:
    """Return a corridor with two identical rooms, and a nook beside each that is not."""
    room = [Box(3.0, 1.0, 9.0, 6.0), Box(5.4, 0.6, 6.6, 1.0)]
    furniture = [
        Box(3.0, 5.2, 4.4, 6.0),
        Box(7.6, 3.0, 9.0, 3.6),
        Box(3.0, 1.0, 3.6, 2.6),
        Box(6.2, 5.5, 7.0, 6.0),
    ]
    nooks = [Box(-3.0, 0.6, -0.5, 2.0), Box(29.0, 0.6, 30.0, 1.2), Box(30.6, -2.4, 32.0, -1.4)]
    free = [Box(-12.0, -1.4, 40.0, 0.6), *nooks]
    standing = [Box(-5.0, -1.4, -4.2, -1.0), Box(33.5, 0.0, 35.5, 0.6)]
    for shift_m in (0.0, APART_M):
        free += [part.moved(shift_m, 0.0) for part in room]
        standing += [part.moved(shift_m, 0.0) for part in furniture]
    mesh = interior(free, standing)
    return World("twins", mesh.vertices, mesh.triangles, on_floor(route_m))


def inside(x_m: float) -> list[tuple[float, float]]:
    return [(x_m, 3.0), (x_m + 1.0, 4.5), (x_m - 1.0, 4.0), (x_m, 3.0)]


def drive(
    route_m: Sequence[tuple[float, float]], seed: int, begins_s: float
) -> Iterator[tuple[Reading, Pose]]:
    """Yield readings and true poses; what wakes up counts its wheels from somewhere else."""
    for instant in simulate(building(route_m), ROBOT, seed):
        for reading in instant.readings:
            later = replace(reading, stamp_s=reading.stamp_s + begins_s)
            if begins_s > 0.0 and not isinstance(later, Scan):
                elsewhere = planar_pose(1000.0, 0.0, 0.0) @ later.odom_from_body
                later = replace(later, odom_from_body=elsewhere)
            yield later, instant.truth.reference_from_body


@dataclass
class Awakening:
    """What is believed from keyframe to keyframe after the robot has woken up."""

    positions_m: list[FloatArray]
    """Where it is, each of shape (2,)."""
    beliefs: list[tuple[float, float]]
    """Probability that it is there, and that it is at the same place of the other room."""


def awakening(room: int, seed: int) -> Awakening:
    """Map both rooms, fall asleep between them, and wake up in one."""
    first_x, second_x = 6.0, 6.0 + APART_M
    mapping = [
        *((-10.0, Y_M), (first_x, Y_M), *inside(first_x), (first_x, Y_M)),
        *((second_x, Y_M), *inside(second_x), (second_x, Y_M), (36.0, Y_M), (14.0, Y_M)),
    ]
    own_x, ends = ((first_x, (-10.0, 36.0)), (second_x, (36.0, -10.0)))[room]
    told = list(drive(mapping, seed, 0.0))
    begins_s = told[-1][0].stamp_s + ASLEEP_S
    onward = [*inside(own_x), *((x, Y_M) for x in (own_x, *ends))]
    told += drive(onward, seed + 100, begins_s)
    odometry, engine = Odometry(load_config()), Engine(load_config(), seed=seed)
    truth: list[Pose] = []
    woken = Awakening([], [])
    mapped = 0
    for reading, world_from_body in told:
        tracking = odometry.process(reading)
        if tracking is None:
            continue
        engine.process(tracking)
        if tracking.keyframe is None:
            continue
        if reading.stamp_s < begins_s:
            mapped += 1
        truth.append(world_from_body)
        if len(truth) > mapped:
            woken.positions_m.append(world_from_body[:2, 3])
            woken.beliefs.append(believed(engine, truth, mapped))
    return woken


def believed(engine: Engine, truth: Sequence[Pose], mapped: int) -> tuple[float, float]:
    """Return the mass of the hypotheses that place the robot right, and in the other room.

    A hypothesis has no frame in common with the world but that of the mapped keyframe near which it
    believes the robot.
    """
    right = twin = 0.0
    particles = engine._particles
    for hypothesis, mass in zip(particles.hypotheses, particles.probabilities, strict=True):
        error = position_error_m(hypothesis, engine, truth, mapped)
        if np.linalg.norm(error) < 4.0:
            right += float(mass)
        elif abs(abs(error[0]) - APART_M) < 4.0:
            twin += float(mass)
    return right, twin


def position_error_m(
    hypothesis: Hypothesis, engine: Engine, truth: Sequence[Pose], mapped: int
) -> FloatArray:
    if hypothesis.current.area_from_visit is None:
        return np.full(2, np.inf)
    poses = hypothesis.keyframe_poses(engine._visits.values())
    near = int(np.argmin(np.linalg.norm(poses[:mapped, :3, 3] - poses[-1, :3, 3], axis=1)))
    believed_pose = truth[near] @ inverse(poses[near]) @ poses[-1]
    return np.asarray(believed_pose[:2, 3] - truth[-1][:2, 3])


@pytest.mark.parametrize("room", [0, 1])
def test_identical_rooms_share_the_mass_until_the_robot_sees_more(room: int) -> None:
    woken = awakening(room, seed=0)
    in_room = [y > 1.3 for _, y in woken.positions_m]
    for right, twin in np.array(woken.beliefs)[in_room]:
        assert right == pytest.approx(twin, abs=0.2 * max(right + twin, 0.1))
    assert sum(woken.beliefs[in_room.count(True) - 1]) > 0.9
    assert woken.beliefs[-1][0] > 0.95
