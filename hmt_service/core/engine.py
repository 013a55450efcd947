"""The engine: keyframes become areas, areas become hypotheses, hypotheses become maps.

`Engine.process` is the paper's Fig. 8 without its threads: area abstraction, topological Bayesian
inference, weights, graph. It is a plain object without clock, thread, file or socket; the same
trackings and the same seed give the same map, bit for bit.

References:
    Blanco et al. 2008, section V and Fig. 8.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hmt_service.core import audit
from hmt_service.core.alignment import Aligner
from hmt_service.core.area_abstraction import overlap_of, partition
from hmt_service.core.audit import Audit
from hmt_service.core.awakening import awakened
from hmt_service.core.composition import arcs_of, compose_shortest_paths, residual_m
from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    inverse,
    log,
)
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import (
    SAME_AREA,
    Assignment,
    Hypothesis,
    ParticleLayer,
    Topology,
)
from hmt_service.core.kernels import compile_kernels
from hmt_service.core.observation import Look, ObservationModel
from hmt_service.core.plausibility import Plausibility
from hmt_service.core.refinement import Refinement
from hmt_service.core.smoothing import Smoother
from hmt_service.core.stored import ScanLog, StoredMap, StoredScan
from hmt_service.core.storing import (
    restored_hypothesis,
    restored_visits,
    stored_hypothesis,
    stored_visits,
)
from hmt_service.core.submap import News, Visit, as_points, visit_of
from hmt_service.core.testimony import Statement, effects, hear, unhear
from hmt_service.core.transition import Places, Successor, Transition
from hmt_service.core.types import (
    NO_POINTS,
    ArcResidual,
    AreaDetails,
    AreaDifference,
    AreaVisit,
    Comparison,
    Event,
    GlobalMap,
    Keyframe,
    MapMethod,
    PlacedArea,
    Points,
    Posterior,
    Registration,
    Snapshot,
    StampedPose,
    StatementEffect,
    Tracking,
    Trajectory,
)
from hmt_service.core.versions import NOTHING_KNOWN, recipe_of, version_of
from hmt_service.core.visits import MemoryBudget, MemoryUsage, Visits, share_new
from hmt_service.errors import InvalidInput, NotFound, Unavailable


class Engine:
    """Builds the hybrid metric-topological map from tracked scans."""

    def __init__(
        self, config: Config, *, seed: int = 0, budget: MemoryBudget | None = None
    ) -> None:
        """Start with an empty map.

        Args:
            config: Settings of all stages.
            seed: Seed of all randomness.
            budget: How much of the map may be in memory; None for all of it. The map is the same.
        """
        compile_kernels(config)
        self._config = config
        self._seed = seed
        rng = np.random.default_rng(seed)
        aligner = Aligner(config)
        self._plausibility = Plausibility(config.sensor)
        self._observation = ObservationModel(config.observation, config.sensor)
        self._transition = Transition(config, aligner, self._observation, rng)
        self._refinement = Refinement(config, aligner)
        self._smoother = Smoother(config)
        self._particles = ParticleLayer(
            budget=config.particles.budget,
            negligible_mass=config.particles.negligible_mass,
            rng=rng,
        )
        self._audit = Audit()
        self._visits = Visits(budget=budget)
        self._motions: list[Factor] = []
        self._scans = ScanLog()
        self._tracked: Counter[str] = Counter()
        self._weighed: dict[int, dict[int, float]] = {}
        self._doubted: list[int] = []
        self._is_over_budget = False
        self._next_hypothesis = 0
        self._revision = 0
        self._finished_revision = 0
        self._smoothed: tuple[int, FloatArray] | None = None
        self._first_of_session = 0
        self._wakes_up = False
        self._statements: dict[int, Statement] = {}
        self._untold: tuple[Event, ...] = ()
        self._frozen_visits = 0
        self._versions: dict[int, tuple[bytes, int]] = {}

    @classmethod
    def restored(
        cls,
        stored: StoredMap,
        *,
        seed: int = 0,
        is_frozen: bool = False,
        budget: MemoryBudget | None = None,
        first_of_session: int | None = None,
    ) -> Engine:
        """Return an engine that goes on with a stored map, in a new session if not told otherwise.

        The next tracking is then the first of an odometry that knows nothing of the map: the robot
        may be anywhere in it, or outside.

        Args:
            stored: The map, with at least one keyframe.
            seed: Seed of all randomness from now on.
            is_frozen: Whether the areas stay where and what they are: the session only finds its
                place in them, and of its visits there only the path is kept.
            budget: How much of the map may be in memory; None for all of it.
            first_of_session: Keyframes that the map had when the session began that was
                interrupted: the next tracking is the next of its odometry.

        Raises:
            InvalidInput: If the settings in the map are not of this version, or it is empty.
        """
        config = _frozen(stored.config) if is_frozen else stored.config
        if not stored.hypotheses or not stored.visits:
            held = f"{len(stored.hypotheses)} hypotheses, {len(stored.visits)} visits"
            raise InvalidInput(f"the map is empty: {held}")
        engine = cls(config, seed=seed, budget=budget)
        engine._scans.extend(stored.scans)
        visits = engine._visits = restored_visits(stored, config, budget)
        for keyframe in visits.all_keyframes():
            engine._observation.learn(keyframe)
        engine._motions = [
            Factor(v, v + 1, visits[v].motion_to(visits[v + 1])) for v in range(len(visits) - 1)
        ]
        is_planar = config.sensor.is_planar
        engine._particles.replace(
            [
                restored_hypothesis(h, is_planar=is_planar, is_frozen=is_frozen)
                for h in stored.hypotheses
            ]
        )
        engine._next_hypothesis = 1 + max(h.hypothesis for h in stored.hypotheses)
        engine._revision = stored.revision
        begun = len(stored.keyframes) if first_of_session is None else first_of_session
        engine._first_of_session = begun
        engine._wakes_up = begun == len(stored.keyframes)
        engine._frozen_visits = len(visits) if is_frozen else 0
        if engine._wakes_up:
            engine._finished_revision = stored.revision
        else:
            engine._recall()
        return engine

    # ------------------------------------------------------------------ from scans to hypotheses

    def process(self, tracking: Tracking) -> tuple[Event, ...]:
        """Take what the odometry says of one scan.

        Args:
            tracking: The scan's pose relative to its keyframe, and the keyframe if it became one.

        Returns:
            What was decided because of it.
        """
        tracking = self._of_session(tracking)
        pose = tracking.keyframe_from_body.mean
        self._scans.append(tracking.stamp_s, tracking.keyframe_index, pose)
        self._tracked.update(_said_of(tracking))
        keyframe = tracking.keyframe
        if keyframe is None:
            return ()
        self._revision += 1
        self._observation.learn(keyframe)
        doubts = self._plausibility.check(keyframe)
        mapped = self._map(keyframe, tracking.registration)
        return self._audited((*doubts, *mapped, *self._over_budget(keyframe.stamp_s)))

    def _over_budget(self, stamp_s: float) -> tuple[Event, ...]:
        """Say so once when more of the map is in memory than may be."""
        was, failure = self._is_over_budget, self._visits.failure
        self._is_over_budget = failure is not None
        if failure is None or was or (usage := self._visits.usage) is None:
            return ()
        return (audit.over_budget(usage, failure, stamp_s),)

    def misses(self, tracking: Tracking) -> bool:
        """Return whether a keyframe that a tracking is relative to never came.

        Args:
            tracking: What the odometry says of one scan.
        """
        # Before the first keyframe scans are relative to none.
        is_next = tracking.keyframe is not None or self.keyframes == self._first_of_session
        return self._first_of_session + tracking.keyframe_index >= self.keyframes + is_next

    def relocalize(self) -> None:
        """Forget where the robot is: from the next keyframe on it may be anywhere in the map.

        Raises:
            Unavailable: Before the first keyframe.
        """
        if not self._visits:
            raise Unavailable("there is no map yet: no keyframe has been seen")
        self._wakes_up = True

    def _of_session(self, tracking: Tracking) -> Tracking:
        """Number the keyframes of a new session after those of the map that it goes on with."""
        first, keyframe = self._first_of_session, tracking.keyframe
        if first == 0 and not self._wakes_up:
            return tracking
        if keyframe is not None:
            keyframe = replace(keyframe, index=first + keyframe.index)
            if self._wakes_up:
                keyframe = awakened(keyframe, is_planar=self._config.sensor.is_planar)
                self._wakes_up = False
        return replace(tracking, keyframe_index=first + tracking.keyframe_index, keyframe=keyframe)

    def _map(self, keyframe: Keyframe, registration: Registration | None) -> tuple[Event, ...]:
        """Add a keyframe to every hypothesis."""
        if not self._visits:
            return self._begin(keyframe)
        extended = self._open.with_keyframe(keyframe)
        if keyframe.failure is not None:
            lost = audit.lost(keyframe, keyframe.failure, registration)
            if not self._is_dead_reckoning(keyframe):
                return (lost, *self._enter(extended, len(self._open.keyframes)))
            self._visits.put(extended)
            return (lost, *self._divide(extended))
        self._visits.put(extended)  # metric SLAM
        self._weigh(keyframe)  # Eq. (12)
        return (*self._look_again(extended), *self._divide(extended))

    def _look_again(self, visit: Visit) -> tuple[Event, ...]:
        """Place a visit that began nowhere with all that it has seen, each time that has doubled.

        One scan was all that there was to find its place with, and to tell how it is turned.
        """
        keyframes, stamp_s = len(visit.keyframes), visit.last_stamp_s
        is_due = keyframes >= _LEAST_LOOK and keyframes.bit_count() == 1
        if visit.keyframes[0].failure is None or not is_due:
            return ()
        return (*self._refine(visit, stamp_s), *self._recognise(visit, stamp_s))

    def _divide(self, visit: Visit) -> tuple[Event, ...]:
        """Enter another area if the robot has left the one of the open visit."""
        border = self._border(visit)  # AAM
        return () if border is None else self._enter(visit, border)  # TSBI

    def _is_dead_reckoning(self, keyframe: Keyframe) -> bool:
        """Return whether the wheels alone lead from one unregistered keyframe to the next.

        Scans that never fit (a wrong preset, a blinded sensor) would make an area of each keyframe,
        every one like every other: what is driven blindly is one area.
        """
        is_blind = self._open.keyframes[-1].failure is not None
        return is_blind and keyframe.previous_from_body.sigma_m < _BRIDGED_M

    def _border(self, visit: Visit) -> int | None:
        """Return the first keyframe of the area that the robot has entered, if it has."""
        areas = self._config.areas
        is_full = len(visit.keyframes) >= areas.max_keyframes
        split = partition(
            overlap_of(visit.cells),
            max_cut=_ANY_CUT if is_full else areas.max_cut,
            min_keyframes=areas.min_keyframes,
        )
        return None if split is None else split.first_of_new

    def finish(self, *, is_urgent: bool = False) -> tuple[Event, ...]:
        """Refine what the last visit says, and smooth the trajectory of the best hypothesis.

        A frozen map keeps its own. More trackings may follow, and twice is as good as once.

        Args:
            is_urgent: Whether there is no time to look for the last visit elsewhere, and to smooth.

        Returns:
            What was decided.
        """
        refined: tuple[Event, ...] = ()
        if self._revision > self._finished_revision:
            refined = self._audited(self._refined(self._open, self._open.last_stamp_s))
            self._revision += 1
            self._finished_revision = self._revision
        if is_urgent or self.is_frozen or not self._visits or self._smooth_poses() is not None:
            return refined
        recognised = self._audited(self._recognise(self._open, self._open.last_stamp_s))
        if recognised:
            self._revision += 1
            self._finished_revision = self._revision
        self._smoothed = (
            self._revision,
            self._smoother.smooth(self._particles.best, self._visits),
        )
        return (*refined, *recognised)

    def _smooth_poses(self) -> FloatArray | None:
        """Return the smoothed poses of all keyframes, unless the map has changed since."""
        if self._smoothed is None or self._smoothed[0] != self._revision:
            return None
        return self._smoothed[1]

    @property
    def _open(self) -> Visit:
        return self._visits[len(self._visits) - 1]

    def _begin(self, keyframe: Keyframe) -> tuple[Event, ...]:
        self._visits.put(visit_of(0, (keyframe,), self._config))
        graph = PoseGraph(is_planar=self._config.sensor.is_planar)
        graph.add_reference(0)
        topology = Topology((Assignment(0, 0, None),))
        first = Hypothesis(self._new_identifier(), 0.0, topology, graph)
        self._particles.replace([first])
        return (audit.entered(self._particles, keyframe.stamp_s),)

    def _enter(self, visit: Visit, first_of_new: int) -> tuple[Event, ...]:
        """Close the open visit at a border and expand every hypothesis over what lies beyond it."""
        closed, opened, motion = visit.split(first_of_new)
        self._visits.put(closed)
        self._unweigh(opened.keyframes)
        stamp_s = opened.last_stamp_s
        settled = self._settle(closed, stamp_s)
        arc = Factor(closed.visit, opened.visit, motion)
        self._motions.append(arc)
        expanded, branched = self._expand(opened, arc, stamp_s)
        self._visits.put(opened)
        self._particles.replace(expanded)
        return (*settled, audit.entered(self._particles, stamp_s), *branched)

    def _settle(self, visit: Visit, stamp_s: float) -> tuple[Event, ...]:
        """Use all that a visit that is over has seen, and keep of the one before what is new."""
        if visit.visit < self._frozen_visits:
            return ()
        refined = self._refined(visit, stamp_s)
        particles = self._config.particles
        self._particles.forget(
            unlikely_mass=particles.unlikely_mass, patience=particles.patience_areas
        )
        recognised = self._recognise(visit, stamp_s)
        self._forget_visits(visit.visit - 1)
        return (*refined, *recognised)

    def _refined(self, visit: Visit, stamp_s: float) -> tuple[Event, ...]:
        """Refine all hypotheses, and keep one of those that are the same map since."""
        refined = self._refine(visit, stamp_s)
        self._particles.merge()
        return refined

    def _recognise(self, visit: Visit, stamp_s: float) -> tuple[Event, ...]:
        """Branch over where else in the map what a finished visit has seen may be."""
        known = self._particles.hypotheses
        recognising: list[Hypothesis] = []
        branched: list[Event] = []
        log_resemblance = None
        for hypothesis in known:
            places = self._transition.recognitions(hypothesis, visit, self._visits)
            new = [s for s in places.successors if not _is_recognised(known, hypothesis, s)]
            if places.is_searched and log_resemblance is None:
                log_resemblance = places.log_resemblance(new)
            for match in new:
                child = _recognised(hypothesis, match, self._new_identifier())
                recognising.append(child)
                branched.append(audit.branched(hypothesis, child, match, stamp_s))
        if not recognising:
            return ()
        self._particles.replace([*_resembling(known, log_resemblance), *recognising])
        return tuple(branched)

    def _expand(
        self, visit: Visit, arc: Factor, stamp_s: float
    ) -> tuple[list[Hypothesis], list[Event]]:
        """Return one hypothesis per hypothesis and place that the visit may be to, Eq. (6)."""
        known = self._particles.hypotheses
        places = [self._transition.successors(h, visit, arc, self._visits) for h in known]
        parents, successors, expanded = [], [], []
        for hypothesis, each in zip(known, places, strict=True):
            for successor in each.successors:
                # One successor is no branch: what was believed goes on.
                is_branch = len(each.successors) > 1
                identifier = self._new_identifier() if is_branch else hypothesis.hypothesis
                parents.append(hypothesis)
                successors.append(successor)
                expanded.append(_entered(hypothesis, visit, arc, successor, identifier))
        expanded = _resembling(expanded, _log_resemblance(known, places))
        return expanded, [
            audit.branched(parent, child, successor, stamp_s)
            for parent, child, successor in zip(parents, expanded, successors, strict=True)
            if child.hypothesis != parent.hypothesis
        ]

    def _weigh(self, keyframe: Keyframe) -> None:
        """Multiply the weights by the predictive likelihood of a keyframe, Eq. (12)."""
        if len(self._particles.hypotheses) == 1:
            return
        evidence = self._weighed[keyframe.index] = self._said(len(self._open.keyframes) - 1)
        self._particles.reweight(lambda h: evidence[h.hypothesis])

    def _recall(self) -> None:
        """Find out what the keyframes of the open visit said, which no file tells."""
        if len(self._particles.hypotheses) > 1:
            for number, keyframe in enumerate(self._open.keyframes):
                self._weighed[keyframe.index] = self._said(number)

    def _said(self, number: int) -> dict[int, float]:
        """Return what a keyframe of the open visit says for each hypothesis."""
        hypotheses, news = self._particles.hypotheses, self._open.news_of(number)
        looks = {h.hypothesis: self._look(h, news, number) for h in hypotheses}
        evidence = {h: look.log_ratio for h, look in looks.items()}
        return evidence | _like_found(hypotheses, looks)

    def _look(self, hypothesis: Hypothesis, news: News, number: int) -> Look:
        """Return what the news of a keyframe say for a hypothesis, against the background."""
        visit, area = self._open, hypothesis.current.area
        if area == visit.visit:
            if hypothesis.sees is None:
                return Look(0.0, 0.0)
            area = hypothesis.sees
        area_from_visit = inverse(hypothesis.graph.pose(area)) @ hypothesis.graph.pose(visit.visit)
        pose = area_from_visit @ visit.visit_from_keyframe[number].mean
        known = self._visits[area].known_from(pose[:3, 3])
        look = self._observation.look(news.keyframe, known, pose)
        return replace(look, log_ratio=news.share * look.log_ratio)

    def _unweigh(self, keyframes: Sequence[Keyframe]) -> None:
        """Take back what keyframes said as part of a visit that they turned out not to be in."""
        taken_back = [self._weighed.get(keyframe.index, {}) for keyframe in keyframes]
        self._weighed.clear()
        self._particles.reweight(lambda h: -sum(said.get(h.hypothesis, 0.0) for said in taken_back))

    def _forget_visits(self, last: int) -> None:
        """Forget a visit, and those that were in doubt until now, if they show nothing new.

        All hypotheses must agree that a visit did not found an area: what founders saw is compared
        with.
        """
        hypotheses, asked = self._particles.hypotheses, (*self._doubted, last)
        founded = {v: [v in h.topology.areas for h in hypotheses] for v in asked if v >= 0}
        self._doubted = [v for v, each in founded.items() if any(each) and not all(each)]
        for visit, each in founded.items():
            if not any(each):
                self._forget_visit(visit)

    def _forget_visit(self, visit: int) -> None:
        """Keep the path only of a visit that shows nothing new of an area that is well known.

        The visits before and after it must have been refined, so that no arc to it is to come.
        """
        best, hypotheses = self._particles.best, self._particles.hypotheses
        if visit < self._frozen_visits or any(h.is_told_of(visit) for h in hypotheses):
            return
        to_same = best.topology.visits_to[best.topology.assignments[visit].area]
        others = [v for v in to_same if v != visit and not self._visits.is_forgotten(v)]
        if len(others) < self._config.areas.max_views:
            return
        known = [self._visits[other] for other in others]
        new = share_new(self._visits[visit], known, best.graph.poses())
        if new <= self._config.areas.max_new_share:
            self._visits.forget(visit)
            self._particles.replace([h.without(visit) for h in hypotheses])

    def _refine(self, visit: Visit, stamp_s: float) -> tuple[Event, ...]:
        """Let every hypothesis use all of a visit that is over, not only its beginning."""
        was_new = visit.visit in self._particles.best.topology.areas
        self._particles.replace(
            [
                self._refinement.refine(hypothesis, visit, self._visits)
                for hypothesis in self._particles.hypotheses
            ]
        )
        best = self._particles.best
        if not was_new or visit.visit in best.topology.areas:
            return ()
        return (audit.recognised(visit.visit, best, stamp_s),)

    def _new_identifier(self) -> int:
        self._next_hypothesis += 1
        return self._next_hypothesis - 1

    def _audited(self, events: tuple[Event, ...]) -> tuple[Event, ...]:
        """Keep what was decided, and what is believed since."""
        particles, stamp_s = self._particles, self._open.last_stamp_s
        if dropped := particles.take_dropped():
            events = (*events, *audit.pruned(dropped, stamp_s))
            if len(particles.hypotheses) == 1:
                events = (*events, audit.accepted(particles, dropped, stamp_s))
        self._audit.note(events)
        self._audit.believe(particles.belief(stamp_s))
        return events

    # ------------------------------------------------------------------ what somebody else knows

    def assert_arc(
        self, area_a: int, area_b: int, a_from_b: GaussianPose, *, probability: float
    ) -> StatementEffect:
        """Take what somebody who has seen the site says of two areas as evidence.

        Args:
            area_a: An area of the most probable hypothesis that the robot has left.
            area_b: Another one.
            a_from_b: Pose of its frame in that of the first, as well as it is known.
            probability: How probably that is right, in (0, 1).

        Returns:
            What it did to every hypothesis.

        Raises:
            Unavailable: Before the first keyframe, for a frozen map, or while the robot explores
                one of the areas.
            NotFound: If there is no such area.
            InvalidInput: If it is the same area twice, or a number is out of range.
        """
        best = self._choose(None)[0]
        for area in (area_a, area_b):
            self._reference(best, area)
        if self.is_frozen or self._open.visit in (area_a, area_b):
            raise Unavailable(
                "areas of a frozen map stay where they are, and an area is known well only when "
                f"the robot has left it: it is in area {best.current.area}"
            )
        said = Statement.of(
            self._revision,
            area_a,
            area_b,
            a_from_b,
            probability,
            is_planar=self._config.sensor.is_planar,
        )
        expanded = hear(self._particles.hypotheses, said, self._new_identifier)
        effect = self._convinced(said, expanded, audit.asserted)
        self._statements[said.statement] = said
        for weighed in self._weighed.values():
            said_for = {c.hypothesis: weighed.get(p.hypothesis, 0.0) for p, c in expanded}
            weighed.update(said_for)
        return effect

    def retract_arc(self, statement: int) -> StatementEffect:
        """Forget what somebody said; what has been decided because of it since stays decided.

        Args:
            statement: Identifier of the statement, of this run.

        Raises:
            NotFound: If there is no such statement, or it was taken back before.
        """
        said = self._statements.get(statement)
        if said is None:
            known = sorted(self._statements)
            raise NotFound(f"statement {statement} is not one of this run: {known}")
        expanded = unhear(self._particles.hypotheses, said)
        effect = self._convinced(said, expanded, audit.retracted)
        del self._statements[statement]
        return effect

    def _convinced(
        self,
        statement: Statement,
        expanded: Sequence[tuple[Hypothesis, Hypothesis]],
        told: Callable[[StatementEffect, float], Event],
    ) -> StatementEffect:
        """Believe what a statement, or that it is taken back, makes of each hypothesis."""
        before, stamp_s = self._particles.hypotheses, self._open.last_stamp_s
        for _, child in expanded:
            child.graph.poses()  # who cannot be solved must not be believed
        self._particles.replace([child for _, child in expanded])
        self._particles.merge()
        self._revision += 1
        likely = zip(self._particles.hypotheses, self._particles.probabilities, strict=True)
        after = {h.hypothesis: float(probability) for h, probability in likely}
        effect = StatementEffect(
            statement.statement,
            statement.area_a,
            statement.area_b,
            self._revision,
            effects(before, expanded, statement, after),
        )
        self._untold += self._audited((told(effect, stamp_s),))
        return effect

    def untold(self) -> tuple[Event, ...]:
        """Return, once, what was decided otherwise than by `process` and `finish`."""
        untold, self._untold = self._untold, ()
        return untold

    # ------------------------------------------------------------------ what readers may ask

    @property
    def is_frozen(self) -> bool:
        """Whether the areas of the map that is gone on with stay as they are."""
        return self._frozen_visits > 0

    @property
    def keyframes(self) -> int:
        """Number of keyframes in the map."""
        return self._open.last_keyframe + 1 if self._visits else 0

    @property
    def scans(self) -> int:
        """Number of scans in the map, of all sessions."""
        return len(self._scans)

    @property
    def first_of_session(self) -> int:
        """Number of keyframes that the map had when the session began."""
        return self._first_of_session

    @property
    def wakes_up(self) -> bool:
        """Whether the robot may be anywhere in the map from the next keyframe on."""
        return self._wakes_up

    @property
    def memory_usage(self) -> MemoryUsage | None:
        """What submaps take, if there is a budget for them."""
        return self._visits.usage

    @property
    def audit(self) -> Audit:
        """What was decided and believed."""
        return self._audit

    @property
    def warnings(self) -> tuple[Event, ...]:
        """What casts doubt on the whole map, as it stands now."""
        doubt = self._plausibility.doubt
        return () if doubt is None else (doubt,)

    @property
    def tracked(self) -> Mapping[str, int]:
        """Number of scans that were registered or were not, by the reason.

        Of those that were, how many left a direction to the prediction (`degenerate`), and how many
        contradicted it (`contradicted`).
        """
        return dict(sorted(self._tracked.items()))

    def snapshot(self) -> Snapshot | None:
        """Return the state that readers may know; None before the first keyframe."""
        if not self._visits:
            return None
        best, visit = self._particles.best, self._open
        belief = self._particles.belief(visit.last_stamp_s)
        visit_from_keyframe = visit.visit_from_keyframe[-1]
        return Snapshot(
            posterior=Posterior(
                stamp_s=belief.stamp_s,
                revision=self._revision,
                hypotheses=self._particles.summaries(),
                current_area=belief.current_area,
                effective_sample_size=belief.effective_sample_size,
            ),
            localization=self._particles.localization(belief.stamp_s, self._last_return_s()),
            keyframe_index=visit.last_keyframe - self._first_of_session,
            area_from_keyframe=best.area_from_visit(visit.visit) @ visit_from_keyframe,
            reference_from_keyframe=best.graph.relative(0, visit.visit) @ visit_from_keyframe,
            reference_area=0,
            areas=len(best.topology.areas),
            arcs=best.topology.arcs,
            keyframes=self.keyframes,
        )

    def _last_return_s(self) -> float | None:
        """Return when the robot last was where it had been before, in the best hypothesis."""
        best = self._particles.best
        visit = self._open.visit if best.sees is not None else best.topology.last_return
        return None if visit is None else self._visits.last_stamp_s(visit)

    def global_map(
        self,
        method: MapMethod,
        *,
        reference_area: int | None = None,
        hypothesis: int | None = None,
        with_points: bool = True,
        known: Mapping[int, int] = NOTHING_KNOWN,
    ) -> GlobalMap:
        """Return all areas of one hypothesis in one frame (section IV-C).

        Args:
            method: Globally consistent, or composed along shortest paths.
            reference_area: Area whose frame is used; None for the first area.
            hypothesis: Identifier; None for the most probable one.
            with_points: Whether the submaps come with it.
            known: Versions of submaps, by area, whose points are left out: who asks has them.

        Raises:
            Unavailable: Before the first keyframe.
            NotFound: If there is no such area or hypothesis.
        """
        chosen, probability = self._choose(hypothesis)
        reference = self._reference(chosen, reference_area)
        arcs = arcs_of(chosen, self._motions)
        if method is MapMethod.CONSISTENT:
            poses = {area: chosen.graph.relative(reference, area) for area in chosen.topology.areas}
        else:
            rng = np.random.default_rng([self._seed, self._revision])
            poses = compose_shortest_paths(arcs, reference, rng)
        areas = tuple(
            self._placed(chosen, area, poses[area], with_points=with_points, known=known)
            for area in chosen.topology.areas
        )
        return GlobalMap(
            method=method,
            reference_area=reference,
            hypothesis=chosen.hypothesis,
            probability=probability,
            revision=self._revision,
            areas=areas,
            arcs=arcs,
        )

    def area_details(
        self,
        area: int,
        *,
        reference_area: int | None = None,
        hypothesis: int | None = None,
        with_points: bool = True,
        known: Mapping[int, int] = NOTHING_KNOWN,
    ) -> AreaDetails:
        """Return everything that is known of one area, in the consistent map.

        Args:
            area: The area.
            reference_area: Area whose frame its pose is in; None for the first area.
            hypothesis: Identifier; None for the most probable one.
            with_points: Whether its submap comes with it.
            known: As in `global_map`.

        Raises:
            Unavailable: Before the first keyframe.
            NotFound: If there is no such area or hypothesis.
        """
        chosen, probability = self._choose(hypothesis)
        self._reference(chosen, area)
        reference = self._reference(chosen, reference_area)
        pose, area_from_reference = chosen.graph.relative(reference, area), self._into(chosen, area)
        visits = chosen.topology.visits_to[area]
        return AreaDetails(
            reference_area=reference,
            hypothesis=chosen.hypothesis,
            probability=probability,
            revision=self._revision,
            area=self._placed(chosen, area, pose, with_points=with_points, known=known),
            visits=tuple(
                AreaVisit(
                    visit=visit,
                    area_from_visit=area_from_reference @ chosen.graph.pose(visit),
                    last_stamp_s=self._visits.last_stamp_s(visit),
                    keyframes=self._visits.keyframes(visit),
                    is_forgotten=self._visits.is_forgotten(visit),
                )
                for visit in visits
            ),
            arcs=tuple(
                arc for arc in arcs_of(chosen, self._motions) if area in (arc.area_a, arc.area_b)
            ),
        )

    def compare(
        self, *, reference_area: int | None = None, hypothesis: int | None = None
    ) -> Comparison:
        """Return the shortest-path map against the consistent one, area by area and arc by arc.

        Raises:
            Unavailable: Before the first keyframe.
            NotFound: If there is no such area or hypothesis.
        """
        consistent, shortest = (
            self.global_map(
                method,
                reference_area=reference_area,
                hypothesis=hypothesis,
                with_points=False,
            )
            for method in (MapMethod.CONSISTENT, MapMethod.SHORTEST_PATH)
        )
        differences = tuple(
            _difference(c.area, c.reference_from_area, s.reference_from_area)
            for c, s in zip(consistent.areas, shortest.areas, strict=True)
        )
        consistent_poses, shortest_poses = _means(consistent), _means(shortest)
        residuals = tuple(
            ArcResidual(
                arc.area_a,
                arc.area_b,
                residual_m(arc, consistent_poses),
                residual_m(arc, shortest_poses),
            )
            for arc in consistent.arcs
        )
        return Comparison(
            reference_area=consistent.reference_area,
            hypothesis=consistent.hypothesis,
            revision=consistent.revision,
            areas=differences,
            arcs=residuals,
        )

    def trajectory(self) -> tuple[StampedPose, ...]:
        """Return the globally consistent pose of every scan in the most probable hypothesis.

        After `finish` they are smoothed; before, each keyframe is where its visit is.
        """
        if not self._visits:
            return ()
        return self._placed_scans(self._particles.best, self._scans.scans())

    def trajectory_between(
        self, start_s: float, end_s: float, *, hypothesis: int | None = None
    ) -> Trajectory:
        """Return the globally consistent poses of the scans of an interval.

        Args:
            start_s: Its begin, sensor time, included.
            end_s: Its end, included.
            hypothesis: Identifier; None for the most probable one.

        Raises:
            Unavailable: Before the first keyframe.
            NotFound: If there is no such hypothesis.
        """
        chosen, probability = self._choose(hypothesis)
        return Trajectory(
            reference_area=self._reference(chosen, None),
            hypothesis=chosen.hypothesis,
            probability=probability,
            revision=self._revision,
            is_smoothed=self._smooth_poses_of(chosen) is not None,
            poses=self._placed_scans(chosen, self._scans.between(start_s, end_s)),
        )

    def _smooth_poses_of(self, hypothesis: Hypothesis) -> FloatArray | None:
        return self._smooth_poses() if hypothesis is self._particles.best else None

    def _placed_scans(
        self, hypothesis: Hypothesis, scans: Sequence[StoredScan]
    ) -> tuple[StampedPose, ...]:
        """Return where scans were taken, but for those whose keyframe is not in the map."""
        known = [scan for scan in scans if scan.keyframe_index < self.keyframes]
        if not known:
            return ()
        keyframes = [scan.keyframe_index for scan in known]
        first, poses = self._keyframe_poses(hypothesis, min(keyframes), max(keyframes))
        return tuple(
            StampedPose(scan.stamp_s, poses[scan.keyframe_index - first] @ scan.keyframe_from_body)
            for scan in known
        )

    def _keyframe_poses(
        self, hypothesis: Hypothesis, first: int, last: int
    ) -> tuple[int, FloatArray]:
        """Return the poses of at least these keyframes, and which is the first of them."""
        smoothed = self._smooth_poses_of(hypothesis)
        if smoothed is not None:
            return 0, smoothed
        # Only visits that are asked for: others may have to be read from the disk.
        starts = np.cumsum([0, *map(self._visits.keyframes, self._visits)])
        begin, end = np.searchsorted(starts, [first, last], side="right")
        visits = map(self._visits.__getitem__, range(begin - 1, end))
        return int(starts[begin - 1]), hypothesis.keyframe_poses(visits)

    def stored(self) -> StoredMap:
        """Return everything that a map file needs to hold."""
        return StoredMap(
            revision=self._revision,
            seed=self._seed,
            config_json=self._config.model_dump_json(),
            keyframes=self._visits.all_keyframes(),
            visits=stored_visits(self._visits),
            hypotheses=tuple(stored_hypothesis(h) for h in self._particles.hypotheses),
            scans=self._scans.scans(),
        )

    def _choose(self, hypothesis: int | None) -> tuple[Hypothesis, float]:
        if not self._visits:
            raise Unavailable("there is no map yet: no keyframe has been seen")
        known = zip(self._particles.hypotheses, self._particles.probabilities, strict=True)
        for candidate, probability in known:
            if hypothesis is None or candidate.hypothesis == hypothesis:
                return candidate, float(probability)
        identifiers = [h.hypothesis for h in self._particles.hypotheses]
        raise NotFound(f"hypothesis {hypothesis} is not one of {identifiers}")

    @staticmethod
    def _reference(hypothesis: Hypothesis, area: int | None) -> int:
        areas = hypothesis.topology.areas
        reference = areas[0] if area is None else area
        if reference not in areas:
            raise NotFound(
                f"area {area} is not in hypothesis {hypothesis.hypothesis}, "
                f"which has {len(areas)} areas: {list(areas)}"
            )
        return reference

    def _placed(
        self,
        hypothesis: Hypothesis,
        area: int,
        reference_from_area: GaussianPose,
        *,
        with_points: bool,
        known: Mapping[int, int],
    ) -> PlacedArea:
        visits = hypothesis.topology.visits_to[area]
        points, version = NO_POINTS, 0
        if with_points:
            points, version = self._submap(hypothesis, area, known.get(area))
        return PlacedArea(
            area=area,
            reference_from_area=reference_from_area,
            keyframes=sum(self._visits.keyframes(visit) for visit in visits),
            visits=len(visits),
            points_in_area=points,
            version=version,
        )

    def _submap(self, hypothesis: Hypothesis, area: int, known: int | None) -> tuple[Points, int]:
        """Return the points of all visits to an area, in its frame, and their version.

        No points if `known` is that version; then they are not even put together, unless something
        that they are made of has changed since.
        """
        area_from_reference = self._into(hypothesis, area)
        made_of = [
            (visit, area_from_reference @ hypothesis.graph.pose(visit))
            for visit in hypothesis.topology.visits_to[area]
            if not self._visits.is_forgotten(visit)
        ]
        parts = (
            b"%d %d " % (visit, self._visits.keyframes(visit)) + pose.tobytes()
            for visit, pose in made_of
        )
        recipe = recipe_of(parts)
        before, version = self._versions.get(area, (b"", 0))
        if recipe == before and version == known:
            return NO_POINTS, version
        points = as_points(
            np.concatenate([self._visits[visit].points_in(pose) for visit, pose in made_of])
        )
        version = version_of(points)
        self._versions[area] = recipe, version
        return (NO_POINTS if version == known else points), version

    @staticmethod
    def _into(hypothesis: Hypothesis, area: int) -> Pose:
        """Return `area_from_reference`, the inverse of the area's pose in its graph."""
        return inverse(hypothesis.graph.pose(area))


