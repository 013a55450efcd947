"""The metric level on known paths through worlds of straight walls."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from hmt_service.core.config import Config, load_config
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, log, planar_pose
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import (
    Keyframe,
    OdometryReading,
    Reading,
    Scan,
    Tracking,
    TrackingFailure,
)
from tests.core.factories import CORRIDOR, ROOM, box, drifting, drive, line, points_from

CURVE = [
    planar_pose(-2.0 + 4.0 * s, -0.3 + 0.6 * np.sin(5.0 * s), 0.6 * np.sin(4.0 * s))
    for s in np.linspace(0.0, 1.0, 80)
]
START = CURVE[0]
TRUE_WHEELS = [inverse(START) @ pose for pose in CURVE]


def track(readings: Sequence[Reading], config: Config | None = None) -> list[Tracking]:
    odometry = Odometry(config or load_config())
    trackings = [odometry.process(reading) for reading in readings]
    return [tracking for tracking in trackings if tracking is not None]


def keyframes_of(trackings: Sequence[Tracking]) -> list[Keyframe]:
    return [t.keyframe for t in trackings if t.keyframe is not None]


def poses_of(trackings: Sequence[Tracking]) -> list[Pose]:
    """Return the pose of every scan in the frame of the first."""
    keyframes = [identity()]
    for keyframe in keyframes_of(trackings)[1:]:
        keyframes.append(keyframes[-1] @ keyframe.previous_from_body.mean)
    return [keyframes[t.keyframe_index] @ t.keyframe_from_body.mean for t in trackings]


def largest_error(trackings: Sequence[Tracking], path: Sequence[Pose]) -> FloatArray:
    """Return the largest error of heading (rad) and of position (m) on the way."""
    errors = np.array(
        [
            log(inverse(inverse(path[0]) @ truth) @ pose)
            for truth, pose in zip(path, poses_of(trackings), strict=True)
        ]
    )
    return np.array([np.abs(errors[:, 2]).max(), np.linalg.norm(errors[:, 3:], axis=1).max()])


@pytest.mark.parametrize("is_noisy", [False, True])
@pytest.mark.parametrize(
    "wheels",
    [TRUE_WHEELS, drifting(CURVE, scale=1.1, turn_rad_per_m=0.05), None],
    ids=["true wheels", "biased wheels", "no wheels"],
)
def test_path_through_a_room_is_tracked(wheels: list[Pose] | None, is_noisy: bool) -> None:
    noise = np.random.default_rng(1) if is_noisy else None
    trackings = track(drive(ROOM, CURVE, odometry=wheels, noise=noise))
    assert [t.failure for t in trackings] == [None] * len(CURVE)
    heading_rad, position_m = largest_error(trackings, CURVE)
    assert heading_rad < 0.02
    assert position_m < 0.03


def test_biased_wheels_alone_would_be_far_off() -> None:
    # What the test above would pass with if the scans were not looked at.
    wheels = drifting(CURVE, scale=1.1, turn_rad_per_m=0.05)
    assert np.linalg.norm(wheels[-1][:2, 3] - TRUE_WHEELS[-1][:2, 3]) > 0.3


def test_poses_are_planar_exactly() -> None:
    for tracking in track(drive(ROOM, CURVE, odometry=TRUE_WHEELS)):
        pose = tracking.keyframe_from_body.mean
        assert np.abs(pose[2] - [0.0, 0.0, 1.0, 0.0]).max() < 1e-15
        sigma = np.sqrt(np.diag(tracking.keyframe_from_body.covariance))
        assert sigma[[0, 1, 5]].max() < 2e-3


@pytest.mark.parametrize("scale", [1.0, 1.05, 0.9])
def test_wheels_say_how_far_a_corridor_was_followed(scale: float) -> None:
    path = line(identity(), length_m=10.0, step_m=0.1)
    wheels = drifting(path, scale=scale, turn_rad_per_m=0.0)
    trackings = track(drive(CORRIDOR, path, odometry=wheels))
    last = poses_of(trackings)[-1]
    assert last[0, 3] == pytest.approx(10.0 * scale, abs=1e-3)
    assert last[1, 3] == pytest.approx(0.0, abs=5e-3)


def test_position_along_a_corridor_is_as_uncertain_as_the_wheels() -> None:
    path = line(identity(), length_m=2.0, step_m=0.1)
    config = load_config(text="odometry: {keyframe_distance_m: 1.0}")
    trackings = track(drive(CORRIDOR, path, odometry=[inverse(path[0]) @ p for p in path]), config)
    covariance = keyframes_of(trackings)[1].previous_from_body.covariance
    # Ten steps of 0.1 m, each with a standard deviation of floor plus share of the way.
    along = np.sqrt(10.0) * (0.02 + 0.1 * 0.1)
    assert np.sqrt(covariance[3, 3]) == pytest.approx(along, rel=0.01)
    assert np.sqrt(covariance[4, 4]) < 0.2 * along


def test_position_along_a_corridor_without_wheels_is_less_certain() -> None:
    still = [identity()] * 11
    known, guessed = (
        track(drive(CORRIDOR, still, odometry=wheels))[-1].keyframe_from_body.covariance
        for wheels in (still, None)
    )
    # Five times less is known of every step, see `constant_velocity_factor`.
    assert np.sqrt(known[3, 3]) == pytest.approx(np.sqrt(10.0) * 0.02, rel=0.01)
    assert np.sqrt(guessed[3, 3]) == pytest.approx(5.0 * np.sqrt(10.0) * 0.02, rel=0.01)


def test_standing_still_adds_no_keyframe() -> None:
    readings = drive(ROOM, [START] * 60, noise=np.random.default_rng(2), period_s=1.0)
    trackings = track(readings)
    assert len(keyframes_of(trackings)) == 1
    assert {t.keyframe_index for t in trackings} == {0}


@pytest.mark.parametrize(
    ("step", "keyframes"),
    [(planar_pose(0.051, 0.0, 0.0), 3), (planar_pose(0.0, 0.0, 0.037), 3)],
    ids=["moving", "turning"],
)
def test_keyframes_come_by_distance_and_by_angle(step: Pose, keyframes: int) -> None:
    path = [START @ np.linalg.matrix_power(step, i) for i in range(25)]
    trackings = track(drive(ROOM, path, odometry=path))
    found = keyframes_of(trackings)
    assert [k.index for k in found] == list(range(keyframes))
    assert [i for i, t in enumerate(trackings) if t.keyframe is not None] == [0, 10, 20]
    assert all(t.keyframe_index == i // 10 for i, t in enumerate(trackings))
    for keyframe in found[1:]:
        assert keyframe.previous_from_body.mean == pytest.approx(
            np.linalg.matrix_power(step, 10), abs=0.02
        )


def test_keyframe_carries_what_its_scan_saw() -> None:
    readings = drive(ROOM, CURVE)
    for keyframe in keyframes_of(track(readings)):
        (scan,) = (r for r in readings if isinstance(r, Scan) and r.stamp_s == keyframe.stamp_s)
        assert np.array_equal(keyframe.points_in_body, scan.points_in_body.astype(np.float32))
        assert keyframe.failure is None


def settled() -> tuple[Odometry, float]:
    """Return an odometry that has stood in the room for three scans, and its time."""
    odometry = Odometry(load_config())
    for reading in drive(ROOM, [START] * 3, odometry=[identity()] * 3):
        odometry.process(reading)
    return odometry, 100.2


def test_scan_with_too_few_points_is_predicted() -> None:
    odometry, stamp_s = settled()
    moved = planar_pose(0.2, 0.05, 0.1)
    odometry.process(OdometryReading(stamp_s + 0.1, moved))
    tracking = odometry.process(
        Scan(stamp_s + 0.1, points_from(ROOM, START @ moved)[:19], np.zeros(3))
    )
    assert tracking is not None
    assert tracking.failure is TrackingFailure.TOO_FEW_POINTS
    assert tracking.keyframe_from_body.mean == pytest.approx(moved, abs=0.01)


def test_scan_without_any_point_makes_no_keyframe() -> None:
    odometry, stamp_s = settled()
    moved = planar_pose(2.0, 0.0, 0.0)
    odometry.process(OdometryReading(stamp_s + 0.1, moved))
    tracking = odometry.process(Scan(stamp_s + 0.1, np.zeros((0, 3)), np.zeros(3)))
    assert tracking is not None
    assert tracking.failure is TrackingFailure.TOO_FEW_POINTS
    assert tracking.keyframe is None
    assert tracking.keyframe_index == 0
    assert tracking.keyframe_from_body.mean == pytest.approx(moved, abs=0.01)


def test_odometry_that_jumps_is_not_believed() -> None:
    odometry, stamp_s = settled()
    jumped = planar_pose(4e6, -50.0, 2.0)
    for step in range(1, 4):
        wheels = jumped @ planar_pose(0.1 * step, 0.0, 0.0)
        odometry.process(OdometryReading(stamp_s + 0.1 * step, wheels))
        seen_from = START @ planar_pose(0.1 * (step - 1), 0.0, 0.0)
        points = points_from(ROOM, seen_from)
        tracking = odometry.process(Scan(stamp_s + 0.1 * step, points, np.zeros(3)))
        assert tracking is not None
        assert tracking.failure is None
        last = tracking.keyframe_from_body.mean
    # The jump itself says nothing; what the wheels say after it counts again.
    assert last == pytest.approx(planar_pose(0.2, 0.0, 0.0), abs=0.02)


def test_robot_that_sees_another_place_is_lost_and_starts_anew() -> None:
    odometry, stamp_s = settled()
    elsewhere = box(-0.6, -0.5, 0.9, 0.7)
    patience = load_config().odometry.max_failures
    trackings = []
    for step in range(1, patience + 2):
        points = points_from(elsewhere, identity())
        tracking = odometry.process(Scan(stamp_s + 0.1 * step, points, np.zeros(3)))
        assert tracking is not None
        trackings.append(tracking)
    reasons = [tracking.failure for tracking in trackings]
    assert reasons == [TrackingFailure.TOO_FEW_CORRESPONDENCES] * patience + [None]
    # One bad scan does not cost the map; the last of them starts another.
    assert [tracking.keyframe is not None for tracking in trackings] == [
        step == patience for step in range(1, patience + 2)
    ]
    lost = trackings[patience - 1].keyframe
    assert lost is not None
    assert lost.failure is TrackingFailure.TOO_FEW_CORRESPONDENCES
    # Without odometry, nothing but the robot's speed says where it is now.
    sigma_m = float(np.sqrt(lost.previous_from_body.covariance[3, 3]))
    assert sigma_m == pytest.approx(0.1 * patience * load_config().motion.max_speed_m_s, rel=0.01)


def test_pause_of_the_scans_is_bridged_by_constant_velocity() -> None:
    # A metre per second; 0.3 s without a scan is three times the motion between two of them.
    stamps = [0.1 * i for i in (*range(8), 11, 12)]
    odometry = Odometry(load_config())
    travelled = identity()
    for stamp_s in stamps:
        points = points_from(ROOM, START @ planar_pose(stamp_s, 0.0, 0.0))
        tracking = odometry.process(Scan(100.0 + stamp_s, points, np.zeros(3)))
        assert tracking is not None
        if tracking.keyframe is not None:
            travelled = travelled @ tracking.keyframe.previous_from_body.mean
    assert tracking is not None
    last = travelled @ tracking.keyframe_from_body.mean
    assert last[0, 3] == pytest.approx(1.2, abs=0.05)


def test_too_large_a_correction_is_refused() -> None:
    config = load_config(text="odometry: {max_correction_m: 0.03}")
    wheels = [identity(), planar_pose(0.08, 0.0, 0.0)]
    readings = drive(ROOM, [START, START], odometry=wheels)
    assert track(readings, config)[1].failure is TrackingFailure.CORRECTION_TOO_LARGE
    assert track(readings, config)[1].keyframe_from_body.mean == pytest.approx(wheels[1])
    accepted = track(readings)[1]
    assert accepted.failure is None
    assert accepted.keyframe_from_body.mean == pytest.approx(identity(), abs=0.02)


@pytest.mark.parametrize(("gap_s", "is_lost"), [(4.9, False), (5.1, True)])
def test_gap_in_time_without_wheels_is_lost(gap_s: float, is_lost: bool) -> None:
    tracking = track(drive(ROOM, [START, START], period_s=gap_s))[1]
    assert (tracking.failure is TrackingFailure.GAP_IN_TIME) == is_lost


def test_gap_in_time_with_wheels_is_bridged() -> None:
    moved = planar_pose(1.0, 0.3, 0.4)
    readings = drive(ROOM, [START, START @ moved], odometry=[identity(), moved], period_s=60.0)
    tracking = track(readings)[1]
    assert tracking.failure is None
    assert poses_of(track(readings))[1] == pytest.approx(moved, abs=0.02)


@pytest.mark.parametrize("is_first_with_odometry", [False, True])
def test_wheels_that_say_nothing_new_do_not_bridge_a_gap(is_first_with_odometry: bool) -> None:
    readings = drive(ROOM, [START] * 2, odometry=[identity()] * 2, period_s=6.0)
    del readings[2 if is_first_with_odometry else 0]
    assert track(readings)[1].failure is TrackingFailure.GAP_IN_TIME


@pytest.mark.parametrize("every", [2, 10, 20])
def test_wheels_slower_than_the_laser_are_not_counted_twice(every: int) -> None:
    path = line(planar_pose(-2.0, -0.3, 0.0), length_m=4.0, step_m=0.05)
    readings = drive(ROOM, path, odometry=[inverse(path[0]) @ pose for pose in path])
    slow = [r for i, r in enumerate(readings) if isinstance(r, Scan) or i // 2 % every == 0]
    trackings = track(slow)
    assert [t.failure for t in trackings] == [None] * len(path)
    assert largest_error(trackings, path)[1] < 0.03


def test_slipping_wheels_do_not_pull_the_pose() -> None:
    slipped = [identity(), planar_pose(0.15, 0.0, 0.0)]
    tracking = track(drive(ROOM, [START, START], odometry=slipped))[1]
    assert tracking.failure is None
    assert tracking.keyframe_from_body.mean[:2, 3] == pytest.approx([0.0, 0.0], abs=0.02)


def test_wheels_that_contradict_the_scan_are_trusted_less_where_it_is_blind() -> None:
    turned = [identity(), planar_pose(0.0, 0.0, 0.15)]
    tracking = track(drive(CORRIDOR, [identity()] * 2, odometry=turned))[1]
    assert tracking.failure is None
    assert log(tracking.keyframe_from_body.mean)[2] == pytest.approx(0.0, abs=0.01)
    # 0.15 rad at a standard deviation of 0.025 rad is 36; the gate is 16.27.
    sigma_m = np.sqrt(tracking.keyframe_from_body.covariance[3, 3])
    assert sigma_m == pytest.approx(0.02 * np.sqrt(36.0 / 16.27), rel=0.1)


def test_readings_of_wheels_alone_give_nothing() -> None:
    odometry = Odometry(load_config())
    assert odometry.process(OdometryReading(1.0, identity())) is None


def test_same_readings_give_the_same_bytes() -> None:
    def run() -> list[tuple[bytes, bytes]]:
        readings = drive(ROOM, CURVE, noise=np.random.default_rng(3))
        return [
            (t.keyframe_from_body.mean.tobytes(), t.keyframe_from_body.covariance.tobytes())
            for t in track(readings)
        ]

    assert run() == run()
