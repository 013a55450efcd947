"""TSBI: the topological transition model; where can the robot be, now that it has entered an area?

References:
    Blanco et al. 2008, Eq. (6) first step, section IV-A and Fig. 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

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
# Who was there for more of a visit was in a known area.
_MOSTLY = 0.5
# Keyframes are so near each other that every third says where a path was.
_EVERY = 3


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

    def outside_before(self) -> FloatArray:
        """Return where the robot has just been outside all areas known by then, if it was.

        Returns:
            Some positions in the frame of the visit, shape (N, 3), m.
        """
        current = self.hypothesis.current
        is_asked = self.is_open or self.known == self.visit.visit
        if is_asked or current.area_from_visit is not None or current.visit != self.known:
            return np.zeros((0, 3))
        path = _path_of(self.visits[self.known])[::-_EVERY]
        visit_from_known = inverse(self.known_from_visit.mean)
        return path @ visit_from_known[:3, :3].T + visit_from_known[:3, 3]

    def paths_from(self, area: int, others: Sequence[int]) -> FloatArray:
        """Return where the robot has been in some areas, in the frame of one, shape (N, 3), m."""
        poses = self.hypothesis.graph.poses()
        paths = []
        for other in others:
            area_from_other = inverse(poses[area]) @ poses[other]
            path = _path_of(self.visits[other])
            paths.append(path @ area_from_other[:3, :3].T + area_from_other[:3, 3])
        return np.concatenate(paths)

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


def _path_of(visit: Visit) -> FloatArray:
    """Return where the robot has been in a visit, shape (K, 3), m."""
    return np.array([pose.mean[:3, 3] for pose in visit.visit_from_keyframe])


def _is_beside(
    poses: FloatArray, positions: FloatArray, path: FloatArray, reach_m: float
) -> npt.NDArray[np.bool_]:
    """Return whether positions, moved by poses, are near a path.

    Args:
        poses: Shape (S, 4, 4).
        positions: Shape (N, 3), m.
        path: Shape (K, 3), m.
        reach_m: How near.

    Returns:
        Shape (S, N).
    """
    moved = positions @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    distances, _ = cKDTree(path).query(moved, distance_upper_bound=reach_m)
    return np.asarray(distances <= reach_m)


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
        self._negligible = config.particles.negligible_mass
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
        masses = self._masses_inside(where, candidates)
        outside = self._clipped(1.0 - sum(masses))
        # Who wakes up is in the map or outside; who has been outside goes on there.
        new = outside * self._config.outside_share if where.is_open else outside
        found = self._found(where, new)
        likely = compress(candidates, [self._is_asked(where, mass) for mass in masses])
        matches = self._matches(visit, list(likely), visits)
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
        if not self._is_asked(where, 0.0):
            masses = self._masses_inside(where, candidates)
            asked = [self._is_asked(where, mass) for mass in masses]
            candidates = list(compress(candidates, asked))
        matches, found = self._matches(visit, candidates, visits), self._found(where, 1.0)
        return Places((*matches, *found.successors), found.log_searched)

    def _found(self, where: _Question, outside: float) -> Places:
        """Return the places that nothing leads to but what the visit saw."""
        odds = self._odds_inside(where)
        mass = math.exp(where.hypothesis.log_weight) * odds / (1.0 + odds)
        is_asked = mass >= self._config.searched_mass
        candidates = self._anywhere(where, outside * odds) if is_asked else []
        if not candidates:
            return Places(())
        matches = self._matches(where.visit, candidates, where.visits)
        return Places(
            tuple(replace(match, is_found=True) for match in matches),
            math.log(sum(candidate.mass for candidate in candidates)),
        )

    def _odds_inside(self, where: _Question) -> float:
        """Return how much more probable it is to be in what nothing leads to than outside.

        Each visit that was not recognised since the robot woke up, or was put down, makes it less
        probable that he has been there all the time.
        """
        share, asked = self._config.outside_share, int(where.known == where.visit.visit)
        missed = max(len(where.part) - asked, 0)
        return max((1.0 - share) / share * share**missed, share)

    def _is_asked(self, where: _Question, mass: float) -> bool:
        """Return whether a place is worth a look: none is whose mass is negligible from the start.

        Args:
            where: What is asked.
            mass: Probability that the robot is there, says the hypothesis.
        """
        at_least = max(mass, self._least_outside)
        return math.exp(where.hypothesis.log_weight) * at_least >= self._negligible

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

    def _anywhere(self, where: _Question, inside: float) -> list[_Candidate]:
        """Return the areas that the visit may be to because nobody knows where those are.

        A robot that wakes up is as likely beside one keyframe of the map as beside another, and may
        be outside of all.

        Args:
            where: What is asked.
            inside: Probability that it is in any of them.
        """
        visits = where.visits
        areas = [area for area in where.hypothesis.topology.areas if area not in where.part]
        most = self._config.max_carried_areas
        if where.is_carried_here and len(areas) > most:
            # Each is searched in every heading.
            positions = where.hypothesis.graph.poses()[:, :3, 3]
            away_m = np.linalg.norm(positions[areas] - positions[where.known], axis=1)
            areas = [areas[i] for i in np.sort(np.argsort(away_m, kind="stable")[:most])]
        keyframes = sum(visits.keyframes(area) for area in areas)
        return [
            _Candidate(
                area,
                anywhere_in(visits[area], where.visit, self._config.presence_m),
                beside_keyframes(visits[area], where.visit, self._config.presence_m),
                inside * visits.keyframes(area) / keyframes,
            )
            for area in areas
        ]

    def _clipped(self, probability: float) -> float:
        """Return a probability that is never quite 0 or 1: it comes from samples."""
        return min(max(probability, self._least_outside), 1.0 - self._least_outside)

    def _masses_inside(self, where: _Question, candidates: Sequence[_Candidate]) -> list[float]:
        """Return the prior probability that the robot is in each candidate.

        Who was outside until now has moved in only where the way there did: a place that he would
        have had to be in before, too, is none.
        """
        samples, presence_m = self._config.prior_samples, self._config.presence_m
        now = where.visit.visit_from_keyframe[-1].mean[:3, 3]
        others = [c.area for c in candidates if c.area != where.known]
        before = where.outside_before() if others else np.zeros((0, 3))
        inside = []
        for candidate in candidates:
            prior = candidate.area_from_visit
            noise = self._rng.multivariate_normal(
                np.zeros(6), prior.covariance, size=samples, method="cholesky"
            )
            area_from_visit = prior.mean @ exp(noise)
            area = where.visits[candidate.area]
            is_in = _is_beside(area_from_visit, now[None], _path_of(area), presence_m)[:, 0]
            was_out = np.ones(samples, dtype=bool)
            if len(before):
                paths = where.paths_from(candidate.area, others)
                was_in = _is_beside(area_from_visit, before, paths, presence_m)
                was_out = was_in.mean(axis=1) <= _MOSTLY
            inside.append(int(np.sum(is_in & was_out)) / max(int(np.sum(was_out)), 1))
        return inside

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