_ANY_CUT = 2.0
# A place of which so much is known can tell what one that looks like it would look like.
_MOSTLY_KNOWN = 0.5
# From so many keyframes on there is more to see than at first.
_LEAST_LOOK = 4
# A gap that the wheels bridge so well is none.
_BRIDGED_M = 0.25


def _frozen(config: Config) -> Config:
    """Return the settings with which a session leaves no more than its path in known areas."""
    areas = config.areas.model_copy(update={"max_views": 1, "max_new_share": 1.0})
    return config.model_copy(update={"areas": areas})


def _said_of(tracking: Tracking) -> list[str]:
    """Return what is counted of a scan."""
    registration = tracking.registration
    said = ["registered" if tracking.failure is None else str(tracking.failure)]
    if registration is not None and tracking.failure is None:
        said += ["degenerate"] if len(registration.degenerate) else []
        said += ["contradicted"] if registration.prior_weight < 1.0 else []
    return said


def _entered(
    hypothesis: Hypothesis, visit: Visit, arc: Factor, successor: Successor, identifier: int
) -> Hypothesis:
    """Return a hypothesis that goes on with a visit where a successor says."""
    area, place, is_carried = successor.area, successor.area_from_visit, successor.is_carried
    new = Assignment(visit.visit, visit.visit, None, is_carried)
    log_weight = hypothesis.log_weight + successor.log_factor
    extended = partial(hypothesis.extended, arc=arc, hypothesis=identifier, log_weight=log_weight)
    if area is None or place is None:
        # Who is lost once more has not been found since.
        is_found = hypothesis.is_found and visit.keyframes[0].failure is None
        share = successor.look_alike_share
        return replace(extended(new), is_found=is_found, look_alike_share=share)
    if area != hypothesis.current.area or successor.overlap >= SAME_AREA:
        known = extended(Assignment(visit.visit, area, place, is_carried))
        return replace(known, is_found=known.is_found or successor.is_found)
    # Who only sees into the area that he was in has left it.
    return extended(new).recognising(
        area,
        place,
        is_same_area=False,
        is_found=successor.is_found,
        hypothesis=identifier,
        log_weight=log_weight,
    )


