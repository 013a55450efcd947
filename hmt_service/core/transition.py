"""TSBI: the topological transition model; where can the robot be, now that it has entered an area?

References:
    Blanco et al. 2008, Eq. (6) first step, section IV-A and Fig. 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hmt_service.core.alignment import Aligner, Mode
from hmt_service.core.awakening import anywhere_in, beside_keyframes, is_anywhere, put_down
from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    ANY_HEADING_RAD,
    PLANAR_AXES,
    FloatArray,
    GaussianPose,
    certain,
    exp,
    identity,
    inverse,
    log,
)
from hmt_service.core.graph import Factor
from hmt_service.core.hypotheses import Hypothesis
from hmt_service.core.observation import ObservationModel
from hmt_service.core.refinement import is_certain
from hmt_service.core.submap import Visit
from hmt_service.core.visits import Visits, gaps_m

# So many times as many areas are looked at as may be candidates.
_ASKED = 4


@dataclass(frozen=True, slots=True, eq=False)
class Successor:
    """One place that the robot may have entered."""

    area: int | None
    """A known area, or None for a new one."""
    area_from_visit: GaussianPose | None
    """Alignment with that area; None for a new one."""
    overlap: float
    """Share of what the visit saw that the area explains, in [0, 1]; 0 for a new one."""
    log_factor: float
    """Log of the probability of entering here times that of the observations, up to a constant."""
    is_carried: bool = False
    """Whether the robot was carried there: the motion since the visit before says nothing."""
    is_found: bool = False
    """Whether nothing leads there but what the visit saw."""
    look_alike_share: float = 0.0
    """Prior probability that a new area looks like a known one."""


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where a visit may be."""

    successors: tuple[Successor, ...]
    """One for each place."""
    log_searched: float = -math.inf
    """Log of the prior probability of all places that were searched although nothing leads there,
    in the unit of the successors' factors."""

    @property
    def is_searched(self) -> bool:
        """Whether any was."""
        return self.log_searched > -math.inf

    def log_resemblance(self, successors: Iterable[Successor]) -> float:
        """Return how well places explain the visit that were searched although nothing leads there.

        Args:
            successors: Those that count; a place that was searched and is not among them is one
                that does not explain the visit.

        Returns:
            Log of the sum of p(z | x) / p0(z), each times its share of all that were searched.
        """
        told = [successor.log_factor for successor in successors if successor.is_found]
        return float(np.logaddexp.reduce(told, initial=-np.inf)) - self.log_searched


@dataclass(frozen=True, eq=False)
class _Question:
    """Where is a visit of which a motion is known?"""

    hypothesis: Hypothesis
    """What is believed of everything before."""
    visit: Visit
    known: int
    """The visit that the motion is from."""
    known_from_visit: GaussianPose
    visits: Visits
    is_carried: bool = False
    """Whether the robot was carried since then."""

    @property
    def is_open(self) -> bool:
        """Whether the motion says nothing."""
        return is_anywhere(self.known_from_visit)

    @property
    def is_heading_known(self) -> bool:
        """Whether the motion says more than how far the robot may have come."""
        return bool(self.known_from_visit.sigma_rad < ANY_HEADING_RAD)

    @cached_property
    def part(self) -> frozenset[int]:
        """Visits whose place beside the visit follows from the motion."""
        return frozenset() if self.is_open else self.hypothesis.graph.part_of(self.known)

    @property
    def is_carried_here(self) -> bool:
        """Whether it was carried to this part of the map: from nearby, not across a whole site."""
        assignments = self.hypothesis.topology.assignments
        return self.is_carried or (bool(self.part) and assignments[min(self.part)].is_carried)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    area: int
    area_from_visit: GaussianPose
    """Prior of the pose, or what it is within."""
    parts: tuple[GaussianPose, ...] = ()
    """What the prior consists of, in equal shares and equally wide, if that is not one Gaussian."""
    mass: float = 1.0
    """Prior probability of the area where it is not in the pose: nothing else says where it is."""


