"""Laws of SE(3) and of Gaussians over it, with scipy, closed forms and sampling as judges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from hmt_service.core.geometry import (
    PLANAR_AXES,
    FloatArray,
    GaussianPose,
    Pose,
    adjoint,
    certain,
    exp,
    identity,
    inverse,
    log,
    planar_covariance,
    planar_pose,
    pose_of,
    project_planar,
    quaternion_of,
    symmetric,
    transform_points,
    yaw_of,
)
from hmt_service.errors import InvalidInput


def directions() -> st.SearchStrategy[FloatArray]:
    return (
        st.tuples(*[st.floats(-1.0, 1.0, allow_subnormal=False)] * 3)
        .map(lambda v: np.round(v, 9))  # scipy's logarithm, the judge, overflows on 1e-303
        .filter(lambda v: np.linalg.norm(v) > 1e-3)
        .map(lambda v: v / np.linalg.norm(v))
    )


@st.composite
def tangents(draw: st.DrawFn, *, max_angle_rad: float = 3.1) -> FloatArray:
    """Draw tangent vectors of all sizes of rotation: zero, tiny, ordinary and nearly pi."""
    angle_rad = draw(
        st.one_of(
            st.sampled_from([0.0, 1e-12, 1e-9, 1e-8, 2e-7, 1e-6, 1e-4, 1e-2, max_angle_rad]),
            st.floats(0.0, max_angle_rad),
        )
    )
    translation_m = draw(st.tuples(*[st.floats(-20.0, 20.0, allow_subnormal=False)] * 3))
    return np.concatenate([angle_rad * draw(directions()), translation_m])


def poses() -> st.SearchStrategy[Pose]:
    return tangents().map(exp)


@st.composite
def covariances(draw: st.DrawFn, *, scale: float = 0.1) -> FloatArray:
    """Draw well-conditioned full covariances."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    root = rng.normal(0.0, scale, (6, 6))
    return np.asarray(root @ root.T + 0.1 * scale**2 * np.eye(6))


