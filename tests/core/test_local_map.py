"""Registration in the local map: known poses and motions, and what is not known is said."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from hmt_service.core import local_map as module
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    certain,
    exp,
    identity,
    inverse,
    isotropic_covariance,
    log,
    planar_covariance,
    planar_pose,
    transform_points,
)
from hmt_service.core.local_map import Fit, LocalMap, SeenPoints, Sweep
from tests.core.factories import (
    CORRIDOR,
    FLOOR,
    HALL,
    NO_PILLARS,
    PILLARS,
    RINGS,
    ROOM,
    TUNNEL,
    box,
    points_from,
    sweep_from,
)

STILL = np.zeros(6)
CENTRE = np.zeros(3)


def seen_from(points: FloatArray, pose: Pose, *, cell_m: float, is_planar: bool) -> SeenPoints:
    """Return what was seen from a pose in the map's frame, with the sensor at the body's centre."""
    seen = SeenPoints.of(points, CENTRE, cell_m=cell_m, is_planar=is_planar)
    return SeenPoints(transform_points(pose, seen.points), seen.directions @ pose[:3, :3].T)


def map_of(parts: Sequence[SeenPoints], *, cell_m: float, is_planar: bool) -> LocalMap:
    return LocalMap(
        SeenPoints(
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.directions for part in parts]),
        ),
        cell_m=cell_m,
        sigma_m=0.014,
        degenerate_m=0.05,
        is_planar=is_planar,
    )


def planar_map(walls: FloatArray, path: Sequence[Pose]) -> LocalMap:
    parts = [seen_from(points_from(walls, p), p, cell_m=0.1, is_planar=True) for p in path]
    return map_of(parts, cell_m=0.1, is_planar=True)


def spatial_map(
    path: Sequence[Pose],
    *,
    hall: FloatArray = HALL,
    pillars: FloatArray = PILLARS,
    rings_rad: FloatArray = RINGS,
) -> LocalMap:
    parts = []
    for pose in path:
        points, _ = sweep_from(pose, STILL, hall=hall, pillars=pillars, rings_rad=rings_rad)
        parts.append(seen_from(points, pose, cell_m=0.25, is_planar=False))
    return map_of(parts, cell_m=0.25, is_planar=False)


PLANAR_PATH = [planar_pose(x, -0.4, 0.3 * x) for x in (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0)]
SPATIAL_PATH = [
    exp(np.array([0.02 * i, -0.01 * i, 0.1 * i, 0.2 * i, 0.1 * i, 0.03 * i])) for i in range(-2, 3)
]
ROOM_MAP = planar_map(ROOM, PLANAR_PATH)
HALL_MAP = spatial_map(SPATIAL_PATH)


def believed(
    mean: Pose, *, sigma_rad: float = 0.2, sigma_m: float = 0.5, is_planar: bool
) -> GaussianPose:
    covariance = isotropic_covariance(sigma_rad=sigma_rad, sigma_m=sigma_m)
    return GaussianPose(mean, planar_covariance(covariance) if is_planar else covariance)


def instant(points: FloatArray) -> Sweep:
    return Sweep(points, np.zeros(len(points)), CENTRE - points)


def registered(
    local_map: LocalMap,
    sweep: Sweep,
    prior: GaussianPose,
    *,
    motion: GaussianPose | None = None,
) -> Fit:
    motion = motion or GaussianPose(identity(), isotropic_covariance(sigma_rad=0.1, sigma_m=0.3))
    return local_map.register(sweep, prior, motion)


def error_of(pose: Pose, truth: Pose) -> FloatArray:
    """Return the error as a tangent vector in the body."""
    return log(inverse(truth) @ pose)


# ------------------------------------------------------------------ known poses


@given(
    x=st.floats(-0.15, 0.15),
    y=st.floats(-0.15, 0.15),
    yaw=st.floats(-0.1, 0.1),
    at=st.sampled_from([(-0.8, -0.3, 0.2), (0.3, -0.6, -0.5), (0.7, 0.2, 2.5)]),
)
@settings(max_examples=30)
def test_planar_pose_is_recovered(
    x: float, y: float, yaw: float, at: tuple[float, float, float]
) -> None:
    truth = planar_pose(*at)
    prior = believed(truth @ planar_pose(x, y, yaw), is_planar=True)
    fit = registered(ROOM_MAP, instant(points_from(ROOM, truth)), prior)
    assert fit.is_converged
    error = error_of(fit.pose, truth)
    assert np.abs(error[3:]).max() < 0.005
    assert np.abs(error[:3]).max() < 0.002
    assert fit.inlier_share > 0.8
    assert fit.known_share >= fit.inlier_share
    assert fit.degenerate.shape == (0, 6)
    assert fit.prior_weight == 1.0


@pytest.mark.parametrize(
    "offset",
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.03, -0.02, 0.05, 0.1, -0.15, 0.08],
        [-0.05, 0.04, -0.1, -0.2, 0.1, -0.1],
    ],
)
def test_spatial_pose_is_recovered(offset: list[float]) -> None:
    truth = exp(np.array([0.03, -0.05, 0.4, 0.3, -0.2, 0.15]))
    points, _ = sweep_from(truth, STILL)
    prior = believed(truth @ exp(np.array(offset)), is_planar=False)
    fit = registered(HALL_MAP, instant(points).thinned(0.3, 3000), prior)
    assert fit.is_converged
    error = error_of(fit.pose, truth)
    assert np.abs(error[3:]).max() < 0.005
    assert np.abs(error[:3]).max() < 0.002
    assert fit.inlier_share > 0.8
    assert fit.degenerate.shape == (0, 6)


@pytest.mark.parametrize(
    "motion",
    [
        [0.0, 0.0, 0.0, 0.3, 0.0, 0.0],
        [0.0, 0.0, 0.3, 0.0, 0.0, 0.0],
        [0.04, -0.05, 0.25, 0.3, 0.1, -0.05],
    ],
    ids=["moving", "turning", "both"],
)
@pytest.mark.parametrize("guessed_share", [0.0, 0.7, 1.3])
def test_pose_and_motion_of_a_sweep_are_recovered(
    motion: list[float], guessed_share: float
) -> None:
    start, moved = exp(np.array([0.02, -0.03, 0.3, 0.2, -0.2, 0.1])), np.array(motion)
    points, times = sweep_from(start, moved)
    truth = start @ exp(moved)
    fit = registered(
        HALL_MAP,
        Sweep(points, 1.0 - times, CENTRE - points).thinned(0.3, 3000),
        believed(start @ exp(guessed_share * moved), is_planar=False),
        motion=believed(exp(guessed_share * moved), is_planar=False),
    )
    assert fit.is_converged
    error = error_of(fit.pose, truth)
    assert np.abs(error[3:]).max() < 0.008
    assert np.abs(error[:3]).max() < 0.003
    assert fit.motion[3:] == pytest.approx(moved[3:], abs=0.015)
    assert fit.motion[:3] == pytest.approx(moved[:3], abs=0.006)
    assert fit.inlier_share > 0.8


def test_motion_that_is_not_accounted_for_would_cost_half_of_it() -> None:
    # What the test above would pass with if the points were taken to be of one moment.
    start, moved = exp(np.array([0.02, -0.03, 0.3, 0.2, -0.2, 0.1])), np.zeros(6)
    moved[3] = 0.3
    points, _ = sweep_from(start, moved)
    truth = start @ exp(moved)
    fit = registered(HALL_MAP, instant(points), believed(truth, is_planar=False))
    assert np.linalg.norm(error_of(fit.pose, truth)[3:]) > 0.05


def test_sweep_at_its_end_is_a_picture_of_the_room() -> None:
    start, moved = SPATIAL_PATH[1], np.array([0.04, -0.05, 0.25, 0.3, 0.1, -0.05])
    points, times = sweep_from(start, moved, pillars=NO_PILLARS)
    sweep = Sweep(points, 1.0 - times, CENTRE - points)

    def off_walls_m(points_in_body: FloatArray) -> float:
        moved_points = transform_points(start @ exp(moved), points_in_body)
        gaps = np.abs(np.concatenate([moved_points - HALL[:3], moved_points - HALL[3:]], axis=1))
        return float(gaps.min(axis=1).max())

    assert off_walls_m(sweep.at_end(moved)) < 1e-9
    assert off_walls_m(points) > 0.2
    assert np.array_equal(sweep.at_end(moved), sweep.at_end(moved))
    assert instant(points).at_end(moved) is not None
    assert np.array_equal(instant(points).at_end(moved), points)


def test_planar_pose_stays_planar_exactly() -> None:
    for yaw in (-2.9, -0.4, 0.7, 3.0):
        truth = planar_pose(0.2, -0.1, yaw)
        points = points_from(ROOM, truth)
        points[:, 2] = 0.02  # a laser that is mounted higher than the map was made
        prior = believed(truth @ planar_pose(0.08, -0.05, 0.06), is_planar=True)
        pose = registered(ROOM_MAP, instant(points), prior).pose
        assert pose[2].tolist() == [0.0, 0.0, 1.0, 0.0]
        assert pose[:, 2].tolist() == [0.0, 0.0, 1.0, 0.0]
        assert pose[0, 0] == pose[1, 1]
        assert pose[0, 1] == -pose[1, 0]
        assert pose[0, 0] ** 2 + pose[1, 0] ** 2 == pytest.approx(1.0, abs=1e-15)


# ------------------------------------------------------------------ what a scan does not say


def test_planar_corridor_says_nothing_of_the_way_along_it() -> None:
    path = [planar_pose(x, 0.0, 0.0) for x in np.arange(-2.0, 2.1, 0.5)]
    local_map = planar_map(CORRIDOR, path)
    truth = planar_pose(0.3, 0.1, 0.5)
    prior = believed(planar_pose(0.37, 0.04, 0.45), sigma_rad=0.1, sigma_m=0.2, is_planar=True)
    fit = registered(local_map, instant(points_from(CORRIDOR, truth)), prior)
    # Along the corridor, in the body that is turned by 0.5 rad.
    along = np.array([0.0, 0.0, 0.0, np.cos(0.5), -np.sin(0.5), 0.0])
    assert fit.degenerate.shape == (1, 6)
    assert abs(fit.degenerate[0] @ along) == pytest.approx(1.0, abs=1e-4)
    # 1 / m^2 would be a standard deviation of 1 m, where what counts is one of 0.05 m.
    assert abs(along @ fit.information @ along) < 1.0
    # To second order: 0.06 m across, seen from halfway through a turn of 0.05 rad, are 0.0015 m.
    assert fit.pose[0, 3] == pytest.approx(0.37, abs=0.002)
    assert fit.pose[1, 3] == pytest.approx(0.1, abs=0.003)
    assert error_of(fit.pose, truth)[2] == pytest.approx(0.0, abs=0.002)


def test_spatial_tunnel_says_nothing_of_the_way_along_it() -> None:
    path = [planar_pose(x, 0.0, 0.0) for x in (-1.0, 0.0, 1.0)]
    local_map = spatial_map(path, hall=TUNNEL, pillars=NO_PILLARS)
    truth = exp(np.array([0.02, -0.03, 0.3, 0.25, 0.1, 0.05]))
    points, _ = sweep_from(truth, STILL, hall=TUNNEL, pillars=NO_PILLARS)
    guess = truth.copy()
    guess[:3, 3] += [0.08, -0.06, 0.04]
    fit = registered(
        local_map,
        instant(points).thinned(0.3, 3000),
        believed(guess, sigma_rad=0.1, sigma_m=0.2, is_planar=False),
    )
    along = np.concatenate([np.zeros(3), truth[:3, :3].T @ [1.0, 0.0, 0.0]])
    assert fit.degenerate.shape == (1, 6)
    assert abs(fit.degenerate[0] @ along) == pytest.approx(1.0, abs=1e-3)
    # The edges of the tunnel pull the pose along it; no certainty comes from that.
    prior_information = np.diag([0.1**-2] * 3 + [0.2**-2] * 3)
    covariance = np.linalg.inv(fit.information + prior_information)
    assert np.sqrt(along @ covariance @ along) == pytest.approx(0.2, rel=0.05)
    assert fit.pose[0, 3] == pytest.approx(guess[0, 3], abs=0.2)
    assert fit.pose[1:3, 3] == pytest.approx(truth[1:3, 3], abs=0.005)
    assert np.abs(error_of(fit.pose, truth)[:3]).max() < 0.002


@pytest.mark.parametrize("rings", [1, 6])
def test_rings_on_a_floor_do_not_hold_the_robot_to_them(rings: int) -> None:
    # What is seen of the floor moves with the robot: to match it would be to stand still.
    rings_rad = np.linspace(-0.4, -0.2, rings) if rings > 1 else np.array([-0.3])
    path = [identity(), planar_pose(0.5, 0.0, 0.0), planar_pose(1.0, 0.0, 0.0)]
    local_map = spatial_map(path, hall=FLOOR, pillars=NO_PILLARS, rings_rad=rings_rad)
    truth = planar_pose(1.3, 0.1, 0.2)
    points, _ = sweep_from(truth, STILL, hall=FLOOR, pillars=NO_PILLARS, rings_rad=rings_rad)
    guess = truth @ planar_pose(0.05, -0.05, 0.03)
    prior = believed(guess, sigma_rad=0.1, sigma_m=0.3, is_planar=False)
    fit = registered(local_map, instant(points), prior)
    assert fit.pose == pytest.approx(guess, abs=0.003)
    on_floor = np.zeros((6, 3))
    on_floor[[2, 3, 4], [0, 1, 2]] = 1.0
    # Yaw, x and y are among the directions that nothing is known about.
    within = fit.degenerate.T @ np.linalg.lstsq(fit.degenerate.T, on_floor, rcond=None)[0]
    assert within == pytest.approx(on_floor, abs=0.02)
    assert fit.information[2:5, 2:5] == pytest.approx(0.0, abs=1e-3 / 0.05**2)


def test_rings_on_a_floor_say_how_high_and_how_tilted_the_robot_is() -> None:
    rings_rad = np.linspace(-0.5, -0.2, 16)
    path = [planar_pose(x, 0.0, 0.0) for x in (0.0, 0.5, 1.0)]
    local_map = spatial_map(path, hall=FLOOR, pillars=NO_PILLARS, rings_rad=rings_rad)
    truth = exp(np.array([0.02, -0.03, 0.1, 0.7, 0.1, 0.04]))
    points, _ = sweep_from(truth, STILL, hall=FLOOR, pillars=NO_PILLARS, rings_rad=rings_rad)
    prior = believed(planar_pose(0.7, 0.1, 0.1), is_planar=False)
    fit = registered(local_map, instant(points), prior)
    error = error_of(fit.pose, truth)
    assert np.abs(error[[0, 1]]).max() < 0.002
    assert abs(error[5]) < 0.003
    assert len(fit.degenerate) == 3


# ------------------------------------------------------------------ what the prior says


@pytest.mark.parametrize("is_planar", [True, False])
def test_prior_that_contradicts_loses_its_weight(is_planar: bool) -> None:
    truth = planar_pose(0.3, -0.3, 0.2)
    points = points_from(ROOM, truth) if is_planar else sweep_from(truth, STILL)[0]
    # Ten standard deviations off.
    prior = believed(
        truth @ planar_pose(0.2, 0.0, 0.0), sigma_rad=0.01, sigma_m=0.02, is_planar=is_planar
    )
    sweep = instant(points) if is_planar else instant(points).thinned(0.3, 3000)
    fit = registered(ROOM_MAP if is_planar else HALL_MAP, sweep, prior)
    distance2 = prior.mahalanobis2(fit.pose)
    assert distance2 > 80.0
    gate = chi2.ppf(0.95, 3 if is_planar else 6)
    assert fit.prior_weight == pytest.approx(gate / distance2, rel=0.05)
    assert np.abs(error_of(fit.pose, truth)[3:]).max() < 0.01
    assert fit.is_converged


def test_honest_prior_counts_in_full() -> None:
    truth = planar_pose(0.3, -0.3, 0.2)
    prior = believed(
        truth @ planar_pose(0.03, 0.0, 0.01), sigma_rad=0.01, sigma_m=0.02, is_planar=True
    )
    fit = registered(ROOM_MAP, instant(points_from(ROOM, truth)), prior)
    assert prior.mahalanobis2(fit.pose) < 7.81
    assert fit.prior_weight == 1.0


def test_pose_is_the_product_of_scan_and_prior() -> None:
    # So narrow a prior pulls: the closed form of the product of two Gaussians says how far.
    truth = planar_pose(0.3, -0.3, 0.2)
    sweep = instant(points_from(ROOM, truth))
    free = registered(
        ROOM_MAP, sweep, believed(truth, sigma_rad=10.0, sigma_m=10.0, is_planar=True)
    )
    prior = believed(
        truth @ planar_pose(0.004, -0.003, 0.001), sigma_rad=0.001, sigma_m=0.002, is_planar=True
    )
    fused = registered(ROOM_MAP, sweep, prior)
    block = np.ix_([2, 3, 4], [2, 3, 4])
    own, theirs = fused.information[block], np.linalg.inv(prior.covariance[block])
    pull = np.linalg.solve(own + theirs, theirs @ error_of(prior.mean, free.pose)[[2, 3, 4]])
    assert error_of(fused.pose, free.pose)[[2, 3, 4]] == pytest.approx(pull, abs=5e-4)
    assert np.linalg.norm(pull) > 1e-3


# ------------------------------------------------------------------ search


@pytest.mark.parametrize("turn_rad", [-0.5, 0.5])
def test_heading_that_is_half_a_radian_wrong_is_found(
    turn_rad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = planar_pose(0.3, -0.3, 0.2)
    sweep = instant(points_from(ROOM, truth))
    prior = believed(
        truth @ planar_pose(0.0, 0.0, turn_rad), sigma_rad=0.05, sigma_m=0.05, is_planar=True
    )
    found = registered(ROOM_MAP, sweep, prior)
    with monkeypatch.context() as patch:
        patch.setattr(module, "_FOUND_SHARE", 0.0)  # nothing is searched for
        missed = registered(ROOM_MAP, sweep, prior)
    assert abs(error_of(missed.pose, truth)[2]) > 0.1
    assert np.abs(error_of(found.pose, truth)[[2, 3, 4]]).max() < 0.02
    assert found.inlier_share > 0.8


def test_scan_of_another_place_fits_nowhere() -> None:
    elsewhere = points_from(box(-0.6, -0.5, 0.9, 0.7), identity())
    for pose in (identity(), planar_pose(1.0, -0.5, 1.0)):
        fit = registered(ROOM_MAP, instant(elsewhere), believed(pose, is_planar=True))
        assert fit.inlier_share < 0.3
    far_off = believed(planar_pose(50.0, 0.0, 0.0), is_planar=True)
    fit = registered(ROOM_MAP, instant(elsewhere), far_off)
    assert (fit.inlier_share, fit.known_share) == (0.0, 0.0)
    # Nothing at all is known, so that the prior stands.
    assert fit.pose == pytest.approx(far_off.mean, abs=1e-9)
    assert len(fit.degenerate) == 3
    assert np.array_equal(fit.information, np.zeros((6, 6)))


# ------------------------------------------------------------------ sweeps


def numbered(count: int) -> Sweep:
    """Return a sweep in which the lag of each point follows from its position."""
    points = np.random.default_rng(20).uniform(-3.0, 3.0, (count, 3))
    return Sweep(points, lag_of(points), np.array([0.1, 0.2, 0.3]) - points)


def lag_of(points: FloatArray) -> FloatArray:
    return np.asarray(np.abs(np.sin(points.sum(axis=1))))


@pytest.mark.parametrize("most", [50, 100_000])
def test_thinned_sweep_keeps_points_and_lags_together(most: int) -> None:
    sweep = numbered(5000)
    thinned = sweep.thinned(0.5, most)
    assert len(thinned.points) == len(thinned.lags) <= most
    assert np.array_equal(thinned.lags, lag_of(thinned.points))
    assert np.array_equal(thinned.views, np.array([0.1, 0.2, 0.3]) - thinned.points)
    cells = np.floor(thinned.points / 0.5)
    assert len(np.unique(cells, axis=0)) == len(cells)
    # Those that are kept of too many come from all of the sweep.
    rank = {tuple(p): i for i, p in enumerate(sweep.points)}
    ranks = [rank[tuple(p)] for p in thinned.points]
    assert ranks == sorted(ranks)
    assert ranks[0] == 0
    assert len(thinned.points) == most or most > 5000


def test_every_so_many_th_point_keeps_its_lag() -> None:
    sweep = numbered(103)
    fewer = sweep.every(4)
    assert np.array_equal(fewer.points, sweep.points[[*range(0, 103, 4)]])
    assert np.array_equal(fewer.lags, lag_of(fewer.points))
    assert not np.shares_memory(fewer.points, sweep.points)


def test_sweep_without_lags_is_an_instant() -> None:
    assert instant(np.ones((4, 3))).is_instant
    assert not numbered(4).is_instant


def test_same_scan_gives_the_same_bytes() -> None:
    def run() -> bytes:
        start, moved = SPATIAL_PATH[3], np.array([0.01, 0.02, 0.1, 0.2, 0.0, 0.0])
        points, times = sweep_from(start, moved, noise=np.random.default_rng(21))
        sweep = Sweep(points, 1.0 - times, CENTRE - points).thinned(0.3, 2000)
        motion = certain(identity())
        motion = GaussianPose(motion.mean, isotropic_covariance(sigma_rad=0.2, sigma_m=0.4))
        fit = registered(
            spatial_map(SPATIAL_PATH[:2]), sweep, believed(start, is_planar=False), motion=motion
        )
        arrays = (fit.pose, fit.motion, fit.information, fit.degenerate)
        return b"".join(array.tobytes() for array in arrays)

    assert run() == run()
