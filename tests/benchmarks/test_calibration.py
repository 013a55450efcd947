"""Scores against arithmetic by hand, NEES against samples of known covariance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.calibration import (
    Bin,
    brier,
    consistency,
    is_contested,
    log_loss,
    normalised_error,
    reliability,
    score,
    wilson_interval,
)
from benchmarks.scoring import Decision, Option
from hmt_service.core.geometry import GaussianPose, exp, planar_covariance, planar_pose
from hmt_service.errors import InvalidInput


def decision(*options: tuple[float, bool], is_known: bool = True) -> Decision:
    """Return a decision with these probabilities, and whether each option is right."""
    return Decision(
        tuple(Option(p, is_known=is_known, is_right=is_right) for p, is_right in options),
        is_return=True,
    )


def test_a_perfect_posterior_scores_perfectly() -> None:
    scores = score([decision((1.0, True))] * 4)
    assert (scores.brier, scores.log_loss, scores.expected_calibration_error) == (0.0, 0.0, 0.0)
    assert scores.bins == (Bin(4, 1.0, 4),)


def test_an_over_confident_wrong_posterior() -> None:
    """Three decisions right at 1; two wrong at 0.9 where the right option has 0.1."""
    scores = score([decision((1.0, True))] * 3 + [decision((0.9, False), (0.1, True))] * 2)
    assert scores.decisions == 5
    assert scores.brier == pytest.approx(2 * 0.81 / 5)
    assert scores.log_loss == pytest.approx(2 * 2.302585 / 5)
    # All five are in the last bin: 0.96 believed, 0.6 right.
    assert scores.expected_calibration_error == pytest.approx(0.36)
    assert [(one.count, one.right) for one in scores.bins] == [(5, 3)]


def test_an_under_confident_right_posterior() -> None:
    scores = score([decision((0.6, True), (0.4, False))] * 7)
    assert scores.brier == pytest.approx(0.16)
    assert scores.log_loss == pytest.approx(0.510826)
    assert scores.expected_calibration_error == pytest.approx(0.4)


def test_a_calibrated_posterior_has_no_calibration_error_but_is_not_perfect() -> None:
    scores = score(
        [decision((0.75, True), (0.25, False))] * 3 + [decision((0.75, False), (0.25, True))]
    )
    assert scores.expected_calibration_error == pytest.approx(0.0)
    assert scores.brier == pytest.approx((3 * 0.0625 + 0.5625) / 4)


def test_always_new_is_certain_and_wrong_as_often_as_the_robot_returns() -> None:
    scores = score([decision((1.0, True))] * 8 + [decision((1.0, False))] * 2)
    assert scores.brier == pytest.approx(0.2)
    assert scores.log_loss == pytest.approx(0.2 * 13.815511)
    assert scores.expected_calibration_error == pytest.approx(0.2)


def test_a_right_option_that_is_missing_has_probability_zero() -> None:
    lost = decision((0.5, False), (0.5, False))
    assert brier(lost) == pytest.approx(0.5 * (1.0 + 0.25 + 0.25))
    assert log_loss(lost) == pytest.approx(13.815511)


def test_options_that_are_right_are_one() -> None:
    assert brier(decision((0.5, True), (0.3, True), (0.2, False))) == pytest.approx(0.04)
    assert log_loss(decision((0.5, True), (0.3, True), (0.2, False))) == pytest.approx(
        0.223144, rel=1e-5
    )


def test_the_scores_are_proper() -> None:
    """Of three exclusive options with these chances, saying just these scores best on average."""
    chances = np.array([0.5, 0.3, 0.2])

    def expected(said: np.ndarray, loss: object) -> float:
        assert callable(loss)
        outcomes = [decision(*((p, i == true) for i, p in enumerate(said))) for true in range(3)]
        return float(chances @ [loss(one) for one in outcomes])

    for loss in (brier, log_loss):
        honest = expected(chances, loss)
        for gap in ([0.1, -0.1, 0.0], [-0.1, 0.0, 0.1], [0.0, 0.05, -0.05], [0.3, -0.2, -0.1]):
            assert expected(chances + gap, loss) > honest


def test_two_right_options_say_nothing_about_calibration() -> None:
    """Without the middle one: 1 right of 2 at 0.8."""
    either = decision((0.5, True), (0.5, True))
    scores = score([decision((0.8, True), (0.2, False)), either, decision((0.8, False))])
    assert scores.decisions == 3
    assert scores.bins == (Bin(2, 0.8, 1),)
    assert scores.expected_calibration_error == pytest.approx(0.3)
    assert score([either]).expected_calibration_error == 0.0


def test_what_is_contested() -> None:
    def single(p: float, *, is_known: bool, is_return: bool) -> Decision:
        rest = Option(1.0 - p, is_known=True, is_right=False)
        return Decision((Option(p, is_known=is_known, is_right=True), rest), is_return)

    assert not is_contested(single(0.995, is_known=False, is_return=False))
    assert is_contested(single(0.98, is_known=False, is_return=False))
    assert is_contested(single(0.995, is_known=True, is_return=False))
    assert is_contested(single(0.995, is_known=False, is_return=True))


def test_bins_hold_their_lower_edge_and_the_last_both() -> None:
    bins = reliability([0.5, 0.59, 0.6, 0.95, 1.0], [True, False, True, True, False])
    assert [(one.count, one.right) for one in bins] == [(2, 1), (1, 1), (2, 1)]
    assert [one.confidence for one in bins] == pytest.approx([0.545, 0.6, 0.975])


def test_the_calibration_error_weighs_bins_by_their_counts() -> None:
    """A bin of 3 at 0.95 with 2 right, a bin of 1 at 0.55 that is right."""
    scores = score(
        [decision((0.95, True), (0.05, False))] * 2
        + [decision((0.95, False), (0.05, True)), decision((0.55, True), (0.45, False))]
    )
    assert scores.expected_calibration_error == pytest.approx(
        0.75 * abs(2 / 3 - 0.95) + 0.25 * abs(1.0 - 0.55)
    )


def test_nothing_has_no_score() -> None:
    with pytest.raises(InvalidInput, match="no decision"):
        score([])
    with pytest.raises(InvalidInput, match="no error"):
        consistency([], is_planar=True)


def test_wilson_interval() -> None:
    """8 of 10, and nothing of 10, as tables have them."""
    assert wilson_interval(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)


def test_an_error_by_hand() -> None:
    """2 sigma forwards, 1 sigma in heading, nothing sideways: (4 + 1 + 0) / 3."""
    covariance = planar_covariance(np.diag([1.0, 1.0, 0.01**2, 0.1**2, 0.2**2, 1.0]))
    belief = GaussianPose(planar_pose(3.0, -1.0, 2.0), covariance)
    truth = belief.mean @ exp(np.array([0.0, 0.0, 0.01, 0.2, 0.0, 0.0]))
    assert normalised_error(belief, truth, is_planar=True) == pytest.approx(5.0 / 3.0)


@pytest.mark.parametrize(("is_planar", "freedom"), [(True, 3), (False, 6)])
def test_honest_covariances_are_found_honest_and_halved_deviations_four_times_worse(
    *, is_planar: bool, freedom: int
) -> None:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(6, 6)) * 0.02
    covariance = root @ root.T + 1e-6 * np.eye(6)
    if is_planar:
        covariance = planar_covariance(covariance, off_plane_sigma=1e-9)
    noise = rng.multivariate_normal(np.zeros(6), covariance, size=5_000)
    mean = planar_pose(1.0, 2.0, 3.0)
    honest, bold = (
        consistency(
            [
                normalised_error(
                    GaussianPose(mean, factor * covariance), mean @ one, is_planar=is_planar
                )
                for one in exp(noise)
            ],
            is_planar=is_planar,
        )
        for factor in (1.0, 0.25)
    )
    assert honest.count == 5_000
    # Standard deviations of mean and coverage over so many samples: 0.012 and 0.003.
    assert honest.mean == pytest.approx(1.0, abs=0.05)
    assert honest.median == pytest.approx(1.0, abs=0.07)
    assert honest.coverage == pytest.approx(0.95, abs=0.012)
    assert bold.mean == pytest.approx(4.0 * honest.mean)
    assert bold.median == pytest.approx(4.0 * honest.median)
    bound = {3: 7.8147, 6: 12.5916}[freedom]
    within = np.mean(np.sum(rng.normal(size=(100_000, freedom)) ** 2, axis=1) <= bound / 4.0)
    assert bold.coverage == pytest.approx(within, abs=0.03)


def test_outliers_move_the_mean_but_not_the_median() -> None:
    errors = [0.7887] * 9 + [1000.0]  # the median of chi-squared over 3 is 0.7887
    found = consistency(errors, is_planar=True)
    assert found.median == pytest.approx(1.0, abs=1e-3)
    assert found.mean > 100.0
    assert found.coverage == pytest.approx(0.9)
    assert math.isfinite(found.mean)
