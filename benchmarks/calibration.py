"""How well probabilities are earned: proper scores, reliability, and normalised errors of poses.

References:
    Brier, Verification of forecasts expressed in terms of probability, 1950.
    Naeini et al., Obtaining well calibrated probabilities using Bayesian binning, AAAI 2015 (ECE).
    Wilson, Probable inference, the law of succession, and statistical inference, JASA 1927.
    Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4
    (NEES).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from benchmarks.metric import Direction, Metric
from benchmarks.scoring import Decision
from hmt_service.core.geometry import PLANAR_AXES, GaussianPose, Pose, inverse, log
from hmt_service.errors import InvalidInput

BINS = 10
"""Equal bins of confidence."""
LEAST_PROBABILITY = 1e-6
"""What the logarithmic score takes for a probability of zero: no belief costs more than 13.8."""
_CERTAIN = 0.99
_MEDIAN_TOLERANCE = 0.5
_Z_95 = 1.959964


@dataclass(frozen=True, slots=True)
class Bin:
    """Decisions of about the same confidence."""

    count: int
    """How many."""
    confidence: float
    """Mean probability of the option that was believed most."""
    right: int
    """How often that option was right."""


@dataclass(frozen=True, slots=True)
class Scores:
    """What a set of decisions is worth."""

    decisions: int
    """How many."""
    brier: float
    """Mean Brier score in [0, 1]; lower is better."""
    log_loss: float
    """Mean negative log probability of what is right, nats; lower is better."""
    expected_calibration_error: float
    """Mean difference of confidence and frequency over the bins, weighted by their counts; 0 where
    there are none."""
    bins: tuple[Bin, ...]
    """The bins that hold any decision with one answer, by confidence."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """Errors of some poses, each normalised by its own covariance."""

    count: int
    """How many."""
    mean: float
    """Mean of the squared errors per degree of freedom; 1 is honest, more is over-confident."""
    median: float
    """Their median over that of the chi-squared distribution; 1 is honest, outliers aside."""
    coverage: float
    """Share within the 95 % bound of the chi-squared distribution; 0.95 is honest."""


def brier(decision: Decision) -> float:
    """Return half the squared distance of the probabilities from what is true, in [0, 1].

    All options that are right are one; an option that is missing has probability 0. With two
    options it is the square of what is not given to the right one, as in a forecast of rain.
    Proper: nobody can score better by saying something else than he believes.
    """
    wrong = sum(option.probability**2 for option in decision.options if not option.is_right)
    return 0.5 * ((1.0 - probability_right(decision)) ** 2 + wrong)


def log_loss(decision: Decision) -> float:
    """Return the negative log of what is given to the right options, in [0, 13.8] nats."""
    return -math.log(min(max(probability_right(decision), LEAST_PROBABILITY), 1.0))


def probability_right(decision: Decision) -> float:
    """Return the mass of all options that are right."""
    return sum(option.probability for option in decision.options if option.is_right)


def is_contested(decision: Decision) -> bool:
    """Return whether there was anything to decide.

    There was unless the visit went on into the unknown, and that was believed with more than 0.99.
    """
    top = decision.options[0]
    return decision.is_return or top.is_known or top.probability <= _CERTAIN


def has_one_answer(decision: Decision) -> bool:
    """Return whether no two options are right: where two are, neither can be too firmly believed.

    Such decisions cost nothing in the scores and say nothing about calibration.
    """
    return sum(option.is_right for option in decision.options) <= 1


def score(decisions: Sequence[Decision]) -> Scores:
    """Return what decisions are worth.

    Raises:
        InvalidInput: If there are none.
    """
    if not decisions:
        raise InvalidInput("no decision to score")
    tops = [decision.options[0] for decision in decisions if has_one_answer(decision)]
    bins = reliability([top.probability for top in tops], [top.is_right for top in tops])
    gap = sum(abs(one.right - one.count * one.confidence) for one in bins)
    return Scores(
        decisions=len(decisions),
        brier=float(np.mean([brier(decision) for decision in decisions])),
        log_loss=float(np.mean([log_loss(decision) for decision in decisions])),
        expected_calibration_error=gap / max(len(tops), 1),
        bins=bins,
    )


def reliability(confidences: Sequence[float], is_right: Sequence[bool]) -> tuple[Bin, ...]:
    """Return how often what was believed was right, by how firmly it was believed.

    Args:
        confidences: Probabilities in [0, 1].
        is_right: Whether each turned out to be right.

    Returns:
        The bins that are not empty, by confidence; a bin holds its upper edge only if that is 1.
    """
    confidence, right = np.array(confidences), np.array(is_right, dtype=bool)
    which = np.minimum((confidence * BINS).astype(np.int64), BINS - 1)
    return tuple(
        Bin(
            count=int(np.sum(which == index)),
            confidence=float(confidence[which == index].mean()),
            right=int(np.sum(right[which == index])),
        )
        for index in np.unique(which)
    )


def wilson_interval(right: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a probability, of which `right` in `count` trials were seen."""
    share, z2 = right / count, _Z_95**2
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = _Z_95 * math.sqrt(share * (1 - share) / count + z2 / (4 * count**2)) / (1 + z2 / count)
    return max(middle - half, 0.0), min(middle + half, 1.0)


def normalised_error(belief: GaussianPose, truth: Pose, *, is_planar: bool) -> float:
    """Return the squared error of a pose, normalised by its covariance, per degree of freedom."""
    axes = PLANAR_AXES if is_planar else np.arange(6)
    gap = log(inverse(belief.mean) @ truth)[axes]
    return float(gap @ np.linalg.solve(belief.covariance[np.ix_(axes, axes)], gap)) / len(axes)


def consistency(errors: Sequence[float], *, is_planar: bool) -> Consistency:
    """Return how honest the covariances of some poses are.

    Args:
        errors: What `normalised_error` said of each.
        is_planar: Whether they have three degrees of freedom or six.

    Raises:
        InvalidInput: If there are none.
    """
    if not errors:
        raise InvalidInput("no error to summarise")
    freedom = len(PLANAR_AXES) if is_planar else 6
    return Consistency(
        count=len(errors),
        mean=float(np.mean(errors)),
        median=float(np.median(errors) * freedom / chi2.median(freedom)),
        coverage=float(np.mean(np.array(errors) * freedom <= chi2.ppf(0.95, freedom))),
    )


def consistency_metrics(
    name: str, errors: Sequence[float], *, is_planar: bool, coverage_tolerance: float
) -> Iterator[Metric]:
    """Yield how consistent errors are as metrics.

    Args:
        name: What they were measured on.
        errors: As of `normalised_error`.
        is_planar: Whether they have three degrees of freedom or six.
        coverage_tolerance: Share by which the coverage may fall before the gate says so.
    """
    found = consistency(errors, is_planar=is_planar)
    lower, higher = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER
    yield Metric(f"{name}/count", float(found.count), "1", higher, None)
    yield Metric(f"{name}/mean", found.mean, "1", lower, None)
    yield Metric(f"{name}/median", found.median, "1", lower, _MEDIAN_TOLERANCE)
    yield Metric(f"{name}/coverage", found.coverage, "1", higher, coverage_tolerance)