def _is_recognised(
    hypotheses: Sequence[Hypothesis], hypothesis: Hypothesis, match: Successor
) -> bool:
    """Return whether there is a hypothesis already that another one has this place in the map."""
    area, place = _known_place(match)
    return any(h.has_recognised(hypothesis, area, place.mean) for h in hypotheses)


def _recognised(hypothesis: Hypothesis, match: Successor, identifier: int) -> Hypothesis:
    """Return a hypothesis whose last visit is where a match says."""
    return hypothesis.recognising(
        *_known_place(match),
        is_same_area=match.overlap >= SAME_AREA,
        is_found=match.is_found,
        hypothesis=identifier,
        log_weight=hypothesis.log_weight_of_unlike + match.log_factor,
    )


def _known_place(match: Successor) -> tuple[int, GaussianPose]:
    assert match.area is not None, "new areas are not recognised"
    assert match.area_from_visit is not None, "known areas have a place"
    return match.area, match.area_from_visit


def _like_found(hypotheses: Sequence[Hypothesis], looks: Mapping[int, Look]) -> dict[int, float]:
    """Return what a keyframe says where nobody knows, as the places tell where the robot was found.

    New areas may look like these, like each as probably as the robot is there. And the places
    themselves, which look alike as far as they are known, go on to do so where one of them is not:
    that another one is known better is no evidence for it.
    """
    found = [h for h in hypotheses if h.is_found]
    knowing = [h for h in found if looks[h.hypothesis].covered >= _MOSTLY_KNOWN]
    if not found:
        return {}
    like = _log_mean(knowing, [looks[h.hypothesis].log_ratio for h in knowing]) if knowing else 0.0
    said = {
        h.hypothesis: looks[h.hypothesis].log_ratio + (1.0 - looks[h.hypothesis].covered) * like
        for h in found
    }
    new = _log_mean(found, [said[h.hypothesis] for h in found])
    unlike = [h for h in hypotheses if h.log_unlike is not None]
    return said | {h.hypothesis: h.log_likelihood_of_like(new) for h in unlike}