def wedge(xi: FloatArray) -> FloatArray:
    """Return the 4x4 matrix whose matrix exponential is the transform of `xi`."""
    (a, b, c), translation_m = xi[:3], xi[3:]
    result = np.zeros((4, 4))
    result[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    result[:3, 3] = translation_m
    return result


@given(a=poses(), b=poses(), c=poses())
def test_transforms_form_a_group(a: Pose, b: Pose, c: Pose) -> None:
    assert (a @ b) @ c == pytest.approx(a @ (b @ c), abs=1e-9)
    assert a @ identity() == pytest.approx(a)
    assert a @ inverse(a) == pytest.approx(identity(), abs=1e-9)
    assert inverse(a @ b) == pytest.approx(inverse(b) @ inverse(a), abs=1e-9)
    rotation = (a @ b)[:3, :3]
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


@given(a=poses(), b=poses(), points=st.lists(st.tuples(*[st.floats(-9, 9)] * 3), max_size=4))
def test_points_follow_composition(
    a: Pose, b: Pose, points: list[tuple[float, float, float]]
) -> None:
    cloud = np.array(points).reshape(-1, 3)
    assert transform_points(a @ b, cloud) == pytest.approx(
        transform_points(a, transform_points(b, cloud)), abs=1e-9
    )


@given(xi=tangents())
def test_exp_is_the_matrix_exponential(xi: FloatArray) -> None:
    assert exp(xi) == pytest.approx(expm(wedge(xi)), abs=1e-8)


@given(xi=tangents())
def test_log_inverts_exp(xi: FloatArray) -> None:
    assert log(exp(xi)) == pytest.approx(xi, abs=1e-7)


@given(pose=poses())
def test_exp_inverts_log(pose: Pose) -> None:
    assert exp(log(pose)) == pytest.approx(pose, abs=1e-8)


@given(xi=tangents(max_angle_rad=2.5))
def test_log_is_the_matrix_logarithm(xi: FloatArray) -> None:
    assert wedge(log(exp(xi))) == pytest.approx(np.real(logm(exp(xi))), abs=1e-6)


@given(xi=tangents(), other=tangents())
def test_exp_of_a_batch_is_the_batch_of_exp(xi: FloatArray, other: FloatArray) -> None:
    batch = exp(np.array([[xi, other]]))
    assert batch.shape == (1, 2, 4, 4)
    assert batch[0] == pytest.approx(np.array([exp(xi), exp(other)]), abs=1e-12)


@given(pose=poses(), xi=tangents(max_angle_rad=1.0))
def test_adjoint_carries_a_perturbation_through(pose: Pose, xi: FloatArray) -> None:
    assert pose @ exp(xi) == pytest.approx(exp(adjoint(pose) @ xi) @ pose, abs=1e-6)


@given(a=poses(), b=poses())
def test_adjoint_of_a_product_is_the_product_of_adjoints(a: Pose, b: Pose) -> None:
    assert adjoint(a @ b) == pytest.approx(adjoint(a) @ adjoint(b), abs=1e-8)


@given(pose=poses())
def test_quaternion_agrees_with_scipy(pose: Pose) -> None:
    quaternion = quaternion_of(pose)
    judge = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)
    assert quaternion[3] >= 0.0
    assert abs(quaternion @ judge) == pytest.approx(1.0)
    assert pose_of(quaternion, pose[:3, 3]) == pytest.approx(pose, abs=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_quaternion_of_half_a_turn(axis: int) -> None:
    pose = identity()
    pose[:3, :3] = -np.eye(3)
    pose[axis, axis] = 1.0
    assert np.abs(quaternion_of(pose)) == pytest.approx(np.eye(4)[axis])
    assert exp(log(pose)) == pytest.approx(pose)


@pytest.mark.parametrize(
    ("quaternion", "translation_m"),
    [([0, 0, 0, 0], [0, 0, 0]), ([0, 0, 0, math.nan], [0, 0, 0]), ([0, 0, 0, 1], [0, math.inf, 0])],
)
def test_pose_without_direction_or_place_is_refused(
    quaternion: list[float], translation_m: list[float]
) -> None:
    with pytest.raises(InvalidInput):
        pose_of(np.array(quaternion, dtype=float), np.array(translation_m, dtype=float))


@given(x=st.floats(-9, 9), y=st.floats(-9, 9), yaw=st.floats(-3.1, 3.1))
def test_planar_pose_has_its_place_and_heading(x: float, y: float, yaw: float) -> None:
    pose = planar_pose(x, y, yaw)
    assert pose[:3, 3] == pytest.approx([x, y, 0.0])
    assert yaw_of(pose) == pytest.approx(yaw)
    assert project_planar(pose) == pytest.approx(pose)
    assert log(pose)[[0, 1, 5]] == pytest.approx(0.0)


@given(pose=poses())
def test_planar_projection_keeps_place_and_heading(pose: Pose) -> None:
    flat = project_planar(pose)
    assert flat[:2, 3] == pytest.approx(pose[:2, 3])
    assert math.cos(yaw_of(flat) - yaw_of(pose)) == pytest.approx(1.0)
    assert log(flat)[[0, 1, 5]] == pytest.approx(0.0, abs=1e-12)


@given(covariance=covariances())
def test_planar_covariance_keeps_the_plane_and_stays_invertible(covariance: FloatArray) -> None:
    flat = planar_covariance(covariance, off_plane_sigma=1e-3)
    plane = np.ix_(PLANAR_AXES, PLANAR_AXES)
    assert flat[plane] == pytest.approx(covariance[plane])
    assert np.diag(flat)[[0, 1, 5]] == pytest.approx(1e-6)
    assert np.linalg.eigvalsh(flat).min() > 0.0


def test_symmetric_is_the_mean_with_the_transpose() -> None:
    matrix = np.array([[1.0, 2.0], [4.0, 3.0]])
    assert symmetric(matrix) == pytest.approx(np.array([[1.0, 3.0], [3.0, 3.0]]))


def sample(gaussian: GaussianPose, count: int, rng: np.random.Generator) -> FloatArray:
    xi = rng.multivariate_normal(np.zeros(6), gaussian.covariance, count)
    return np.asarray(gaussian.mean @ exp(xi))


def covariance_around(mean: Pose, samples: FloatArray) -> FloatArray:
    xi = np.array([log(inverse(mean) @ pose) for pose in samples])
    return np.asarray(xi.T @ xi / len(xi))


def relative_difference(found: FloatArray, expected: FloatArray) -> float:
    """Return the largest difference, in units of the standard deviations of its row and column."""
    sigma = np.sqrt(np.diag(expected))
    return float((np.abs(found - expected) / np.outer(sigma, sigma)).max())


def some_gaussian(seed: int, *, sigma: float = 0.02) -> GaussianPose:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, sigma, (6, 6))
    return GaussianPose(exp(rng.normal(0.0, 1.0, 6)), root @ root.T)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_composed_covariance_agrees_with_sampling(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = some_gaussian(seed), some_gaussian(seed + 100)
    composed = a @ b
    assert composed.mean == pytest.approx(a.mean @ b.mean)
    samples = sample(a, 10_000, rng) @ sample(b, 10_000, rng)
    assert relative_difference(covariance_around(composed.mean, samples), composed.covariance) < (
        0.06
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_inverse_covariance_agrees_with_sampling(seed: int) -> None:
    gaussian = some_gaussian(seed)
    samples = np.asarray(np.linalg.inv(sample(gaussian, 10_000, np.random.default_rng(seed))))
    found = covariance_around(gaussian.inverse().mean, samples)
    assert relative_difference(found, gaussian.inverse().covariance) < 0.06


@given(mean=poses(), covariance=covariances())
def test_inverse_of_the_inverse_is_the_same(mean: Pose, covariance: FloatArray) -> None:
    twice = GaussianPose(mean, covariance).inverse().inverse()
    assert twice.mean == pytest.approx(mean, abs=1e-9)
    assert twice.covariance == pytest.approx(covariance, abs=1e-9)


@given(mean=poses(), covariance=covariances())
def test_composition_with_a_certain_identity_changes_nothing(
    mean: Pose, covariance: FloatArray
) -> None:
    gaussian = GaussianPose(mean, covariance)
    for same in (gaussian @ certain(identity()), certain(identity()) @ gaussian):
        assert same.mean == pytest.approx(mean)
        assert same.covariance == pytest.approx(covariance, abs=1e-12)


@given(mean=poses(), first=covariances(), second=covariances())
def test_fusing_equal_means_adds_information(
    mean: Pose, first: FloatArray, second: FloatArray
) -> None:
    fused = GaussianPose(mean, first).fuse(GaussianPose(mean, second))
    assert fused.mean == pytest.approx(mean, abs=1e-9)
    assert np.linalg.inv(fused.covariance) == pytest.approx(
        np.linalg.inv(first) + np.linalg.inv(second), rel=1e-6, abs=1e-3
    )


@given(
    first_m=st.tuples(*[st.floats(-5, 5)] * 3),
    second_m=st.tuples(*[st.floats(-5, 5)] * 3),
    sigmas_m=st.tuples(*[st.floats(0.1, 2.0)] * 2),
)
def test_fused_translations_have_the_closed_form(
    first_m: tuple[float, float, float],
    second_m: tuple[float, float, float],
    sigmas_m: tuple[float, float],
) -> None:
    # Without rotation SE(3) is flat: the product of Gaussians is the weighted mean.
    first, second = (
        GaussianPose(pose_of(np.array([0.0, 0.0, 0.0, 1.0]), np.array(t)), sigma**2 * np.eye(6))
        for t, sigma in zip((first_m, second_m), sigmas_m, strict=True)
    )
    weights = 1.0 / np.square(sigmas_m)
    expected = (weights[0] * np.array(first_m) + weights[1] * np.array(second_m)) / weights.sum()
    fused = first.fuse(second)
    assert fused.mean[:3, 3] == pytest.approx(expected, abs=1e-9)
    assert fused.covariance == pytest.approx(np.eye(6) / weights.sum())


@pytest.mark.parametrize("seed", range(5))
def test_fused_order_does_not_matter_for_near_means(seed: int) -> None:
    a = some_gaussian(seed)
    b = GaussianPose(a.mean @ exp(np.full(6, 1e-3)), some_gaussian(seed + 50).covariance)
    assert a.fuse(b).mean == pytest.approx(b.fuse(a).mean, abs=1e-5)
    assert a.fuse(b).covariance == pytest.approx(b.fuse(a).covariance)


@given(mean=poses(), covariance=covariances(), xi=tangents(max_angle_rad=1.0))
def test_mahalanobis_distance_is_that_of_the_perturbation(
    mean: Pose, covariance: FloatArray, xi: FloatArray
) -> None:
    expected = float(xi @ np.linalg.inv(covariance) @ xi)
    found = GaussianPose(mean, covariance).mahalanobis2(mean @ exp(xi))
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
