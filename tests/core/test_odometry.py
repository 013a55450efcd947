"""The metric level on known paths through worlds of straight walls."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import numpy as np
import pytest

from hmt_service.core.config import Config, Preset, load_config
from hmt_service.core.geometry import (
    PLANAR_AXES,
    FloatArray,
    Pose,
    exp,
    identity,
    inverse,
    log,
    planar_pose,
    transform_points,
)
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import (
    Keyframe,
    OdometryReading,
    Points,
    Reading,
    Scan,
    Tracking,
    TrackingFailure,
)
from hmt_service.errors import InvalidInput
from tests.core.factories import (
    BEAMS,
    CORRIDOR,
    HALL,
    PILLARS,
    ROOM,
    Walls,
    box,
    drifting,
    drive,
    line,
    points_from,
    ranges_from,
    sweep_from,
)

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
    config = load_config(text="odometry: {keyframe_distance_m: 1.0, keyframe_new_share: 1.0}")
    trackings = track(drive(CORRIDOR, path, odometry=[inverse(path[0]) @ p for p in path]), config)
    assert [i for i, t in enumerate(trackings) if t.keyframe is not None] == [0, 10, 20]
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
    assert np.sqrt(known[3, 3]) == pytest.approx(np.sqrt(10.0) * 0.02, rel=0.01)
    # Steps of 0.1 s: at first nobody knows the speed, then nobody says whether it has changed.
    motion = load_config().motion
    first_m, next_m = motion.max_speed_m_s * 0.1, 0.02 + motion.acceleration_m_s2 * 0.1**2
    assert guessed[3, 3] == pytest.approx(first_m**2 + 9.0 * next_m**2, rel=0.02)


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
    # None comes by new space unless all of a scan is new.
    config = load_config(text="odometry: {keyframe_new_share: 1.0}")
    trackings = track(drive(ROOM, path, odometry=path), config)
    found = keyframes_of(trackings)
    assert [k.index for k in found] == list(range(keyframes))
    assert [i for i, t in enumerate(trackings) if t.keyframe is not None] == [0, 10, 20]
    assert all(t.keyframe_index == i // 10 for i, t in enumerate(trackings))
    for keyframe in found[1:]:
        assert keyframe.previous_from_body.mean == pytest.approx(
            np.linalg.matrix_power(step, 10), abs=0.02
        )


@pytest.mark.parametrize(
    "step",
    [planar_pose(0.051, 0.0, 0.0), planar_pose(0.0, 0.0, 0.037)],
    ids=["moving", "turning"],
)
def test_second_keyframe_comes_after_a_fifth_of_the_motion(step: Pose) -> None:
    # One scan is too sparse for surfaces at a distance: four points in 0.3 m need 4 m or less.
    path = [START @ np.linalg.matrix_power(step, i) for i in range(25)]
    trackings = track(drive(ROOM, path, odometry=path))
    known = [0.0 if t.registration is None else t.registration.known_share for t in trackings]
    assert max(known[1:3]) < 0.7 < min(known[3:])
    # 2 steps of 0.051 m (0.037 rad) are a fifth of 0.5 m (0.35 rad); ten more are all of it.
    assert [i for i, t in enumerate(trackings) if t.keyframe is not None] == [0, 2, 12, 22]


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
    trackings = []
    for step in range(1, 4):
        wheels = jumped @ planar_pose(0.1 * step, 0.0, 0.0)
        odometry.process(OdometryReading(stamp_s + 0.1 * step, wheels))
        seen_from = START @ planar_pose(0.1 * (step - 1), 0.0, 0.0)
        points = points_from(ROOM, seen_from)
        tracking = odometry.process(Scan(stamp_s + 0.1 * step, points, np.zeros(3)))
        assert tracking is not None
        assert tracking.failure is None
        trackings.append(tracking)
    # The jump itself says nothing; what the wheels say after it counts again. The room is so new
    # that some of these scans are keyframes: the first of all is where the robot had settled.
    motions = [k.previous_from_body.mean for k in keyframes_of(trackings)]
    last = reduce(np.matmul, motions, identity()) @ trackings[-1].keyframe_from_body.mean
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
    assert tracking.registration is not None
    # 0.15 rad at a standard deviation of 0.01 + 0.1 * 0.15 = 0.025 rad is 36; 95 % of honest
    # predictions along three axes are below 7.81.
    assert tracking.registration.prior_weight == pytest.approx(7.81 / 36.0, rel=0.02)
    sigma_m = np.sqrt(tracking.keyframe_from_body.covariance[3, 3])
    assert sigma_m == pytest.approx(0.02 * np.sqrt(36.0 / 7.81), rel=0.1)


def test_two_scans_of_one_moment_say_nothing_of_the_speed() -> None:
    readings = drive(ROOM, CURVE[:30])
    doubled = [again for reading in readings for again in (reading, reading)]
    trackings, alone = track(doubled), track(readings)
    assert not [tracking.failure for tracking in trackings if tracking.failure is not None]
    assert poses_of(trackings)[-1] == pytest.approx(poses_of(alone)[-1], abs=0.01)


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


# ------------------------------------------------------------------ what is refused


def test_scan_that_comes_to_no_rest_is_predicted(monkeypatch: pytest.MonkeyPatch) -> None:
    odometry, stamp_s = settled()
    # Both are far enough for a keyframe; the wheels say 0.1 m too much.
    truth, wheels = planar_pose(0.5, 0.0, 0.0), planar_pose(0.6, 0.0, 0.0)
    scan = Scan(stamp_s + 0.1, points_from(ROOM, START @ truth), np.zeros(3))
    odometry.process(OdometryReading(scan.stamp_s, wheels))
    with monkeypatch.context() as patched:
        patched.setattr("hmt_service.core.local_map._MAX_ITERATIONS", 1)
        tracking = odometry.process(scan)
    assert tracking is not None
    assert tracking.failure is TrackingFailure.NOT_CONVERGED
    assert tracking.registration is not None
    assert tracking.keyframe is None
    assert tracking.keyframe_from_body.mean == pytest.approx(wheels, abs=1e-3)
    # What was said stays uncertain: 0.02 m and a tenth of the way.
    sigma_m = np.sqrt(tracking.keyframe_from_body.covariance[3, 3])
    assert sigma_m == pytest.approx(0.02 + 0.1 * 0.6, rel=0.05)
    # The next scan finds its way back to the map as it was.
    again = odometry.process(Scan(stamp_s + 0.2, scan.points_in_body, np.zeros(3)))
    assert again is not None
    assert again.failure is None


def test_scan_that_failed_is_not_added_to_the_map() -> None:
    odometry, stamp_s = settled()
    elsewhere = points_from(box(-0.6, -0.5, 0.9, 0.7), identity())
    shares = []
    for step in range(1, 4):
        odometry.process(OdometryReading(stamp_s + 0.1 * step, planar_pose(0.6, 0.0, 0.0)))
        tracking = odometry.process(Scan(stamp_s + 0.1 * step, elsewhere, np.zeros(3)))
        assert tracking is not None
        assert tracking.failure is TrackingFailure.TOO_FEW_CORRESPONDENCES
        assert tracking.keyframe is None
        assert tracking.registration is not None
        shares.append(tracking.registration.inlier_share)
    # It is as strange the third time, and the room is still known.
    assert max(shares) < 0.3
    odometry.process(OdometryReading(stamp_s + 0.4, planar_pose(0.2, 0.0, 0.0)))
    room = points_from(ROOM, START @ planar_pose(0.2, 0.0, 0.0))
    back = odometry.process(Scan(stamp_s + 0.4, room, np.zeros(3)))
    assert back is not None
    assert back.failure is None


def test_registration_says_how_a_scan_fitted() -> None:
    slipped = [identity(), planar_pose(0.15, 0.0, 0.0)]
    first, second = track(drive(ROOM, [START, START], odometry=slipped))
    assert first.registration is None
    registration = second.registration
    assert registration is not None
    assert registration.correction_m == pytest.approx(0.15, abs=0.02)
    assert 0.3 < registration.inlier_share <= registration.known_share < 1.0
    # 0.15 m at a standard deviation of 0.02 + 0.1 * 0.15 = 0.035 m is 18.4.
    assert registration.prior_weight == pytest.approx(7.81 / 18.4, rel=0.05)
    assert registration.degenerate.shape == (0, 6)


# ------------------------------------------------------------------ new space


FINE_BEARINGS = np.linspace(-np.pi, np.pi, 1080, endpoint=False)


def fine_scan(
    walls: Walls, pose: Pose, stamp_s: float, noise: np.random.Generator | None = None
) -> Scan:
    """Return what a laser of 0.33 degrees sees: dense enough to know a wall at 8 m at once."""
    ranges = ranges_from(walls, pose, FINE_BEARINGS)
    if noise is not None:
        ranges = ranges + noise.normal(0.0, 0.01, len(ranges))
    rays = np.stack([np.cos(FINE_BEARINGS), np.sin(FINE_BEARINGS), 0.0 * FINE_BEARINGS], axis=1)
    is_return = ranges < 30.0
    return Scan(stamp_s, ranges[is_return, None] * rays[is_return], np.zeros(3))


def fine_drive(
    walls: Walls, path: Sequence[Pose], noise: np.random.Generator | None = None
) -> list[Reading]:
    return [fine_scan(walls, pose, 100.0 + 0.1 * i, noise) for i, pose in enumerate(path)]


THIN_M = 0.14
TWO_ROOMS = np.concatenate(
    [
        # The wall between them is open from y = -0.5 m to 0.5 m.
        [[-4.0, -3.0, 0.0, -3.0], [-4.0, 3.0, 0.0, 3.0], [-4.0, -3.0, -4.0, 3.0]],
        box(0.0, -3.0, THIN_M, -0.5),
        box(0.0, 0.5, THIN_M, 3.0),
        [[THIN_M, -3.0, 5.0, -3.0], [THIN_M, 3.0, 5.0, 3.0], [5.0, -3.0, 5.0, 3.0]],
        box(-3.0, 1.6, -2.2, 2.2),
        box(2.0, -2.4, 2.9, -1.7),
        box(3.0, 1.2, 3.4, 2.1),
    ]
)
"""Two rooms with a door in the thin wall between them."""
THROUGH_THE_DOOR = line(planar_pose(-2.5, 0.0, 0.0), length_m=5.0, step_m=0.05)


def test_keyframe_comes_early_where_a_door_shows_another_room() -> None:
    config = load_config(text="odometry: {keyframe_distance_m: 1.5}")
    trackings = track(fine_drive(TWO_ROOMS, THROUGH_THE_DOOR), config)
    assert {t.failure for t in trackings} == {None}
    at_m = np.array(
        [
            pose[0, 3]
            for pose, t in zip(THROUGH_THE_DOOR, trackings, strict=True)
            if t.keyframe is not None
        ]
    )
    gaps_m = np.diff(at_m)
    is_in_door = (at_m[1:] > -0.5) & (at_m[1:] < 0.6)
    # A fifth of 1.5 m at least, and clearly less than all of it.
    assert gaps_m.min() > 0.3 - 0.01
    assert gaps_m[is_in_door].min() < 0.8 * 1.5
    # Each of those was made by what it saw.
    for gap_m, tracking in zip(
        gaps_m, [t for t in trackings if t.keyframe is not None][1:], strict=True
    ):
        assert tracking.registration is not None
        is_new = tracking.registration.known_share <= 0.7
        assert is_new or gap_m > 1.45


def test_keyframes_come_by_motion_alone_when_new_space_does_not_count() -> None:
    text = "odometry: {keyframe_distance_m: 1.5, keyframe_new_share: 1.0}"
    trackings = track(fine_drive(TWO_ROOMS, THROUGH_THE_DOOR), load_config(text=text))
    kept = [i for i, t in enumerate(trackings) if t.keyframe is not None]
    # 1.5 m are 30 steps of 0.05 m; one more where rounding takes the thirtieth away.
    assert set(np.diff(kept)) <= {30, 31}


@pytest.mark.parametrize("change", ["door", "person"])
def test_robot_that_stands_still_keeps_nothing_whatever_comes_into_view(change: str) -> None:
    # A door of 1 m at 0.25 m is 127 degrees wide, a person of 1 m at 0.2 m 136: 35 % and 38 %.
    pose = planar_pose(-0.25 if change == "door" else -1.0, 0.0, 0.0)
    closed = np.concatenate([TWO_ROOMS, [[0.0, -0.5, 0.0, 0.5]]])
    before, after = {
        "door": (closed, TWO_ROOMS),
        "person": (TWO_ROOMS, np.concatenate([TWO_ROOMS, box(-0.8, -0.5, -0.4, 0.5)])),
    }[change]
    noise = np.random.default_rng(5)
    readings = [
        fine_scan(before if i < 10 else after, pose, 100.0 + 0.1 * i, noise) for i in range(40)
    ]
    trackings = track(readings)
    assert [i for i, t in enumerate(trackings) if t.keyframe is not None] == [0]
    assert {t.failure for t in trackings} == {None}
    assert largest_error(trackings, [pose] * 40)[1] < 0.01
    shares = [t.registration.known_share for t in trackings if t.registration is not None]
    # It did see the change, and had it moved, this would have been new space enough.
    assert max(shares[9:]) <= 0.7 < min(shares[:9])


@pytest.mark.parametrize("voxel_size_m", [0.1, 0.25])
def test_robot_that_drives_through_a_door_does_not_slip_by_the_wall(voxel_size_m: float) -> None:
    # The wall is thinner than a surface of either size is wide.
    config = load_config(text=f"odometry: {{voxel_size_m: {voxel_size_m}}}")
    noise = np.random.default_rng(6)
    there_and_back = [
        *THROUGH_THE_DOOR,
        *(THROUGH_THE_DOOR[-1] @ planar_pose(0.0, 0.0, 0.2 * i) for i in range(1, 16)),
        *(pose @ planar_pose(0.0, 0.0, 3.0) for pose in THROUGH_THE_DOOR[::-1]),
    ]
    trackings = track(fine_drive(TWO_ROOMS, there_and_back, noise), config)
    assert {t.failure for t in trackings} == {None}
    heading_rad, position_m = largest_error(trackings, there_and_back)
    assert heading_rad < 0.01
    assert position_m < 0.2 * THIN_M


# ------------------------------------------------------------------ sweeps


def sweeps_along(path: Sequence[Pose], *, noise: np.random.Generator | None = None) -> list[Scan]:
    """Return a sweep that ends at every pose, taken on the way from the one before."""
    scans = []
    for index, pose in enumerate(path):
        before = path[max(index - 1, 0)]
        points, times = sweep_from(before, log(inverse(before) @ pose), noise=noise)
        scans.append(Scan(100.0 + 0.1 * index, points, np.zeros(3), point_times=times))
    return scans


def spatial_path(count: int, step: FloatArray) -> list[Pose]:
    start = exp(np.array([0.0, 0.0, 0.2, -2.0, -1.0, 0.0]))
    return [start @ exp(i * step) for i in range(count)]


UNIFORM = np.array([0.002, -0.003, 0.02, 0.1, 0.0, 0.005])


def test_lidar_alone_is_tracked_through_a_hall() -> None:
    path = spatial_path(40, UNIFORM)
    trackings = track(
        sweeps_along(path, noise=np.random.default_rng(7)), load_config(Preset.INDOOR)
    )
    assert {t.failure for t in trackings} == {None}
    errors = np.array(
        [
            log(inverse(inverse(path[0]) @ truth) @ pose)
            for truth, pose in zip(path, poses_of(trackings), strict=True)
        ]
    )
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.02
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.005


def test_lost_scan_does_not_double_the_motion_during_the_next() -> None:
    path = spatial_path(14, UNIFORM)
    scans = sweeps_along(path)
    del scans[10]
    # Every scan is a keyframe, so that what is kept of each can be looked at.
    config = load_config(Preset.INDOOR, "odometry: {keyframe_distance_m: 0.02}")
    trackings = track(scans, config)
    del path[10]
    errors = []
    for tracking, pose in zip(trackings, path, strict=True):
        assert tracking.failure is None
        assert tracking.keyframe is not None
        if tracking.keyframe.index > 1:
            errors.append(off_surfaces_m(tracking.keyframe.points_in_body, pose))
    # Twice 0.1 m during the sweep would put its first points 0.1 m off their walls.
    assert max(errors) < 0.03
    # The motion during the sweep has not changed, nor what it makes uncertain.
    told = [t.keyframe.previous_from_body.covariance for t in trackings[3:] if t.keyframe]
    sigmas = np.sqrt([np.trace(c[3:, 3:]) for c in told])
    assert sigmas.max() < 1.5 * np.median(sigmas)


def test_points_after_a_lost_scan_are_moved_by_one_sweep_only() -> None:
    path = spatial_path(8, UNIFORM)
    scans = sweeps_along(path)
    del scans[6]
    # Two periods of 0.1 s are a gap: the scan after it is kept as it was expected to be.
    config = load_config(Preset.INDOOR, "odometry: {max_gap_s: 0.15}")
    last = track(scans, config)[-1]
    assert last.failure is TrackingFailure.GAP_IN_TIME
    assert last.keyframe is not None
    # Twice 0.1 m during the sweep would put its first points 0.1 m off their walls.
    assert off_surfaces_m(last.keyframe.points_in_body, path[-1]) < 0.03


def off_surfaces_m(points_in_body: Points, world_from_body: Pose) -> float:
    """Return how far all but the worst hundredth of some points are off the walls of the hall."""
    points = transform_points(world_from_body, points_in_body)
    gaps = [np.abs(points - HALL[:3]).min(axis=1), np.abs(points - HALL[3:]).min(axis=1)]
    for pillar in PILLARS:
        outside = np.maximum(pillar[:3] - points, points - pillar[3:]).max(axis=1)
        gaps.append(np.abs(outside))
    return float(np.quantile(np.min(gaps, axis=0), 0.99))


@pytest.mark.parametrize("share", [0.125, 0.5])
def test_covariance_holds_the_error_of_both_keyframes(share: float) -> None:
    # Ever faster: 0.04 m more per sweep each time.
    start = planar_pose(-3.5, -0.5, 0.1)
    path = [start @ planar_pose(0.02 * i * i, 0.0, 0.0) for i in range(10)]
    text = "{{odometry: {{keyframe_distance_m: 0.02}}, covariance: {{uneven_motion_share: {}}}}}"
    uneven, even = (
        track(sweeps_along(path), load_config(Preset.INDOOR, text.format(value)))
        for value in (share, 0.0)
    )
    for tracking, other in list(zip(uneven, even, strict=True))[4:]:
        assert tracking.keyframe is not None
        assert other.keyframe is not None
        added = (
            tracking.keyframe.previous_from_body.covariance
            - other.keyframe.previous_from_body.covariance
        )
        # Of 0.04 m that share; once for this sweep, once for that of the keyframe before.
        assert added[3, 3] == pytest.approx(2.0 * (share * 0.04) ** 2, rel=0.15)


# ------------------------------------------------------------------ honesty


@pytest.mark.parametrize("world", ["room", "corridor"])
def test_covariance_is_as_large_as_the_errors(world: str) -> None:
    walls = {"room": ROOM, "corridor": CORRIDOR}[world]
    rng = np.random.default_rng(8)
    config = load_config()
    noise = config.motion

    def noisy_scan(pose: Pose, stamp_s: float) -> Scan:
        # `covariance.sigma_m` is for ranges good to 0.02 m.
        error_m = rng.normal(0.0, 0.02, BEAMS)
        return Scan(stamp_s, points_from(walls, pose, noise_m=error_m), np.zeros(3))

    squares, refused = [], 0
    for _ in range(200):
        first = planar_pose(*rng.uniform([-1.0, -0.5, -3.0], [1.0, 0.5, 3.0]))
        truth = planar_pose(*rng.uniform([-0.15, -0.15, -0.2], [0.15, 0.15, 0.2]))
        turned, travelled = np.linalg.norm(log(truth)[:3]), np.linalg.norm(log(truth)[3:])
        sigma_rad = (
            noise.sigma_floor_rad
            + noise.sigma_rotation_share * turned
            + noise.sigma_rotation_rad_per_m * travelled
        )
        sigma_m = noise.sigma_floor_m + noise.sigma_translation_share * travelled
        error = rng.normal(0.0, 1.0, 3) * [sigma_m, sigma_m, sigma_rad]
        readings: list[Reading] = [OdometryReading(100.0, identity()), noisy_scan(first, 100.0)]
        readings += [
            OdometryReading(100.1, truth @ planar_pose(*error)),
            noisy_scan(first @ truth, 100.1),
        ]
        trackings = track(readings, config)
        if trackings[1].failure is not None:
            refused += 1
            continue
        squares.append(planar_square(poses_of(trackings)[1], truth, trackings[1]))
    # A refusal is an honest answer, but a rare one.
    assert refused <= 2
    # Over three axes, squared errors in standard deviations have a mean of three.
    assert 0.6 < np.mean(squares) / 3.0 < 1.4


def planar_square(pose: Pose, truth: Pose, tracking: Tracking) -> float:
    """Return the squared error of a pose in standard deviations along x, y and about z."""
    told = tracking.keyframe_from_body
    if tracking.keyframe is not None:
        told = tracking.keyframe.previous_from_body
    error = log(inverse(pose) @ truth)[PLANAR_AXES]
    block = told.covariance[np.ix_(PLANAR_AXES, PLANAR_AXES)]
    return float(error @ np.linalg.solve(block, error))


@pytest.mark.parametrize(
    ("points", "times"),
    [(np.zeros((50, 2)), None), (np.zeros(150), None), (np.zeros((50, 3)), np.zeros(49))],
)
def test_scan_of_a_wrong_shape_is_refused(points: FloatArray, times: FloatArray | None) -> None:
    with pytest.raises(InvalidInput, match="shape"):
        Odometry(load_config()).process(Scan(0.0, points, np.zeros(3), times))


@pytest.mark.parametrize("seed", range(3))
def test_walls_that_end_where_the_laser_does_hold_nobody_back(seed: int) -> None:
    # Of a blank corridor it always sees the same, and the ends of that come along.
    path = line(identity(), length_m=12.0, step_m=0.1)
    trackings = track(in_blank_corridor(path, seed))
    motions = [t.keyframe.previous_from_body for t in trackings if t.keyframe is not None]
    end = reduce(lambda one, other: one @ other, motions) @ trackings[-1].keyframe_from_body
    error_m = abs(end.mean[0, 3] - 12.0)
    assert error_m < 1.0
    assert error_m < 3.0 * end.sigma_m


def test_who_stands_in_a_blank_corridor_is_told_the_same_again() -> None:
    driven = line(identity(), length_m=12.45, step_m=0.1)
    readings = in_blank_corridor([*driven, *[driven[-1]] * 200], 0)
    trackings = track(readings)
    arrived, stood = trackings[len(driven) - 1], trackings[-1]
    assert stood.keyframe_index == arrived.keyframe_index, "nothing new was seen"
    # The wheels may have crept meanwhile: 0.02 m a scan, which adds up as noise does.
    assert (
        stood.keyframe_from_body.sigma_m
        < arrived.keyframe_from_body.sigma_m + 1.5 * 0.02 * np.sqrt(200)
    )


def in_blank_corridor(path: Sequence[Pose], seed: int) -> list[Reading]:
    """Drive along a corridor whose ends the laser does not see, wheels and scans at 5 Hz."""
    readings: list[Reading] = []
    rng = np.random.default_rng(seed)
    for index, pose in enumerate(path):
        points = points_from(CORRIDOR, pose, noise_m=rng.normal(0.0, 0.03, BEAMS))
        seen = points[np.linalg.norm(points, axis=1) < 8.0]
        readings += [OdometryReading(0.2 * index, pose), Scan(0.2 * index, seen, np.zeros(3))]
    return readings
