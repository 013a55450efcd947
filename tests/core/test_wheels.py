"""Wheels that are wrong for good, and what is learnt of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_service.core.config import MotionConfig, load_config
from hmt_service.core.geometry import FloatArray, Pose, inverse, log, planar_pose
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Scan, TrackingFailure
from hmt_service.core.wheels import WheelCalibration
from tests.core.factories import ROOM, drifting, drive, motion_covariance

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


def test_what_was_learnt_in_sight_holds_when_nothing_is_seen() -> None:
    lap = 2.0 * np.pi * np.linspace(0.0, 4.0, 240)
    circles = [planar_pose(1.2 * np.sin(s), -1.2 * np.cos(s), s) for s in lap]
    wheels = drifting(circles, scale=1.1, turn_rad_per_m=0.02)
    readings = drive(ROOM, circles, odometry=wheels, noise=np.random.default_rng(3))
    odometry = Odometry(load_config())
    seen = len(readings) - 10
    tracked = []
    for position, reading in enumerate(readings):
        if isinstance(reading, Scan) and position >= seen:
            reading = replace(reading, points_in_body=np.zeros((0, 3)))
        tracking = odometry.process(reading)
        if tracking is not None:
            tracked.append(tracking)
    blind = tracked[-5:]
    assert {tracking.failure for tracking in blind} == {TrackingFailure.TOO_FEW_POINTS}
    before, last = tracked[-6], tracked[-1]
    assert before.keyframe_index == last.keyframe_index
    found = inverse(before.keyframe_from_body.mean) @ last.keyframe_from_body.mean
    true, told = (inverse(path[-6]) @ path[-1] for path in (circles, wheels))
    missed_m = np.linalg.norm((found - true)[:2, 3])
    assert missed_m < 0.3 * np.linalg.norm((told - true)[:2, 3])
