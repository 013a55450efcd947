"""Testimony: what somebody who has seen the site says of two areas is evidence like any other.

A statement is right with the probability that it is made with, and then as good as its covariance
says. Otherwise its author has drawn it from what the map looks like, or from anywhere: half of what
is said wrong is plausible, so that nothing is believed more than its author does. Every hypothesis
becomes two, weighed by how well it predicted the statement; it can be taken back.

References:
    Blanco et al. 2008, Eq. (6) and (14) (what weighs hypotheses).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import (
    ANY_HEADING_RAD,
    PLANAR_AXES,
    GaussianPose,
    apart,
    confined,
    inverse,
    project_planar,
)
from hmt_service.core.graph import Factor
from hmt_service.core.hypotheses import Hypothesis, Told
from hmt_service.core.types import HypothesisEffect
from hmt_service.errors import InvalidInput

# What a person may say, and how well: nobody knows a building to less than a tenth of a millimetre.
_LEAST_M, _MOST_M, _LEAST_RAD = 1e-4, 1e3, 1e-5
_FARTHEST_M = 1e4
# Beyond what was seen a wrong statement is not made: m around it, and how much a robot leans.
_MARGIN_M = 10.0
_LEAN_RAD = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Statement:
    """Two areas are where somebody says, beside each other."""

    statement: int
    """Identifier, unique in a run."""
    area_a: int
    """One of them."""
    area_b: int
    """The other one."""
    a_from_b: GaussianPose
    """Pose of the second in the first, as well as it is known if it is right."""
    probability: float
    """How probably it is right, in (0, 1)."""

    @classmethod
    def of(
        cls,
        statement: int,
        area_a: int,
        area_b: int,
        a_from_b: GaussianPose,
        probability: float,
        *,
        is_planar: bool,
    ) -> Statement:
        """Return a statement about a map that may be planar.

        Raises:
            InvalidInput: If it is about the same area twice, or a number is out of range.
        """
        if area_a == area_b:
            raise InvalidInput(f"area {area_a} twice: an arc joins two areas")
        if not 0.0 < probability < 1.0:
            raise InvalidInput(f"probability {probability:g} is not in (0, 1)")
        axes = PLANAR_AXES if is_planar else np.arange(6)
        sigmas, is_angle = np.sqrt(np.diag(a_from_b.covariance))[axes], axes < 3
        least = np.where(is_angle, _LEAST_RAD, _LEAST_M)
        most = np.where(is_angle, ANY_HEADING_RAD, _MOST_M)
        if not np.all((least <= sigmas) & (sigmas <= most)):
            raise InvalidInput(
                f"standard deviations of {sigmas[is_angle]} rad and {sigmas[~is_angle]} m are not "
                f"in [{_LEAST_RAD:g}, {ANY_HEADING_RAD:.3f}] rad and [{_LEAST_M:g}, {_MOST_M:g}] m"
            )
        if not np.all(np.abs(a_from_b.mean[:3, 3]) <= _FARTHEST_M):
            raise InvalidInput(f"position {a_from_b.mean[:3, 3]} m is over {_FARTHEST_M:g} m away")
        mean = project_planar(a_from_b.mean) if is_planar else a_from_b.mean
        said = GaussianPose(mean, confined(a_from_b.covariance, is_planar=is_planar))
        return cls(statement, area_a, area_b, said, probability)


def hear(
    hypotheses: Sequence[Hypothesis], statement: Statement, new_identifier: Callable[[], int]
) -> list[tuple[Hypothesis, Hypothesis]]:
    """Return what every hypothesis becomes if a statement is right, and if it is wrong.

    Args:
        hypotheses: What is believed, the most probable first.
        statement: What is said of two areas that are known well in all of them.
        new_identifier: Returns one that was never used.

    Returns:
        Parent and child, with a weight that is not normalised; the one in which the statement is
        wrong is its parent still.
    """
    log_anywhere = -_log_volume_of(hypotheses[0])
    log_said = [_log_said(hypothesis, statement, log_anywhere) for hypothesis in hypotheses]
    log_weights = [hypothesis.log_weight for hypothesis in hypotheses]
    log_plausible = np.logaddexp.reduce(np.add(log_weights, log_said))
    log_plausible -= np.logaddexp.reduce(log_weights)
    log_wrong = math.log(0.5) + float(np.logaddexp(log_anywhere, log_plausible))
    factor = Factor(statement.area_a, statement.area_b, statement.a_from_b, statement.statement)
    expanded = []
    for hypothesis, log_right in zip(hypotheses, log_said, strict=True):
        right = replace(
            _told(hypothesis, statement, factor, math.log(statement.probability) + log_right),
            hypothesis=new_identifier(),
            graph=hypothesis.graph.joined(factor),
        )
        wrong = _told(hypothesis, statement, None, math.log1p(-statement.probability) + log_wrong)
        expanded += [(hypothesis, right), (hypothesis, wrong)]
    return expanded


def _told(
    hypothesis: Hypothesis, statement: Statement, factor: Factor | None, log_factor: float
) -> Hypothesis:
    told = Told(statement.statement, hypothesis.hypothesis, factor, log_factor)
    log_weight = hypothesis.log_weight + log_factor
    return replace(hypothesis, log_weight=log_weight, told=(*hypothesis.told, told))


def _log_said(hypothesis: Hypothesis, statement: Statement, log_anywhere: float) -> float:
    """Return the log of p(statement) if it is right: where a hypothesis knows nothing, anywhere."""
    predicted = _predicted(hypothesis, statement)
    if predicted is None:
        return log_anywhere
    axes = PLANAR_AXES if hypothesis.graph.is_planar else np.arange(6)
    return _log_density(statement.a_from_b, predicted, axes)


def _predicted(hypothesis: Hypothesis, statement: Statement) -> GaussianPose | None:
    """Return where a hypothesis has one area in the other; None if it knows nothing of that."""
    graph, area_a, area_b = hypothesis.graph, statement.area_a, statement.area_b
    return graph.relative(area_a, area_b) if area_b in graph.part_of(area_a) else None


def _log_volume_of(hypothesis: Hypothesis) -> float:
    """Return the log of the volume of what a wrong statement may say, m^2 rad or m^3 rad^3."""
    sides_m = np.ptp(hypothesis.graph.poses()[:, :3, 3], axis=0) + 2.0 * _MARGIN_M
    if hypothesis.graph.is_planar:
        return float(np.log(sides_m[0] * sides_m[1] * 2.0 * math.pi))
    return float(np.log(np.prod(sides_m) * 2.0 * math.pi * (2.0 * _LEAN_RAD) ** 2))


def unhear(
    hypotheses: Sequence[Hypothesis], statement: Statement
) -> list[tuple[Hypothesis, Hypothesis]]:
    """Return what is believed if a statement had not been made; what came of it since stays.

    Args:
        hypotheses: What is believed.
        statement: What was said.

    Returns:
        Each as it was, and as it is, with a weight that is not normalised.
    """
    found = [
        next((told for told in h.told if told.statement == statement.statement), None)
        for h in hypotheses
    ]
    sides = {(told.family, told.factor is None) for told in found if told is not None}
    return [
        (h, h if told is None else _untold(h, told, is_twin=_twin_of(told) in sides))
        for h, told in zip(hypotheses, found, strict=True)
    ]


def _twin_of(told: Told) -> tuple[int, bool]:
    return told.family, told.factor is not None


def _untold(hypothesis: Hypothesis, told: Told, *, is_twin: bool) -> Hypothesis:
    """Return a hypothesis without what it was told; of twins each gets half of what was one's."""
    log_weight = hypothesis.log_weight - told.log_factor - (math.log(2.0) if is_twin else 0.0)
    graph = hypothesis.graph if told.factor is None else hypothesis.graph.without(told.statement)
    rest = tuple(other for other in hypothesis.told if other is not told)
    return replace(hypothesis, log_weight=log_weight, graph=graph, told=rest)


