"""One world mapped by the chain: what was believed of its topology, and how wide its poses are.

References: own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from pydantic import TypeAdapter

from benchmarks.calibration import normalised_error
from benchmarks.greedy import greedy_poses
from benchmarks.scoring import (
    Decision,
    Journey,
    Placement,
    Topology,
    Verdict,
    always_new,
    decide,
    is_true_return,
    judge_all,
    placement,
)
from hmt_service.core.config import Config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredMap
from hmt_service.core.storing import restored_visits
from hmt_service.core.types import (
    Event,
    EventKind,
    GlobalMap,
    Keyframe,
    MapMethod,
    Reading,
    Tracking,
)
from hmt_service.sim.simulation import Instant


@dataclass(frozen=True, slots=True)
class Alone:
    """What the same engine does with the same odometry if it may keep one hypothesis only."""

    false_loops: int
    """False loops of its topology at the end."""
    missed_loops: int
    """Its missed loops."""
    placement: Placement
    """How it places the keyframes that return."""
    engine_s: float
    """Processor time of the engine with all hypotheses, s."""
    engine_alone_s: float
    """The same with one."""

    @property
    def is_map_right(self) -> bool:
        """Whether its topology is right."""
        return not self.false_loops and not self.missed_loops


@dataclass(frozen=True, slots=True)
class WorldBelief:
    """What was believed of one world, held against the truth."""

    is_planar: bool
    """Whether poses have three degrees of freedom or six."""
    p_true: float
    """Mass of the right topologies at the end."""
    visits: int
    """Number of visits."""
    true_returns: int
    """How many of them a map of nothing but new areas gets wrong."""
    false_loops: int
    """False loops of the most probable topology at the end."""
    missed_loops: int
    """Its missed loops."""
    alone: Alone
    """The engine with one hypothesis."""
    placement: Placement
    """How it places the keyframes that return."""
    placement_odometry: Placement
    """How the motions from keyframe to keyframe alone place them."""
    placement_greedy: Placement | None
    """How a chain does that commits to the best fit, on the same odometry; None in 3-D."""
    placement_peer: Placement | None
    """How KISS-SLAM does, from the scans alone; None where it has not run."""
    decisions: tuple[Decision, ...]
    """One for each visit but the first."""
    decisions_always_new: tuple[Decision, ...]
    """What a filter that knows only new areas decides of the same visits."""
    odometry_errors: tuple[float, ...]
    """Normalised squared error of each registered motion from keyframe to keyframe."""
    arc_errors: tuple[float, ...]
    """The same of the arcs of the most probable topology; none if that is wrong."""
    area_errors: tuple[float, ...]
    """The same of the consistent poses of its areas relative to the first; none if it is wrong."""

    @property
    def is_map_right(self) -> bool:
        """Whether the most probable topology is right."""
        return not self.false_loops and not self.missed_loops


_ADAPTER = TypeAdapter(WorldBelief)


def as_result(belief: WorldBelief) -> dict[str, Any]:
    """Return the same as values that JSON can hold."""
    result: dict[str, Any] = _ADAPTER.dump_python(belief, mode="json")
    return result


def from_result(result: dict[str, Any]) -> WorldBelief:
    """Return what `as_result` was given."""
    return _ADAPTER.validate_python(result)


class _Record:
    """What is true of the keyframes so far, and what has been decided of the visits."""

    def __init__(self) -> None:
        self._world_from_keyframe: list[Pose] = []
        self._place: list[int] = []
        self.decisions: list[Decision] = []

    def add_keyframe(self, instant: Instant) -> None:
        """Add the truth of one more keyframe."""
        self._world_from_keyframe.append(instant.truth.reference_from_body)
        self._place.append(instant.place)

    def add_decisions(self, stored: StoredMap, closed_visits: int) -> None:
        """Hold what is believed of the visits that are over and were not, against the truth.

        Of the first visit there is nothing to decide.
        """
        for visit in range(len(self.decisions) + 1, closed_visits):
            self.decisions.append(decide(self.journey(stored), topologies_of(stored), visit))

    def journey(self, stored: StoredMap) -> Journey:
        """Return the truth beside the visits and estimates of a map."""
        return Journey(
            np.array(self._world_from_keyframe),
            np.array(self._place),
            np.concatenate(
                [
                    _chained(stored.keyframes[visit.first_keyframe : visit.last_keyframe + 1])
                    for visit in stored.visits
                ]
            ),
            tuple(visit.first_keyframe for visit in stored.visits),
        )

    def alone(self, stored: StoredMap, *, engine_s: float, engine_alone_s: float) -> Alone:
        """Hold the map of an engine with one hypothesis against the truth."""
        journey, topology = self.journey(stored), topologies_of(stored)[0]
        verdicts = judge_all(journey, topology)
        return Alone(
            false_loops=verdicts.count(Verdict.FALSE_LOOP),
            missed_loops=verdicts.count(Verdict.MISSED_LOOP),
            placement=_placement(journey, topology.reference_from_visit),
            engine_s=engine_s,
            engine_alone_s=engine_alone_s,
        )


class Peer(Protocol):
    """Another program that maps the same scans."""

    def take(self, reading: Reading) -> None:
        """Take what the robot sends."""

    def poses(self, stamps_s: FloatArray) -> FloatArray:
        """Return where the robot was at some stamps, shape (K, 4, 4), when all has been sent."""


def believe(
    instants: Iterable[Instant], config: Config, *, seed: int = 0, peer: Peer | None = None
) -> WorldBelief:
    """Map what a robot sends, as `hmt run` does, and hold every decision against the truth.

    Args:
        instants: What the robot sends and where it is, in the order of time.
        config: Settings of all stages.
        seed: Seed of all randomness of the engine.
        peer: Another program that is to map the same; None: none.
    """
    particles = config.particles.model_copy(update={"budget": 1})
    alone = _TimedEngine(config.model_copy(update={"particles": particles}), seed)
    trackings = []
    timed, odometry, record = _TimedEngine(config, seed), Odometry(config), _Record()
    engine = timed.engine
    for instant in instants:
        for reading in instant.readings:
            if peer is not None:
                peer.take(reading)
            tracking = odometry.process(reading)
            if tracking is None:
                continue
            if tracking.keyframe is not None:
                record.add_keyframe(instant)
            trackings.append(tracking)
            events = timed.process(tracking)
            if any(event.kind is EventKind.AREA_ENTERED for event in events):
                stored = engine.stored()
                record.add_decisions(stored, len(stored.visits) - 1)
    engine.finish()
    # One engine after the other: submaps that are ready to be used are shared by all in a process.
    for tracking in trackings:
        alone.process(tracking)
    alone.engine.finish()
    stored = engine.stored()
    record.add_decisions(stored, len(stored.visits))
    built = engine.global_map(MapMethod.CONSISTENT, with_points=False)
    beside = record.alone(
        alone.engine.stored(), engine_s=timed.spent_s, engine_alone_s=alone.spent_s
    )
    belief = _belief(stored, built, record, beside, config)
    if peer is None:
        return belief
    stamps_s = np.array([keyframe.stamp_s for keyframe in stored.keyframes])
    return replace(belief, placement_peer=placement(record.journey(stored), peer.poses(stamps_s)))


class _TimedEngine:
    """An engine, and the processor time that it takes for trackings."""

    def __init__(self, config: Config, seed: int) -> None:
        self.engine = Engine(config, seed=seed)
        self.spent_s = 0.0

    def process(self, tracking: Tracking) -> tuple[Event, ...]:
        started_s = time.process_time()
        events = self.engine.process(tracking)
        self.spent_s += time.process_time() - started_s
        return events


def topologies_of(stored: StoredMap) -> tuple[Topology, ...]:
    """Return all hypotheses of a map, the most probable first."""
    return tuple(
        Topology(
            probability=math.exp(hypothesis.log_weight),
            areas=tuple(assignment.area for assignment in hypothesis.assignments),
            reference_from_visit=np.array(
                [hypothesis.reference_from_visit[visit.visit] for visit in stored.visits]
            ),
        )
        for hypothesis in stored.hypotheses
    )


def _belief(
    stored: StoredMap, built: GlobalMap, record: _Record, alone: Alone, config: Config
) -> WorldBelief:
    is_planar = config.sensor.is_planar
    journey, topologies = record.journey(stored), topologies_of(stored)
    verdicts = [judge_all(journey, topology) for topology in topologies]
    is_right = [set(each) == {Verdict.RIGHT} for each in verdicts]
    visits = range(1, len(stored.visits))
    world_from_area = journey.world_from_keyframe[list(journey.first_keyframe)]
    return WorldBelief(
        is_planar=is_planar,
        p_true=math.fsum(
            topology.probability
            for topology, right in zip(topologies, is_right, strict=True)
            if right
        ),
        visits=len(stored.visits),
        true_returns=sum(is_true_return(journey, visit) for visit in visits),
        false_loops=verdicts[0].count(Verdict.FALSE_LOOP),
        missed_loops=verdicts[0].count(Verdict.MISSED_LOOP),
        alone=alone,
        placement=_placement(journey, topologies[0].reference_from_visit),
        placement_odometry=placement(journey, _chained(stored.keyframes)),
        placement_greedy=_placement(journey, _greedy(stored, config)) if is_planar else None,
        placement_peer=None,
        decisions=tuple(record.decisions),
        decisions_always_new=tuple(always_new(journey, visit) for visit in visits),
        odometry_errors=tuple(_odometry_errors(stored, journey, is_planar=is_planar)),
        arc_errors=(
            tuple(_arc_errors(built, world_from_area, is_planar=is_planar)) if is_right[0] else ()
        ),
        area_errors=(
            tuple(_area_errors(built, world_from_area, is_planar=is_planar)) if is_right[0] else ()
        ),
    )


def _chained(keyframes: Sequence[Keyframe]) -> FloatArray:
    """Return the pose of each keyframe in the frame of the first by the motions between them."""
    poses = [identity()]
    for keyframe in keyframes[1:]:
        poses.append(poses[-1] @ keyframe.previous_from_body.mean)
    return np.array(poses)


def _placement(journey: Journey, reference_from_visit: FloatArray) -> Placement:
    """Return how the keyframes are placed if the visits, shape (V, 4, 4), are there."""
    visits = (
        np.searchsorted(journey.first_keyframe, np.arange(len(journey.place)), side="right") - 1
    )
    return placement(journey, reference_from_visit[visits] @ journey.visit_from_keyframe)


def _greedy(stored: StoredMap, config: Config) -> FloatArray:
    """Return where a greedy chain puts the visits of a map, shape (V, 4, 4)."""
    return greedy_poses(tuple(restored_visits(stored, config, budget=None).values()), config)


def _odometry_errors(stored: StoredMap, journey: Journey, *, is_planar: bool) -> Iterator[float]:
    for before, keyframe in pairwise(stored.keyframes):
        if keyframe.failure is None:
            truth = _relative(journey.world_from_keyframe, before.index, keyframe.index)
            yield normalised_error(keyframe.previous_from_body, truth, is_planar=is_planar)


def _arc_errors(
    built: GlobalMap, world_from_area: FloatArray, *, is_planar: bool
) -> Iterator[float]:
    for arc in built.arcs:
        truth = _relative(world_from_area, arc.area_a, arc.area_b)
        yield normalised_error(arc.a_from_b, truth, is_planar=is_planar)


def _area_errors(
    built: GlobalMap, world_from_area: FloatArray, *, is_planar: bool
) -> Iterator[float]:
    for placed in built.areas:
        if placed.area != built.reference_area:
            truth = _relative(world_from_area, built.reference_area, placed.area)
            yield normalised_error(placed.reference_from_area, truth, is_planar=is_planar)


def _relative(world_from_each: FloatArray, one: int, other: int) -> Pose:
    one_from_other: Pose = inverse(world_from_each[one]) @ world_from_each[other]
    return one_from_other
