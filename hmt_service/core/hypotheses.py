"""The particle layer: topological hypotheses, each with its own graph and its own probability.

A particle *is* a hypothesis: metric poses are Gaussian inside it (marginalised analytically), so no
two particles are copies of each other, and resampling is needed only to bound their number.

References:
    Blanco et al. 2008, Eq. (6), (12)-(14).
    Fearnhead and Clifford, On-line inference for hidden Markov models via particle filters,
    JRSS-B 2003, section 4 (optimal resampling).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from hmt_service.core.alignment import SEPARATION_M, SEPARATION_RAD
from hmt_service.core.awakening import is_anywhere, put_down
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    apart,
    certain,
    identity,
    inverse,
)
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.submap import Visit
from hmt_service.core.types import Belief, DropReason, HypothesisSummary, Localization

SAME_AREA = 2.0 / 3.0
"""A visit was to an area, and did not only see into it, if the area explains so much of it."""
# Maps that differ by no more than this anywhere are the same.
_EQUAL_M, _EQUAL_RAD = 0.1, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Assignment:
    """Which area one visit was to, says a hypothesis."""

    visit: int
    """The visit."""
    area: int
    """The area: the visit that founded it."""
    area_from_visit: GaussianPose | None
    """Alignment with the founding visit; None when this visit founded the area."""
    is_carried: bool = False
    """Whether the robot was carried there: the motion since the visit before says nothing."""


@dataclass(frozen=True, eq=False)
class Topology:
    """Which area every visit was to; immutable, so that what follows from it is found once."""

    assignments: tuple[Assignment, ...]
    """One per visit, in time order: the topological path."""

    @cached_property
    def path(self) -> tuple[int, ...]:
        """Areas in the order that they were entered."""
        areas = [assignment.area for assignment in self.assignments]
        return tuple(area for i, area in enumerate(areas) if i == 0 or areas[i - 1] != area)

    @cached_property
    def areas(self) -> tuple[int, ...]:
        """All areas, in the order of their identifiers."""
        return tuple(a.area for a in self.assignments if a.area_from_visit is None)

    @cached_property
    def arcs(self) -> int:
        """Number of pairs of areas that the robot has gone between directly."""
        return len({frozenset(pair) for pair in pairwise(self.path)})

    @cached_property
    def last_return(self) -> int | None:
        """The latest visit to an area that was there before; None if there is none."""
        returns = (a.visit for a in reversed(self.assignments) if a.area_from_visit is not None)
        return next(returns, None)

    @cached_property
    def visits_to(self) -> Mapping[int, tuple[int, ...]]:
        """Visits to each area, in time order."""
        visits: dict[int, list[int]] = {}
        for assignment in self.assignments:
            visits.setdefault(assignment.area, []).append(assignment.visit)
        return {area: tuple(each) for area, each in visits.items()}

    def with_visit(self, assignment: Assignment) -> Topology:
        """Return this topology with one more visit, or with another place for the last one."""
        return Topology((*self.assignments[: assignment.visit], assignment))


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What a statement about the map did to a hypothesis."""

    statement: int
    """Identifier of the statement."""
    family: int
    """The hypothesis that heard it, and became one where it is right and one where it is wrong."""
    factor: Factor | None
    """The arc that it added; None where it is wrong."""
    log_factor: float
    """By how much it moved the log weight, before all were normalised."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One topology of everything that the robot has travelled."""

    hypothesis: int
    """Identifier, unique in a run."""
    log_weight: float
    """Log of the posterior mass."""
    topology: Topology
    """What it says of all visits."""
    graph: PoseGraph
    """The metric graph that follows from it; owned, solved on demand."""
    unlikely_for: int = 0
    """Number of areas entered since it was likely."""
    sees: int | None = None
    """Older area that the visit, to a new one, sees into."""
    is_found: bool = False
    """Whether nothing but what the robot has seen says where in the map it is since it was lost."""
    look_alike_share: float = 0.0
    """Prior probability that a last visit to a new area is to one that looks like a known one."""
    log_unlike: float | None = None
    """Log of the probability that the last visit, to a new area, is to one that looks like nothing
    that is known; None if nobody has looked."""
    told: tuple[Told, ...] = ()
    """What somebody has said of the map, and that it is right or wrong."""

    @property
    def current(self) -> Assignment:
        """The assignment of the visit that the robot is on."""
        return self.topology.assignments[-1]

    @property
    def is_placed(self) -> bool:
        """Whether it is known where the robot is beside the first area."""
        graph = self.graph
        return graph.is_whole or not is_anywhere(graph.relative(0, self.current.visit))

    def area_from_visit(self, visit: int) -> GaussianPose:
        """Return the pose of a visit's frame in its area, with its own graph's covariance."""
        area = self.topology.assignments[visit].area
        if area == visit:
            return certain(identity())
        return self.graph.relative(area, visit)

    def keyframe_poses(self, visits: Iterable[Visit]) -> FloatArray:
        """Return the poses of all keyframes of visits in the first area's frame, (K, 4, 4)."""
        placed = self.graph.poses()
        return np.concatenate(
            [
                placed[visit.visit] @ np.array([pose.mean for pose in visit.visit_from_keyframe])
                for visit in visits
            ]
        )

    def extended(
        self,
        assignment: Assignment,
        arc: Factor,
        *,
        hypothesis: int,
        log_weight: float,
    ) -> Hypothesis:
        """Return a successor that has entered one more area.

        Args:
            assignment: Where the new visit is.
            arc: Motion from the visit before to the new one; says nothing if the robot was carried.
            hypothesis: Identifier of the successor.
            log_weight: Its log weight, not normalised.
        """
        graph, place = self.graph.copy(), assignment.area_from_visit
        if assignment.is_carried:
            arc = put_down(arc, is_planar=graph.is_planar)
        arcs = [arc]
        if place is not None:
            arcs.append(Factor(assignment.area, assignment.visit, place))
        # The first arc places the visit: a motion that says nothing comes last.
        for each in sorted(arcs, key=lambda factor: is_anywhere(factor.a_from_b)):
            graph.fuse_factor(each)
        topology = self.topology.with_visit(assignment)
        return Hypothesis(
            hypothesis,
            log_weight,
            topology,
            graph,
            self.unlikely_for,
            is_found=self.is_found,
            told=self.told,
        )

    def recognising(
        self,
        area: int,
        area_from_visit: GaussianPose,
        *,
        is_same_area: bool,
        is_found: bool,
        hypothesis: int,
        log_weight: float,
    ) -> Hypothesis:
        """Return a successor whose last visit, to a new area, saw what an older area has seen.

        Args:
            area: The older area.
            area_from_visit: Where the visit is in it.
            is_same_area: Whether the visit was to that area, and not to one that sees into it.
            is_found: Whether nothing but what it saw says so, if that was not so before.
            hypothesis: Identifier of the successor.
            log_weight: Its log weight, not normalised.
        """
        visit, topology = self.current.visit, self.topology
        graph = self.graph.joined(Factor(area, visit, area_from_visit))
        if is_same_area:
            assignment = replace(self.current, area=area, area_from_visit=area_from_visit)
            topology = topology.with_visit(assignment)
        sees = None if is_same_area else area
        return Hypothesis(
            hypothesis,
            log_weight,
            topology,
            graph,
            self.unlikely_for,
            sees,
            self.is_found or is_found,
            told=self.told,
        )

    def resembling(self, log_resemblance: float) -> Hypothesis:
        """Return this hypothesis if a last visit to a new area may be to one like those known.

        p(z | new) is that of the background only for some of the places that are new; others look
        like places that are known, and which of these the visit resembles is not yet known.

        Args:
            log_resemblance: Log of the sum of p(z | x) / p0(z), for all of the visit, over those of
                the places that it may look like that have not been thought of before, each times
                its share of them.
        """
        # Who has been found compares known areas with new ones as anybody does.
        if self.is_found or self.current.area != self.current.visit or self.sees is not None:
            return self
        log_plain, share = self.log_weight_of_unlike, self.look_alike_share
        log_unlike = log_plain + math.log1p(-share)
        log_before = log_unlike if self.log_unlike is None else self.log_weight
        log_like = math.log(share) + log_resemblance if share > 0.0 else -math.inf
        log_weight = float(np.logaddexp(log_before, log_plain + log_like))
        return replace(self, log_weight=log_weight, log_unlike=log_unlike - log_weight)

    @property
    def log_weight_of_unlike(self) -> float:
        """The log weight if new places looked like nothing that is known."""
        if self.log_unlike is None:
            return self.log_weight
        return self.log_weight + self.log_unlike - math.log1p(-self.look_alike_share)

    def log_likelihood_of_like(self, log_likelihood: float) -> float:
        """Return log p(z) / p0(z) of a new area.

        Args:
            log_likelihood: The same of the known areas that it may look like.
        """
        if self.log_unlike is None:
            return 0.0
        like = -math.expm1(self.log_unlike)
        log_like = math.log(like) if like > 0.0 else -math.inf
        return float(np.logaddexp(self.log_unlike, log_like + log_likelihood))

    def weighed(self, log_likelihood: float) -> Hypothesis:
        """Return this hypothesis after an observation; a negative one takes it back."""
        log_unlike = self.log_unlike
        if log_unlike is not None:
            # What speaks for it was predicted by the places that it looks like, and by no others.
            log_unlike = min(log_unlike - log_likelihood, 0.0)
        return replace(self, log_weight=self.log_weight + log_likelihood, log_unlike=log_unlike)

    def without(self, visit: int) -> Hypothesis:
        """Return this hypothesis with what a visit says in the arcs of its area (section IV-D)."""
        graph = self.graph.copy()
        graph.eliminate(visit, self.topology.assignments[visit].area)
        return replace(self, graph=graph)

    def is_told_of(self, visit: int) -> bool:
        """Return whether somebody has stated an arc to a visit."""
        arcs = (told.factor for told in self.told if told.factor is not None)
        return any(visit in (arc.visit_a, arc.visit_b) for arc in arcs)

    def is_same_map(self, other: Hypothesis) -> bool:
        """Return whether the other has the same areas, and all visits where this one has them."""
        if self.topology.areas != other.topology.areas:
            return False
        own, theirs = self.graph.poses(), other.graph.poses()
        largest = np.abs(own - theirs).max(axis=0)
        return bool(largest[:3, 3].max() <= _EQUAL_M and largest[:3, :3].max() <= _EQUAL_RAD)

    def merged(self, other: Hypothesis) -> Hypothesis:
        """Return this hypothesis with the mass of another one that is the same map, too."""
        mass = float(np.logaddexp(self.log_weight, other.log_weight))
        log_unlike = None
        if self.log_unlike is not None and other.log_unlike is not None:
            unlike = self.log_weight + self.log_unlike, other.log_weight + other.log_unlike
            log_unlike = min(float(np.logaddexp(*unlike)) - mass, 0.0)
        return replace(self, log_weight=mass, log_unlike=log_unlike)

    def has_recognised(self, other: Hypothesis, area: int, area_from_visit: Pose) -> bool:
        """Return whether this is another hypothesis but that it ties the last visit there."""
        visit = self.current.visit
        if not self.graph.has_arc(area, visit):
            return False
        if self.topology.assignments[:visit] != other.topology.assignments[:visit]:
            return False
        placed = inverse(self.graph.pose(area)) @ self.graph.pose(visit)
        apart_m, apart_rad = apart(area_from_visit, placed)
        return apart_m <= SEPARATION_M and apart_rad <= SEPARATION_RAD