class Transition:
    """Expands a hypothesis into everything that the new visit can be."""

    def __init__(
        self,
        config: Config,
        aligner: Aligner,
        observation: ObservationModel,
        rng: np.random.Generator,
    ) -> None:
        """Build the model.

        Args:
            config: Settings of all stages.
            aligner: Finds the modes of a relative pose.
            observation: Likelihood of scans given a submap.
            rng: Source of the samples of the prior.
        """
        self._config = config.transition
        self._log_unlikely = math.log(config.particles.unlikely_mass)
        self._least_outside = 1.0 / (config.transition.prior_samples + 1)
        self._refinement = config.refinement
        self._beams = config.observation
        self._sigma_submap_m = config.covariance.sigma_submap_m
        self._gate_sigma = config.alignment.gate_sigma
        self._axes = PLANAR_AXES if config.sensor.is_planar else np.arange(6)
        self._aligner = aligner
        self._observation = observation
        self._rng = rng

    def successors(
        self, hypothesis: Hypothesis, visit: Visit, arc: Factor, visits: Visits
    ) -> Places:
        """Return every place that the new visit may be to.

        Args:
            hypothesis: What is believed of everything before.
            visit: The new visit, as far as it has been seen.
            arc: Motion from the visit before to the new one.
            visits: All closed visits.

        Returns:
            A new area first, then each mode of each known area; both again if the robot may have
            been carried.
        """
        moved = self._entries(hypothesis, visit, arc, visits)
        if visit.keyframes[0].failure is None or is_anywhere(arc.a_from_b):
            return moved
        log_share = math.log(self._config.carried_share)
        log_rest = math.log1p(-self._config.carried_share)
        nothing = put_down(arc, is_planar=hypothesis.graph.is_planar)
        carried = self._entries(hypothesis, visit, nothing, visits, is_carried=True)
        rest = (replace(s, log_factor=s.log_factor + log_rest) for s in moved.successors)
        share = (
            replace(s, log_factor=s.log_factor + log_share, is_carried=True)
            for s in carried.successors
        )
        log_searched = np.logaddexp(moved.log_searched + log_rest, carried.log_searched + log_share)
        return Places((*rest, *share), float(log_searched))

    def _entries(
        self,
        hypothesis: Hypothesis,
        visit: Visit,
        arc: Factor,
        visits: Visits,
        *,
        is_carried: bool = False,
    ) -> Places:
        """Return every place that the new visit may be to if the motion is to be believed."""
        where = _Question(hypothesis, visit, arc.visit_a, arc.a_from_b, visits, is_carried)
        candidates = self._candidates(where)
        outside = self._mass_outside(candidates, visit, visits)
        # Who wakes up is in the map or outside; who has been outside goes on there.
        new = outside * self._config.outside_share if where.is_open else outside
        found = self._found(where, new)
        matches = self._matches(visit, candidates, visits)
        # What is new where all is known has changed, and looks like no other place for that. Nor
        # does it if the heading is unknown: a bound of the motion alone favours what is far away.
        is_new_space = outside > self._least_outside and (where.is_open or where.is_heading_known)
        share = self._config.look_alike_share if is_new_space else 0.0
        successor = Successor(None, None, 0.0, float(np.log(new)), look_alike_share=share)
        return Places((successor, *matches, *found.successors), found.log_searched)

    def recognitions(self, hypothesis: Hypothesis, visit: Visit, visits: Visits) -> Places:
        """Return where else what a finished visit to a new area has seen may be in the map.

        Its beginning told nothing; now all of it is known, what was seen through doors included.
        Places that are known so well that refinement will tie them are not asked about.

        Args:
            hypothesis: What is believed, the visit included.
            visit: The visit.
            visits: All visits up to and including it.
        """
        if hypothesis.current.area_from_visit is not None:
            return Places(())
        where = _Question(hypothesis, visit, visit.visit, certain(identity()), visits)
        candidates = self._candidates(
            where, is_asked=lambda prior: not is_certain(prior, self._refinement)
        )
        matches, found = self._matches(visit, candidates, visits), self._found(where, 1.0)
        return Places((*matches, *found.successors), found.log_searched)

    def _found(self, where: _Question, outside: float) -> Places:
        """Return the places that nothing leads to but what the visit saw."""
        # A search of the map costs more than all else, and what is unlikely is soon forgotten.
        is_asked = where.hypothesis.log_weight >= self._log_unlikely
        candidates = self._anywhere(where, outside) if is_asked else []
        if not candidates:
            return Places(())
        matches = self._matches(where.visit, candidates, where.visits)
        return Places(
            tuple(replace(match, is_found=True) for match in matches),
            math.log(sum(candidate.mass for candidate in candidates)),
        )

    def _matches(
        self,
        visit: Visit,
        candidates: Sequence[_Candidate],
        visits: Visits,
    ) -> tuple[Successor, ...]:
        """Return each mode of each candidate, with the probability of what the visit saw there."""
        return tuple(
            Successor(
                candidate.area,
                mode.target_from_visit,
                mode.overlap,
                self._log_factor(visit, visits[candidate.area], candidate, mode),
            )
            for candidate in candidates
            for mode in self._aligner.modes(
                visit, visits[candidate.area], candidate.area_from_visit
            )
        )

    def _candidates(
        self, where: _Question, *, is_asked: Callable[[GaussianPose], bool] = lambda _: True
    ) -> list[_Candidate]:
        """Return the areas whose extent the prior reaches, the nearest first."""
        hypothesis, known, known_from_visit = where.hypothesis, where.known, where.known_from_visit
        most, graph, left = self._config.max_candidates, hypothesis.graph, self._left(where)
        areas = np.array([a for a in hypothesis.topology.areas if a != left and a in where.part])
        if not len(areas):
            return []
        extents = where.visits.extents(where.visit.visit)[areas]
        here = graph.pose(known) @ known_from_visit.mean
        margins = self._config.margin_share * extents[:, 4]
        distances = gaps_m(where.visit, here, graph.poses()[areas], extents) - margins
        result = []
        # How well a place is known is asked of the nearest only: it costs more than all else here.
        for index in np.argsort(distances, kind="stable")[: _ASKED * most]:
            area = int(areas[index])
            prior = graph.relative(area, known) @ known_from_visit
            if distances[index] <= self._gate_sigma * prior.sigma_m and is_asked(prior):
                result.append(_Candidate(area, prior))
                if len(result) == most:
                    break
        return result

    def _left(self, where: _Question) -> int | None:
        """Return the area that the visit is certainly not to: the robot has just left it.

        The visit before ended where its own content does; an older area may go on beyond that. Who
        is lost, or does not know how he went, may not have left at all.
        """
        known = where.known
        if known == where.visit.visit:
            return known
        is_lost = where.visit.keyframes[0].failure is not None
        is_known = not is_lost and is_certain(where.known_from_visit, self._refinement)
        return known if is_known and where.hypothesis.current.area == known else None

    def _anywhere(self, where: _Question, outside: float) -> list[_Candidate]:
        """Return the areas that the visit may be to because nobody knows where those are.

        A robot that wakes up is as likely beside one keyframe of the map as beside another, and may
        be outside of all.

        Args:
            where: What is asked.
            outside: Probability that it is in no area at all.
        """
        visits, share = where.visits, self._config.outside_share
        areas = [area for area in where.hypothesis.topology.areas if area not in where.part]
        most = self._config.max_carried_areas
        if where.is_carried_here and len(areas) > most:
            # Each is searched in every heading.
            positions = where.hypothesis.graph.poses()[:, :3, 3]
            away_m = np.linalg.norm(positions[areas] - positions[where.known], axis=1)
            areas = [areas[i] for i in np.sort(np.argsort(away_m, kind="stable")[:most])]
        keyframes = sum(visits.keyframes(area) for area in areas)
        inside = outside * (1.0 - share) / share
        return [
            _Candidate(
                area,
                anywhere_in(visits[area], where.visit, self._config.presence_m),
                beside_keyframes(visits[area], where.visit, self._config.presence_m),
                inside * visits.keyframes(area) / keyframes,
            )
            for area in areas
        ]

    def _mass_outside(
        self, candidates: list[_Candidate], visit: Visit, visits: Mapping[int, Visit]
    ) -> float:
        """Return the prior probability that the robot is in no known area, never quite 0 or 1."""
        samples = self._config.prior_samples
        body_in_visit = visit.visit_from_keyframe[-1].mean[:3, 3]
        inside = 0.0
        for candidate in candidates:
            prior = candidate.area_from_visit
            noise = self._rng.multivariate_normal(
                np.zeros(6), prior.covariance, size=samples, method="cholesky"
            )
            area_from_visit = prior.mean @ exp(noise)
            positions = area_from_visit[:, :3, :3] @ body_in_visit + area_from_visit[:, :3, 3]
            known = np.array([p.mean[:3, 3] for p in visits[candidate.area].visit_from_keyframe])
            distances = np.linalg.norm(positions[:, None] - known[None], axis=2).min(axis=1)
            inside += float(np.mean(distances <= self._config.presence_m))
        return float(np.clip(1.0 - inside, self._least_outside, 1.0 - self._least_outside))

    def _log_factor(self, visit: Visit, target: Visit, candidate: _Candidate, mode: Mode) -> float:
        """Return the log of the Laplace integral of prior times likelihood around one mode."""
        # The peak of prior times likelihood; along a corridor only the prior says where that is.
        peak = candidate.area_from_visit.fuse(mode.target_from_visit).mean
        poses = [peak @ pose.mean for pose in visit.visit_from_keyframe]
        log_ratio = sum(
            news.share
            * self._observation.log_ratio(news.keyframe, target.known_from(pose[:3, 3]), pose)
            for news, pose in zip(visit.news, poses, strict=True)
        )
        widening = self._widening(visit, mode)
        parts = candidate.parts or (candidate.area_from_visit,)
        return log_ratio + self._log_prior(parts, mode, widening) + math.log(candidate.mass)

    def _widening(self, visit: Visit, mode: Mode) -> float:
        """Return how much wider, as a variance, the likelihood is than the registration.

        The registration takes each point for an independent reading; the observation model knows
        better, and how far off a range may be.
        """
        readings = self._beams.independent_beams * sum(n.share for n in visit.news)
        wider = (self._beams.hit_sigma_m / self._sigma_submap_m) ** 2
        return max(1.0, mode.overlap * len(visit.sweep.points) / readings * wider)

    def _log_prior(self, parts: Sequence[GaussianPose], mode: Mode, widening: float) -> float:
        """Return log of N(x*; prior) times the volume of the mode.

        With a likelihood peak of shape N(x; x*, S), where x* is itself known with covariance B
        because submaps are bent, the integral over the prior N(x; m, P) is
        sqrt(|S| / |P + B + S|) exp(-1/2 (x* - m)' (P + B + S)^-1 (x* - m)) times its height. Of a
        prior that consists of several such it is the mean.
        """
        block, pose = np.ix_(self._axes, self._axes), mode.target_from_visit
        width = widening * mode.width[block]
        bend = pose.covariance[block] - mode.width[block]
        together: FloatArray = parts[0].covariance[block] + bend + width
        gaps = [log(inverse(part.mean) @ pose.mean)[self._axes] for part in parts]
        exponents = [-0.5 * gap @ np.linalg.solve(together, gap) for gap in gaps]
        _, log_volume = np.linalg.slogdet(width)
        _, log_prior_volume = np.linalg.slogdet(together)
        near = np.logaddexp.reduce(exponents) - math.log(len(parts))
        return float(0.5 * (log_volume - log_prior_volume) + near)