def effects(
    before: Sequence[Hypothesis],
    expanded: Sequence[tuple[Hypothesis, Hypothesis]],
    statement: Statement,
    after: Mapping[int, float],
) -> tuple[HypothesisEffect, ...]:
    """Return what a statement did to each hypothesis, and why.

    Args:
        before: What was believed.
        expanded: What became of each, with its weight at that moment: parent, child.
        statement: What was said.
        after: Probabilities since, by hypothesis.
    """
    mass_of = {h.hypothesis: math.exp(h.log_weight) for h in before}
    return tuple(
        sorted(
            (_effect(parent, child, statement, mass_of, after) for parent, child in expanded),
            key=lambda effect: (-effect.after, effect.hypothesis),
        )
    )


def _effect(
    parent: Hypothesis,
    child: Hypothesis,
    statement: Statement,
    mass_of: Mapping[int, float],
    after: Mapping[int, float],
) -> HypothesisEffect:
    graph, said, predicted = parent.graph, statement.a_from_b, _predicted(parent, statement)
    placed = inverse(graph.pose(statement.area_a)) @ graph.pose(statement.area_b)
    apart_m, apart_rad = apart(said.mean, placed)
    return HypothesisEffect(
        hypothesis=child.hypothesis,
        parent=parent.hypothesis,
        is_right=any(
            told.statement == statement.statement and told.factor is not None
            for told in (*parent.told, *child.told)
        ),
        before=mass_of[parent.hypothesis],
        after=after.get(child.hypothesis, 0.0),
        apart_m=apart_m,
        apart_rad=apart_rad,
        distance=None if predicted is None else math.sqrt(said.disagreement2(predicted)),
    )


def _log_density(said: GaussianPose, predicted: GaussianPose, axes: npt.NDArray[np.intp]) -> float:
    """Return the log of p(said) where a pose is predicted, per m and rad of these axes."""
    covariance = said.covariance + predicted.covariance
    _, log_determinant = np.linalg.slogdet(2.0 * math.pi * covariance[np.ix_(axes, axes)])
    return -0.5 * (said.disagreement2(predicted) + float(log_determinant))