@dataclass(frozen=True, slots=True)
class Dropped:
    """A hypothesis that is no longer followed."""

    hypothesis: int
    """Its identifier."""
    area: int
    """Where the robot was, said it."""
    log_weight: float
    """Log of its last posterior mass."""
    reason: DropReason
    """Why."""
    limit: float
    """The number that it did not meet: a mass, the budget, a number of areas; of the same map the
    identifier of the other one."""


class ParticleLayer:
    """The set of hypotheses and their weights."""

    def __init__(self, *, budget: int, negligible_mass: float, rng: np.random.Generator) -> None:
        """Start without a hypothesis.

        Args:
            budget: Most hypotheses kept.
            negligible_mass: Posterior mass below which one is dropped.
            rng: Source of all randomness of the resampling.
        """
        self._budget = budget
        self._negligible_mass = negligible_mass
        self._rng = rng
        self._hypotheses: tuple[Hypothesis, ...] = ()
        self._dropped: list[Dropped] = []

    @property
    def hypotheses(self) -> tuple[Hypothesis, ...]:
        """All hypotheses, the most probable first."""
        return self._hypotheses

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self._hypotheses[0]

    @property
    def probabilities(self) -> FloatArray:
        """Posterior mass of each hypothesis, Eq. (14), shape (H,)."""
        return np.exp([hypothesis.log_weight for hypothesis in self._hypotheses])

    @property
    def effective_sample_size(self) -> float:
        """1 / sum of squared weights, in [1, H]."""
        return float(1.0 / np.sum(self.probabilities**2))

    def current_area(self) -> dict[int, float]:
        """Return the marginal probability of the robot's current area."""
        marginal: dict[int, float] = {}
        for hypothesis, probability in zip(self._hypotheses, self.probabilities, strict=True):
            area = hypothesis.current.area
            marginal[area] = marginal.get(area, 0.0) + float(probability)
        return marginal

    def localization(self, stamp_s: float, evidence_stamp_s: float | None) -> Localization:
        """Return how sure it is where in the map the robot is.

        Args:
            stamp_s: Sensor time of the last observation.
            evidence_stamp_s: Sensor time when it was last where it had been before.
        """
        marginal, area = self.current_area(), self.best.current.area
        placed = sum(
            probability
            for hypothesis, probability in zip(self._hypotheses, self.probabilities, strict=True)
            if hypothesis.current.area == area and hypothesis.is_placed
        )
        # None is -0.0, or a rounding error above 1.
        entropy_nat = max(0.0, -sum(p * math.log(p) for p in marginal.values() if p > 0.0))
        return Localization(stamp_s, min(float(placed), 1.0), entropy_nat, evidence_stamp_s)

    def belief(self, stamp_s: float) -> Belief:
        """Return what is believed of where the robot is.

        Args:
            stamp_s: Sensor time of the last observation.
        """
        likely = zip(self._hypotheses, self.probabilities, strict=True)
        masses = {h.hypothesis: float(probability) for h, probability in likely}
        return Belief(stamp_s, self.current_area(), self.effective_sample_size, masses)

    def take_dropped(self) -> tuple[Dropped, ...]:
        """Return, once, the hypotheses that are no longer followed, in the order of their end."""
        dropped, self._dropped = tuple(self._dropped), []
        return dropped

    def replace(self, hypotheses: Sequence[Hypothesis]) -> None:
        """Take a new set, normalise it, drop what is negligible and resample down to the budget.

        Args:
            hypotheses: At least one, with log weights of any common scale.
        """
        given = _normalised(hypotheses)
        kept = [h for h in given if np.exp(h.log_weight) >= self._negligible_mass]
        self._drop(given, kept, DropReason.NEGLIGIBLE, self._negligible_mass)
        if len(kept) > self._budget:
            several = kept
            weights = np.exp([h.log_weight for h in kept])
            weights /= weights.sum()
            # Who may keep only one wants the best, not a fair draw.
            best = [(int(np.argmax(weights)), 1.0)]
            is_drawn = self._budget > 1
            survivors = optimal_resampling(weights, self._budget, self._rng) if is_drawn else best
            kept = [replace(kept[i], log_weight=float(np.log(weight))) for i, weight in survivors]
            self._drop(several, kept, DropReason.RESAMPLED, self._budget)
        self._hypotheses = tuple(
            sorted(_normalised(kept), key=lambda h: (-h.log_weight, h.hypothesis))
        )

    def _drop(
        self,
        before: Iterable[Hypothesis],
        kept: Iterable[Hypothesis],
        reason: DropReason,
        limit: float,
    ) -> None:
        left = {h.hypothesis for h in kept}
        self._dropped += [
            Dropped(h.hypothesis, h.current.area, h.log_weight, reason, limit)
            for h in before
            if h.hypothesis not in left
        ]

    def reweight(self, log_likelihood: Callable[[Hypothesis], float]) -> None:
        """Multiply each weight by the predictive likelihood of an observation; see `replace`."""
        self.replace([h.weighed(log_likelihood(h)) for h in self._hypotheses])

    def merge(self) -> None:
        """Keep one of hypotheses that differ only in the name of a place, with the mass of all.

        A visit on the border of two areas may be said to be to either. Where all areas and all
        poses are the same, that is no difference in the world.
        """
        kept: list[Hypothesis] = []
        for hypothesis in self._hypotheses:
            index = next((i for i, h in enumerate(kept) if h.is_same_map(hypothesis)), None)
            if index is None:
                kept.append(hypothesis)
                continue
            self._drop([hypothesis], [], DropReason.SAME_MAP, kept[index].hypothesis)
            kept[index] = kept[index].merged(hypothesis)
        self.replace(kept)

    def forget(self, *, unlikely_mass: float, patience: int) -> None:
        """Drop what has been unlikely for long; to be called once per area entered.

        Args:
            unlikely_mass: Posterior mass below which a hypothesis is unlikely.
            patience: Number of areas for which it may be.
        """
        aged = [
            replace(h, unlikely_for=h.unlikely_for + 1 if probability < unlikely_mass else 0)
            for h, probability in zip(self._hypotheses, self.probabilities, strict=True)
        ]
        kept = [h for h in aged if h.unlikely_for <= patience]
        self._drop(aged, kept, DropReason.UNLIKELY, patience)
        self.replace(kept)

    def summaries(self) -> tuple[HypothesisSummary, ...]:
        """Return what readers may know of each hypothesis, the most probable first."""
        return tuple(
            HypothesisSummary(
                hypothesis=h.hypothesis,
                probability=float(probability),
                current_area=h.current.area,
                topological_path=h.topology.path,
                areas=len(h.topology.areas),
                loop_closures=len(h.topology.assignments) - len(h.topology.areas),
                arcs=h.topology.arcs,
            )
            for h, probability in zip(self._hypotheses, self.probabilities, strict=True)
        )


