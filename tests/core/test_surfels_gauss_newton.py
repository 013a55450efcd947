"""Gauss-Newton on surfels, with `geometry` and finite differences as judges."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core import surfels as compiled
from hmt_service.core.geometry import (
    FloatArray,
    Pose,
    exp,
    identity,
    inverse,
    log,
    transform_points,
)
from hmt_service.core.surfels import Surfels, match
from tests.core.factories import matches_of, surfels_of, sweep_from, unpacked

TANGENTS = np.concatenate(
    [
        np.random.default_rng(1).uniform(-1.7, 1.7, (200, 6)),
        1e-9 * np.random.default_rng(2).uniform(-1.0, 1.0, (20, 6)),
        1e-4 * np.random.default_rng(3).uniform(-1.0, 1.0, (20, 6)),
        np.zeros((1, 6)),
    ]
)
# Angles from next to nothing to almost half a turn.
ROTATIONS = np.linalg.norm(TANGENTS[:, :3], axis=1)
STILL = np.zeros(6)


# ------------------------------------------------------------------ transforms


def test_compiled_exp_is_that_of_geometry() -> None:
    result = np.empty((4, 4))
    for xi in TANGENTS:
        compiled._exp(xi, result)
        assert result == pytest.approx(exp(xi), abs=1e-14)


def test_compiled_log_is_that_of_geometry() -> None:
    result = np.empty(6)
    for xi in TANGENTS[ROTATIONS < 3.1]:
        compiled._log(exp(xi), result)
        assert result == pytest.approx(log(exp(xi)), abs=1e-12)
        assert result == pytest.approx(xi, abs=1e-12)


def test_compiled_difference_of_poses_is_that_of_geometry() -> None:
    result = np.empty((4, 4))
    for first, second in zip(exp(TANGENTS), exp(TANGENTS[::-1]), strict=True):
        compiled._inverse_times(first, second, result)
        assert result == pytest.approx(inverse(first) @ second, abs=1e-14)


def test_points_are_carried_to_the_end_by_the_motion_that_was_still_to_come() -> None:
    rng = np.random.default_rng(4)
    points, motion = rng.uniform(-20.0, 20.0, (60, 3)), rng.uniform(-0.4, 0.4, 6)
    # Columns of three points, and a column taken at the very end.
    lags = np.repeat(np.append(rng.uniform(0.0, 1.0, 19), 0.0), 3)
    moved = np.empty_like(points)
    compiled.carry_to_end(points, lags, motion, moved)
    # A point at the time of lag 1 is where the body was before all of the motion.
    expected = [
        transform_points(inverse(exp(lag * motion)), point[None])[0]
        for point, lag in zip(points, lags, strict=True)
    ]
    assert moved == pytest.approx(np.array(expected), abs=1e-12)
    assert np.array_equal(moved[-3:], points[-3:])


# ------------------------------------------------------------------ linearization


def linearized(
    surfels: Surfels, points: FloatArray, lags: FloatArray, pose: Pose, *, kernel2: float
) -> tuple[FloatArray, FloatArray, int, int]:
    information, gradient = np.empty((12, 12)), np.empty(12)
    moved, found = transform_points(pose, points), np.empty(len(points), np.int64)
    hits = np.empty(len(surfels.means), np.int64)
    match(surfels, moved, pose, -points, found, hits)
    matched, fitting = compiled.linearize(
        surfels, points, lags, pose, moved, found, hits, kernel2, information, gradient
    )
    return information, gradient, matched, fitting


def residuals(
    points: FloatArray, lags: FloatArray, pose: Pose, change: FloatArray, means: FloatArray
) -> FloatArray:
    """Return the points less their surfels after a change of pose and motion, shape (N, 3)."""
    carried = exp(-lags[:, None] * change[6:])
    moved = np.einsum("nij,nj->ni", carried[:, :3, :3], points) + carried[:, :3, 3]
    return transform_points(pose @ exp(change[:6]), moved) - means


@pytest.mark.parametrize("kernel", [4.0, 1e6])
def test_gradient_and_information_are_those_of_the_cost(kernel: float) -> None:
    points, times = sweep_from(identity(), STILL, noise=np.random.default_rng(12))
    surfels = surfels_of(points, np.zeros(3), cell_m=0.4)
    pose = exp(np.array([0.004, -0.003, 0.005, 0.01, -0.02, 0.015]))
    points, lags = points[::37].copy(), 1.0 - times[::37]
    information, gradient, matched, _ = linearized(surfels, points, lags, pose, kernel2=kernel**2)

    # What each point lies on is held fast, as is how many share a surfel.
    moved = transform_points(pose, points)
    found = matches_of(surfels, moved, pose[:3, 3] - moved)
    is_matched = found >= 0
    assert matched == is_matched.sum() > 100
    found, points, lags = found[is_matched], points[is_matched], lags[is_matched]
    crowd = 1.0 + np.bincount(found)[found]
    assert crowd.max() > 2.0
    means, weights = surfels.means[found], np.array([unpacked(surfels.weights[s]) for s in found])

    def cost(change: FloatArray) -> float:
        r = residuals(points, lags, pose, change, means)
        distance2 = np.einsum("ni,nij,nj->n", r, weights, r)
        # Geman and McClure: half the squared distance, less and less of it.
        return float(np.sum(0.5 * distance2 / (1.0 + distance2 / kernel**2) / crowd))

    step = 1e-5
    steps = step * np.eye(12)
    numeric = np.array([(cost(s) - cost(-s)) / (2.0 * step) for s in steps])
    assert gradient == pytest.approx(numeric, rel=1e-4, abs=1e-5 * np.abs(numeric).max())

    ahead = [residuals(points, lags, pose, s, means) for s in steps]
    behind = [residuals(points, lags, pose, -s, means) for s in steps]
    jacobians = (np.array(ahead) - np.array(behind)).transpose(1, 2, 0) / (2.0 * step)
    r = residuals(points, lags, pose, np.zeros(12), means)
    robust = 1.0 / (1.0 + np.einsum("ni,nij,nj->n", r, weights, r) / kernel**2) ** 2 / crowd
    expected = np.einsum("n,nia,nij,njb->ab", robust, jacobians, weights, jacobians)
    assert information == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.abs(expected).max())
    assert np.array_equal(information, information.T)


def test_points_that_share_a_surfel_share_its_error() -> None:
    y, z = np.meshgrid(np.arange(-0.2, 0.2, 0.02), np.arange(-0.2, 0.2, 0.02))
    wall = np.stack([np.full(y.size, 1.1), y.ravel() + 0.5, z.ravel() + 0.5], axis=1)
    surfels = surfels_of(wall, np.zeros(3), cell_m=1.0)
    for count in (1, 4, 100):
        points = wall[:count].copy()
        information, _, matched, fitting = linearized(
            surfels, points, np.zeros(count), identity(), kernel2=16.0
        )
        assert (matched, fitting) == (count, count)
        # Along the normal, m points weigh m / (1 + m) times one of 0.014 m.
        assert information[3, 3] == pytest.approx(count / (1 + count) / 0.014**2, rel=1e-9)
        assert information[4, 4] == pytest.approx(0.0, abs=1e-6)


def test_point_far_off_its_surfel_matches_but_does_not_fit() -> None:
    y, z = np.meshgrid(np.arange(-0.2, 0.2, 0.02), np.arange(-0.2, 0.2, 0.02))
    wall = np.stack([np.full(y.size, 1.1), y.ravel() + 0.5, z.ravel() + 0.5], axis=1)
    surfels = surfels_of(wall, np.zeros(3), cell_m=1.0)
    # 1 / (1 + d2 / 16)^2 is a quarter at d = 4 standard deviations of 0.014 m: 0.056 m.
    for offset_m, fits in ((0.055, 1), (0.057, 0), (0.5, 0)):
        points = np.array([[1.1 + offset_m, 0.5, 0.5]])
        *_, matched, fitting = linearized(surfels, points, np.zeros(1), identity(), kernel2=16.0)
        assert (matched, fitting) == (1, fits)


def test_same_points_give_the_same_bytes() -> None:
    def run() -> bytes:
        points, times = sweep_from(identity(), STILL, noise=np.random.default_rng(13))
        surfels = surfels_of(points, np.zeros(3))
        pose = exp(np.full(6, 0.01))
        pose, motion, information, *_ = compiled.gauss_newton(
            surfels, points, 1.0 - times, -points, pose, identity(), np.eye(6), 12.6,
            np.zeros(6), np.eye(6), 16.0, 10,
        )  # fmt: skip
        matches = matches_of(surfels, points[::99], -points[::99])
        known = matches[matches >= 0]
        assert len(known) > 50
        fitted = (surfels.means[known], surfels.normals[known], surfels.weights[known])
        arrays = (pose, motion, information, *fitted)
        return matches.tobytes() + b"".join(array.tobytes() for array in arrays)

    assert run() == run()
