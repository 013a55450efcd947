"""Registration against rooms and corridors, with closed forms as judges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmt_service.core.geometry import (
    FloatArray,
    Pose,
    exp,
    identity,
    inverse,
    log,
    planar_pose,
    transform_points,
)
from hmt_service.core.local_map import deskew
from hmt_service.core.registration import RegistrationMap, covariance_of, voxel_downsample
from tests.core.factories import CORRIDOR, ROOM, SQUARE, box, cloud_of, points_from

OFF_PLANE = [0, 1, 5]


def map_of(points: FloatArray, *, is_planar: bool = True) -> RegistrationMap:
    return RegistrationMap(points, voxel_m=0.1, points_per_voxel=20, is_planar=is_planar)


def registered(
    target: RegistrationMap, points: FloatArray, guess: Pose, *, reach_m: float = 1.0
) -> Pose:
    pose = target.register(points, guess, max_correspondence_m=reach_m, kernel_m=0.3)
    assert pose is not None
    return pose


ROOM_MAP = map_of(cloud_of(ROOM))


@given(
    x=st.floats(-0.1, 0.1),
    y=st.floats(-0.1, 0.1),
    yaw=st.floats(-0.05, 0.05),
    start=st.sampled_from([(0.0, 0.0, 0.0), (-1.0, 0.5, 1.2), (1.0, -0.5, -2.5)]),
)
@settings(max_examples=30, deadline=None)
def test_known_pose_in_a_room_is_recovered(
    x: float, y: float, yaw: float, start: tuple[float, float, float]
) -> None:
    truth = planar_pose(*start)
    pose = registered(ROOM_MAP, points_from(ROOM, truth), truth @ planar_pose(x, y, yaw))
    error = log(inverse(truth) @ pose)
    assert np.abs(error[3:]).max() < 0.02
    assert np.abs(error[:3]).max() < 0.01


def test_pose_in_space_is_recovered() -> None:
    rng = np.random.default_rng(4)
    sides = rng.uniform(-2.0, 2.0, (6, 1500, 3)) * [2.0, 1.5, 1.0]
    for axis in range(3):
        sides[2 * axis, :, axis] = -2.0 * [2.0, 1.5, 1.0][axis]
        sides[2 * axis + 1, :, axis] = 2.0 * [2.0, 1.5, 1.0][axis]
    cloud = sides.reshape(-1, 3)
    truth = exp(np.array([0.05, -0.04, 0.06, 0.1, -0.08, 0.07]))
    points = transform_points(inverse(truth), cloud)
    pose = registered(map_of(cloud, is_planar=False), points, identity())
    assert pose == pytest.approx(truth, abs=0.01)


@given(yaw=st.floats(-3.0, 3.0), x=st.floats(-0.2, 0.2))
@settings(max_examples=20, deadline=None)
def test_planar_registration_stays_planar_exactly(yaw: float, x: float) -> None:
    points = points_from(ROOM, planar_pose(0.2, 0.1, yaw))
    points[:, 2] = 0.02  # a laser that is mounted higher than the map was made
    pose = registered(ROOM_MAP, points, planar_pose(x, 0.0, yaw))
    assert pose[2].tolist() == [0.0, 0.0, 1.0, 0.0]
    assert pose[:, 2].tolist() == [0.0, 0.0, 1.0, 0.0]


def test_information_of_a_corridor_is_zero_along_it() -> None:
    points = points_from(CORRIDOR, identity())
    match = map_of(cloud_of(CORRIDOR)).match(points, identity(), inlier_m=0.3)
    x, y, yaw = 3, 4, 2
    assert match.information[x] == pytest.approx(0.0, abs=1e-6)
    # Two walls across: every return counts once.
    assert match.information[y, y] == pytest.approx(len(points), rel=1e-6)
    # Turning moves a return along the normal by its distance along the wall.
    assert match.information[yaw, yaw] == pytest.approx(float(np.sum(points[:, 0] ** 2)), rel=1e-3)


def test_information_of_a_turned_corridor_is_zero_along_it_in_the_body() -> None:
    turned = planar_pose(0.0, 0.0, 0.7)
    points = points_from(CORRIDOR, turned)
    match = map_of(cloud_of(CORRIDOR)).match(points, turned, inlier_m=0.3)
    along_in_body = turned[:3, :3].T @ [1.0, 0.0, 0.0]
    assert match.information[3:, 3:] @ along_in_body == pytest.approx(np.zeros(3), abs=1e-6)
    assert np.trace(match.information[3:, 3:]) == pytest.approx(len(points), rel=1e-3)


def test_information_of_a_square_opposes_each_axis_with_the_walls_across_it() -> None:
    points = points_from(SQUARE, identity())
    match = map_of(cloud_of(SQUARE)).match(points, identity(), inlier_m=0.3)
    assert match.information[3, 3] == pytest.approx(len(points) / 2, rel=0.05)
    assert match.information[4, 4] == pytest.approx(len(points) / 2, rel=0.05)
    assert match.information[3, 4] == pytest.approx(0.0, abs=0.03 * len(points))


@pytest.mark.parametrize(("depth_m", "is_seen"), [(0.8, False), (1.9, True)])
def test_a_pillar_does_not_make_a_corridor_look_well_known(depth_m: float, is_seen: bool) -> None:
    # Its face is 3 % of the returns, less than what counts; across the corridor it is far more.
    walls = np.concatenate([CORRIDOR, box(4.0, 1.0 - depth_m, 4.6, 1.2)])
    points = points_from(walls, identity())
    on_face = np.mean(np.abs(points[:, 0] - 4.0) < 1e-6)
    assert (on_face > 0.05) == is_seen
    match = map_of(cloud_of(walls)).match(points, identity(), inlier_m=0.3)
    assert (match.information[3, 3] > 1.0) == is_seen
    assert match.information[4, 4] > 0.7 * len(points)


def test_information_is_that_of_the_distances_to_the_walls() -> None:
    # The judge: numerical derivatives of every point's distance to the wall that it lies on.
    truth = planar_pose(1.0, -1.5, 0.4)
    points = points_from(SQUARE, truth)

    def distances(xi: FloatArray) -> FloatArray:
        moved = transform_points(truth @ exp(xi), points)
        on_wall = transform_points(truth, points)
        is_across_x = np.abs(np.abs(on_wall[:, 0]) - 4.0) < 1e-6
        return np.asarray(np.where(is_across_x, moved[:, 0], moved[:, 1]))

    step = 1e-6
    jacobian = np.stack(
        [(distances(step * axis) - distances(-step * axis)) / (2.0 * step) for axis in np.eye(6)],
        axis=1,
    )
    found = map_of(cloud_of(SQUARE)).match(points, truth, inlier_m=0.3).information
    plane = np.ix_([2, 3, 4], [2, 3, 4])
    expected = jacobian.T @ jacobian
    scale = np.sqrt(np.diag(expected)[[2, 3, 4]])
    difference = np.abs(found - expected)[plane] / np.outer(scale, scale)
    assert difference.max() < 0.08  # returns from the corners have no normal


def test_inlier_share_counts_the_points_near_the_map() -> None:
    on_wall = np.array([[x, -1.0, 0.0] for x in np.linspace(-3.0, 3.0, 30)])
    off_wall = on_wall[:10] + [0.0, 0.5, 0.0]
    target = map_of(cloud_of(CORRIDOR))
    points = np.concatenate([on_wall, off_wall])
    match = target.match(points, identity(), inlier_m=0.3)
    assert match.inlier_share == pytest.approx(30 / 40)
    assert target.match(points, identity(), inlier_m=0.6).inlier_share == 1.0
    assert target.match(np.zeros((0, 3)), identity(), inlier_m=0.6).inlier_share == 0.0


def test_match_far_from_the_map_says_nothing() -> None:
    match = ROOM_MAP.match(points_from(ROOM, identity()), planar_pose(99, 0, 0), inlier_m=0.3)
    assert match.inlier_share == 0.0
    assert not match.information.any()


def test_covariance_is_wide_in_unseen_directions_only() -> None:
    covariance = covariance_of(
        np.diag([0.0, 0.0, 400.0, 0.0, 100.0, 0.0]), sigma_m=0.02, is_planar=True
    )
    sigma = np.sqrt(np.diag(covariance))
    assert sigma[3] == pytest.approx(10.0)
    assert sigma[4] == pytest.approx(0.02 / np.sqrt(100.0), rel=1e-4)
    assert sigma[2] == pytest.approx(0.02 / np.sqrt(400.0), rel=1e-4)
    assert not sigma[OFF_PLANE].any()


def test_covariance_in_space_has_all_six_axes() -> None:
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 6))
    information = root @ root.T
    covariance = covariance_of(information, sigma_m=0.1, is_planar=False)
    assert covariance == pytest.approx(np.linalg.inv(information / 0.01 + 0.01 * np.eye(6)))
    assert np.sqrt(np.diag(covariance_of(np.zeros((6, 6)), sigma_m=0.1, is_planar=False))) == (
        pytest.approx(np.full(6, 10.0))
    )


@given(seed=st.integers(0, 2**32 - 1), voxel_m=st.floats(0.1, 2.0))
def test_downsampling_keeps_one_original_point_per_voxel(seed: int, voxel_m: float) -> None:
    points = np.random.default_rng(seed).uniform(-5.0, 5.0, (200, 3))
    kept = voxel_downsample(points, voxel_m)
    assert {tuple(p) for p in kept} <= {tuple(p) for p in points}
    cells = {tuple(c) for c in np.floor(points / voxel_m)}
    found = [tuple(c) for c in np.floor(kept / voxel_m)]
    assert len(found) == len(set(found))
    assert set(found) == cells


def test_deskewed_points_are_those_of_one_instant() -> None:
    wall = np.array([[5.0, y, 0.0] for y in np.linspace(-2.0, 2.0, 9)])
    times = np.linspace(0.0, 1.0, 9)
    motion = planar_pose(0.4, 0.0, 0.1)
    # Body at share t of the sweep, expressed at the start of the sweep.
    seen = np.array(
        [
            transform_points(inverse(exp(t * log(motion))), point[None])[0]
            for t, point in zip(times, wall, strict=True)
        ]
    )
    deskewed = deskew(seen, times, motion)
    # Whatever instant is chosen, the result is the wall seen from one pose on the way.
    candidates = [
        transform_points(inverse(exp(t * log(motion))), wall) for t in np.linspace(0.0, 1.0, 11)
    ]
    errors = [float(np.abs(deskewed - candidate).max()) for candidate in candidates]
    assert min(errors) < 1e-6
    assert np.abs(seen - candidates[int(np.argmin(errors))]).max() > 0.05