def _normalised(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    log_weights = np.array([h.log_weight for h in hypotheses])
    total = np.logaddexp.reduce(log_weights)
    return [replace(h, log_weight=float(h.log_weight - total)) for h in hypotheses]


def optimal_resampling(
    weights: FloatArray, budget: int, rng: np.random.Generator
) -> list[tuple[int, float]]:
    """Return which particles survive, and their weights; unbiased, and exact for heavy ones.

    Args:
        weights: Normalised weights, shape (N,), N > budget.
        budget: Number of survivors.
        rng: Source of the one random number that is drawn.

    Returns:
        Index and new weight of each survivor, in the order of the indices; weights sum to one in
        expectation.
    """
    threshold = _threshold(weights, budget)
    is_heavy = weights >= threshold
    survivors = [(int(i), float(weights[i])) for i in np.flatnonzero(is_heavy)]
    light = np.flatnonzero(~is_heavy)
    # Stratified: a comb of equal teeth over the light particles, shifted by one random number.
    position = rng.uniform(0.0, threshold)
    cumulative = 0.0
    for i in light:
        cumulative += float(weights[i])
        if cumulative > position:
            survivors.append((int(i), float(threshold)))
            position += threshold
    return sorted(survivors)


def _threshold(weights: FloatArray, budget: int) -> float:
    """Return 1/c with sum(min(c * w, 1)) = budget."""
    descending = np.sort(weights)[::-1]
    tails = descending.sum() - np.concatenate([[0.0], np.cumsum(descending)[:-1]])
    for heavy in range(budget):
        threshold = tails[heavy] / (budget - heavy)
        if descending[heavy] < threshold:
            return float(threshold)
    return float(descending[budget - 1])