def _resembling(
    hypotheses: Sequence[Hypothesis], log_resemblance: float | None
) -> list[Hypothesis]:
    """Let new areas look like known ones, if it was found out how well those would do."""
    if log_resemblance is None:
        return list(hypotheses)
    return [hypothesis.resembling(log_resemblance) for hypothesis in hypotheses]


def _log_resemblance(hypotheses: Sequence[Hypothesis], places: Sequence[Places]) -> float | None:
    """Return how well a new visit is explained by what looks like it, if anybody knows.

    A wing that looks like another does so room after room: what those hypotheses expect that have
    found the robot by its looks is what it would look like, too.
    """
    searched = (p.log_resemblance(p.successors) for p in places if p.is_searched)
    told = [
        (h, float(np.logaddexp.reduce([s.log_factor for s in each.successors])))
        for h, each in zip(hypotheses, places, strict=True)
        if h.is_found
    ]
    if not told:
        return next(searched, None)
    return max(_log_mean(*zip(*told, strict=True)), next(searched, -math.inf))


def _log_mean(hypotheses: Sequence[Hypothesis], log_likelihoods: Sequence[float]) -> float:
    """Return the log of the mean of likelihoods, one per hypothesis, each with its weight."""
    log_weights = np.array([hypothesis.log_weight for hypothesis in hypotheses])
    weighed = np.logaddexp.reduce(log_weights + log_likelihoods)
    return float(weighed - np.logaddexp.reduce(log_weights))


def _means(placed: GlobalMap) -> Mapping[int, Pose]:
    return {area.area: area.reference_from_area.mean for area in placed.areas}


def _difference(area: int, consistent: GaussianPose, shortest: GaussianPose) -> AreaDifference:
    apart = log(inverse(consistent.mean) @ shortest.mean)
    return AreaDifference(
        area=area,
        translation_m=float(np.linalg.norm(consistent.mean[:3, 3] - shortest.mean[:3, 3])),
        rotation_rad=float(np.linalg.norm(apart[:3])),
        sigma_consistent_m=consistent.sigma_m,
        sigma_shortest_path_m=shortest.sigma_m,
    )
