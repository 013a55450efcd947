"""Alignment of submaps in rooms that have one pose, four, or a line of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.core.alignment import Aligner, Mode
from hmt_service.core.config import load_config
from hmt_service.core.geometry import (
    GaussianPose,
    Pose,
    certain,
    identity,
    inverse,
    log,
    planar_pose,
    yaw_of,
)
from tests.core.factories import CORRIDOR, ROOM, SQUARE, gaussian, line, visit_along

CONFIG = load_config()
ALIGNER = Aligner(CONFIG)
ORIGIN = planar_pose(-1.5, 0.0, 0.0)
START = planar_pose(1.5, 0.3, 2.0)
TARGET = visit_along(ROOM, line(ORIGIN, length_m=3.0))
VISIT = visit_along(ROOM, [START, START @ planar_pose(0.3, 0.1, 0.2)], visit=1)
TRUTH = inverse(ORIGIN) @ START
ANY_HEADING_RAD = 3.0


def error_of(mode: Mode, truth: Pose) -> float:
    """Return the largest of the errors, rad or m."""
    return float(np.abs(log(inverse(truth) @ mode.target_from_visit.mean)).max())


@pytest.mark.parametrize("sigma_rad", [0.3, ANY_HEADING_RAD])
def test_room_that_looks_like_no_other_has_one_mode(sigma_rad: float) -> None:
    prior = gaussian(TRUTH @ planar_pose(0.8, -0.5, 0.4), sigma_rad=sigma_rad, sigma_m=0.6)
    (mode,) = ALIGNER.modes(VISIT, TARGET, prior)
    assert error_of(mode, TRUTH) < 0.01
    assert mode.overlap > 0.9


def test_tight_prior_needs_no_search() -> None:
    prior = gaussian(TRUTH @ planar_pose(0.04, -0.04, 0.01), sigma_rad=0.02, sigma_m=0.1)
    (mode,) = ALIGNER.modes(VISIT, TARGET, prior)
    assert error_of(mode, TRUTH) < 0.01


def test_modes_far_outside_the_prior_do_not_count() -> None:
    wrong = TRUTH @ planar_pose(3.0, 0.0, 0.0)
    assert ALIGNER.modes(VISIT, TARGET, gaussian(wrong, sigma_rad=0.05, sigma_m=0.3)) == ()
    (mode,) = ALIGNER.modes(VISIT, TARGET, gaussian(wrong, sigma_rad=0.05, sigma_m=1.5))
    assert error_of(mode, TRUTH) < 0.01


@pytest.mark.parametrize(("sigma_x_m", "is_inside"), [(0.05, False), (1.0, True)])
def test_gate_has_the_shape_of_the_prior(sigma_x_m: float, is_inside: bool) -> None:
    # The search is as wide as the prior's longest axis; the truth is 1 m off along the other one.
    mean = planar_pose(1.0, 0.0, 0.0) @ TRUTH
    covariance = np.diag([1e-8, 1e-8, 0.05**2, sigma_x_m**2, 1.0, 1e-8])
    in_target = GaussianPose(planar_pose(float(mean[0, 3]), float(mean[1, 3]), 0.0), covariance)
    prior = in_target @ certain(planar_pose(0.0, 0.0, yaw_of(mean)))
    assert len(ALIGNER.modes(VISIT, TARGET, prior)) == int(is_inside)


def test_square_room_has_a_mode_per_quarter_turn() -> None:
    start = planar_pose(1.0, 0.5, 0.3)
    target = visit_along(SQUARE, [planar_pose(0.3 * i, 0.0, 0.0) for i in range(3)])
    visit = visit_along(SQUARE, [start], visit=1)
    prior = gaussian(start, sigma_rad=ANY_HEADING_RAD, sigma_m=3.0)
    modes = ALIGNER.modes(visit, target, prior)
    assert len(modes) == 4
    for quarter in range(4):
        turned = planar_pose(0.0, 0.0, quarter * math.pi / 2) @ start
        assert min(error_of(mode, turned) for mode in modes) < 0.01


def test_known_heading_leaves_one_mode_of_a_square_room() -> None:
    target = visit_along(SQUARE, [planar_pose(0.3 * i, 0.0, 0.0) for i in range(3)])
    visit = visit_along(SQUARE, [identity()], visit=1)
    (mode,) = ALIGNER.modes(visit, target, gaussian(identity(), sigma_rad=0.1, sigma_m=0.5))
    assert error_of(mode, identity()) < 0.01


def test_corridor_is_aligned_across_and_unknown_along() -> None:
    target = visit_along(CORRIDOR, line(identity(), length_m=4.0))
    visit = visit_along(CORRIDOR, line(identity(), length_m=2.0), visit=1)
    prior = gaussian(planar_pose(0.0, 0.1, 0.05), sigma_rad=0.1, sigma_m=0.5)
    modes = ALIGNER.modes(visit, target, prior)
    assert modes
    for mode in modes:
        sigma = np.sqrt(np.diag(mode.target_from_visit.covariance))
        assert sigma[3] == pytest.approx(10.0, rel=0.01)
        assert sigma[4] < 0.03
    best = modes[0].target_from_visit.mean
    assert best[1, 3] == pytest.approx(0.0, abs=0.01)
    assert yaw_of(best) == pytest.approx(0.0, abs=0.01)


def test_room_and_corridor_do_not_align() -> None:
    target = visit_along(CORRIDOR, line(identity(), length_m=4.0))
    prior = gaussian(identity(), sigma_rad=ANY_HEADING_RAD, sigma_m=2.0)
    assert ALIGNER.modes(VISIT, target, prior) == ()


def test_modes_are_distinct_planar_and_in_falling_order_of_overlap() -> None:
    target = visit_along(SQUARE, [planar_pose(0.3 * i, 0.0, 0.0) for i in range(3)])
    prior = gaussian(identity(), sigma_rad=ANY_HEADING_RAD, sigma_m=2.0)
    modes = ALIGNER.modes(VISIT, target, prior)  # a furnished room in an empty one: 60 % fits
    assert 1 < len(modes) <= CONFIG.alignment.max_modes
    overlaps = [mode.overlap for mode in modes]
    assert overlaps == sorted(overlaps, reverse=True)
    assert min(overlaps) >= CONFIG.alignment.min_overlap
    for i, mode in enumerate(modes):
        assert mode.target_from_visit.mean[2].tolist() == [0.0, 0.0, 1.0, 0.0]
        for other in modes[:i]:
            apart = log(inverse(other.target_from_visit.mean) @ mode.target_from_visit.mean)
            assert np.linalg.norm(apart[3:]) > 0.6 or abs(apart[2]) > 0.15


def test_number_of_modes_is_bounded() -> None:
    config = load_config(text="alignment: {max_modes: 2}")
    target = visit_along(SQUARE, [planar_pose(0.3 * i, 0.0, 0.0) for i in range(3)])
    visit = visit_along(SQUARE, [identity()], visit=1)
    prior = gaussian(identity(), sigma_rad=ANY_HEADING_RAD, sigma_m=0.5)
    assert len(Aligner(config).modes(visit, target, prior)) == 2


def test_refinement_refuses_a_guess_where_the_submaps_disagree() -> None:
    assert (
        ALIGNER.refine(VISIT, TARGET, TRUTH @ planar_pose(40.0, 0.0, 0.0), min_overlap=0.45) is None
    )
    mode = ALIGNER.refine(VISIT, TARGET, TRUTH @ planar_pose(0.05, 0.0, 0.0), min_overlap=0.45)
    assert mode is not None
    assert error_of(mode, TRUTH) < 0.01


def test_claimed_accuracy_is_not_better_than_its_floor() -> None:
    mode = ALIGNER.refine(VISIT, TARGET, TRUTH, min_overlap=0.45)
    assert mode is not None
    sigma = np.sqrt(np.diag(mode.target_from_visit.covariance))
    assert sigma[2] > CONFIG.covariance.floor_submap_rad
    assert sigma[3:5].min() > CONFIG.covariance.floor_submap_m
    assert sigma[3:5].max() < 0.03


def test_same_submaps_give_the_same_bytes() -> None:
    prior = gaussian(TRUTH, sigma_rad=1.0, sigma_m=1.0)
    first, second = (Aligner(CONFIG).modes(VISIT, TARGET, prior) for _ in range(2))
    assert [m.target_from_visit.mean.tobytes() for m in first] == [
        m.target_from_visit.mean.tobytes() for m in second
    ]


def test_nothing_aligns_with_a_submap_without_points() -> None:
    start = planar_pose(500.0, 0.0, 0.0)
    empty = visit_along(ROOM, [start, start @ planar_pose(0.3, 0.0, 0.0)], visit=1)
    assert len(empty.points) == 0
    assert empty.reach_m == 0.0
    wide = gaussian(TRUTH, sigma_rad=ANY_HEADING_RAD, sigma_m=3.0)
    assert ALIGNER.modes(empty, TARGET, wide) == ALIGNER.modes(VISIT, empty, wide) == ()
    assert ALIGNER.refine(empty, TARGET, TRUTH, min_overlap=0.0) is None
    assert ALIGNER.refine(VISIT, empty, TRUTH, min_overlap=0.0) is None
