"""Wheels that are wrong for good, and what is learnt of them."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.config import MotionConfig, load_config
from hmt_service.core.geometry import FloatArray, Pose, inverse, log, planar_pose
from hmt_service.core.odometry import Odometry
from hmt_service.core.wheels import WheelCalibration
from tests.core.factories import CORRIDOR, ROOM, drifting, drive, motion_covariance

SEEN = motion_covariance(0.002, 0.005)
SCALE, TURN, DRIFT = 1.08, 0.95, 0.02


def steps(count: int, seed: int = 0) -> list[tuple[Pose, Pose]]:
    """Return what wheels tell of steps, and the steps as registration finds them."""
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(count):
        length, turn = rng.uniform(0.2, 0.6), rng.normal(0.0, 0.3)
        true = planar_pose(length, 0.1 * turn, turn)
        told = planar_pose(SCALE * length, SCALE * 0.1 * turn, TURN * turn + DRIFT * length)
        noise = rng.normal(0.0, [0.005, 0.005, 0.002])
        result.append((told, true @ planar_pose(*noise)))
    return result


def learnt(taken: list[tuple[Pose, Pose]], covariance: FloatArray = SEEN) -> WheelCalibration:
    wheels = WheelCalibration(MotionConfig())
    for told, registered in taken:
        wheels.learn(told, registered, covariance)
    return wheels


def error_of(wheels: WheelCalibration, told: Pose, true: Pose) -> FloatArray:
    return np.asarray(np.abs(log(inverse(wheels.corrected(told)) @ true))[2:5])


def test_errors_that_are_the_same_in_every_step_are_learnt() -> None:
    wheels = learnt(steps(200))
    scale, turn, drift = wheels.errors
    assert scale == pytest.approx(1.0 / SCALE - 1.0, abs=0.01)
    assert turn == pytest.approx(1.0 / TURN - 1.0, abs=0.02)
    assert drift == pytest.approx(-DRIFT / SCALE / TURN, abs=0.005)
    true = planar_pose(0.5, 0.0, 0.0)
    told = planar_pose(SCALE * 0.5, 0.0, DRIFT * 0.5)
    assert error_of(WheelCalibration(MotionConfig()), told, true).max() > 0.03
    assert error_of(wheels, told, true).max() < 0.006


def test_wheels_that_are_right_stay_as_they_are() -> None:
    right = [(true, true) for _, true in steps(100)]
    assert np.abs(learnt(right).errors).max() < 1e-3


def test_one_slip_is_no_reason_to_think_worse_of_wheels() -> None:
    before = learnt(steps(100))
    told, registered = steps(101)[-1]
    slipped = told @ planar_pose(0.4, 0.0, 0.2)
    after = learnt([*steps(100), (slipped, registered)])
    assert np.array_equal(after.errors, before.errors)


def test_what_scans_do_not_see_teaches_nothing() -> None:
    blind = motion_covariance(0.002, 10.0)
    scale, _, drift = learnt(steps(100), blind).errors
    assert abs(scale) < 0.005
    assert drift == pytest.approx(-DRIFT / SCALE / TURN, abs=0.01)


def test_standing_still_teaches_nothing() -> None:
    noisy = planar_pose(0.004, 0.0, 0.001)
    assert not learnt([(planar_pose(0.0, 0.0, 0.0), noisy)] * 50).errors.any()


def test_what_was_learnt_in_a_room_holds_in_a_corridor() -> None:
    lap = 2.0 * np.pi * np.linspace(0.0, 4.0, 240)
    circles = [planar_pose(1.2 * np.sin(s), -1.2 * np.cos(s), s) for s in lap]
    halls = [planar_pose(100.0 + 0.1 * i, 0.2, 0.0) for i in range(100)]
    wheels = drifting([*circles], scale=1.1, turn_rad_per_m=0.0)
    along = [wheels[-1] @ pose for pose in drifting(halls, scale=1.1, turn_rad_per_m=0.0)]
    odometry = Odometry(load_config())
    noise = np.random.default_rng(3)
    readings = drive(ROOM, circles, odometry=wheels, noise=noise)
    for reading in readings:
        odometry.process(reading)
    corridor = drive(CORRIDOR, halls, odometry=along, noise=noise)
    begin_s = readings[-1].stamp_s + 10.0
    moved = []
    for reading in corridor:
        object.__setattr__(reading, "stamp_s", reading.stamp_s - 100.0 + begin_s)
        tracking = odometry.process(reading)
        if tracking is not None:
            moved.append(tracking)
    # Once it is in the corridor, the robot has only its wheels, which tell 10 % too much.
    kept = [t.keyframe for t in moved if t.keyframe is not None and t.failure is None]
    told_m = sum(float(keyframe.previous_from_body.mean[0, 3]) for keyframe in kept[1:])
    driven_m = kept[-1].stamp_s - kept[0].stamp_s  # at 1 m/s
    assert driven_m > 4.0
    assert told_m == pytest.approx(driven_m, rel=0.03)
