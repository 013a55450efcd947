"""Waking up in a known map: a recorded log's first half is mapped, the second begins anywhere.

Where the robot really is comes from the same log mapped in one go, whose error over relations is
centimetres. A hypothesis is right if the robot is where it says, relative to the keyframe of the
map that it puts nearest to it, to within `scoring`'s tolerance; a session that is not tied to the
map is neither right nor wrong.

References:
    Blanco et al. 2008, section II (the awakening problem).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import networkx as nx
import numpy as np

from benchmarks.cells import Result
from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.scoring import TOLERANCE_M, TOLERANCE_RAD
from hmt_service.core.awakening import is_anywhere
from hmt_service.core.config import Config, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, log
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredHypothesis, StoredMap
from hmt_service.core.types import Reading
from hmt_service.runtime.offline import map_readings

_LOGS = ("intel", "fr079", "aces")
_STARTS, _QUICK_STARTS = 25, 2
_CERTAIN = 0.95
# The map knows a place if it has a keyframe so near.
_KNOWN_M = 1.0
_WITHIN_M, _LONGEST_M = 10.0, 25.0
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Where the robot was, from the whole log."""

    stamps_s: FloatArray
    """Of the scans, shape (S,)."""
    poses: FloatArray
    """Their poses in one frame, shape (S, 4, 4)."""

    def at(self, stamp_s: float) -> Pose:
        """Return the pose of the scan nearest in time, shape (4, 4)."""
        pose: Pose = self.poses[np.argmin(np.abs(self.stamps_s - stamp_s))]
        return pose


@dataclass(frozen=True, slots=True)
class Awakening:
    """What came of one start."""

    found_m: float | None
    """Way until the right place was certain; None if it never was."""
    wrong: float
    """Largest probability of wrong places on the way there."""


def measure(run: Run) -> Report:
    """Wake up at many places of each log that is there."""
    metrics: list[Metric] = []
    skipped = []
    everything: list[Awakening] = []
    for name in _LOGS[1:2] if run.is_quick else _LOGS:
        path = recorded_file(f"{name}.clf.bz2")
        if isinstance(path, Missing):
            skipped.append(f"{name}: {path.reason}")
            continue
        starts = _QUICK_STARTS if run.is_quick else _STARTS
        result = run.once(name, partial(_woken, tuple(read_recorded(path, load_config())), starts))
        awakenings = [Awakening(**each) for each in result["starts"]]
        metrics += _metrics(name, awakenings)
        everything += awakenings
    if everything:
        metrics += _metrics("all", everything)
    return Report(tuple(metrics), tuple(skipped))


def _woken(readings: Sequence[Reading], starts: int) -> Result:
    config = load_config()
    engine, _ = map_readings(readings, config)
    trajectory = engine.trajectory()
    truth = Truth(
        np.array([pose.stamp_s for pose in trajectory]),
        np.array([pose.reference_from_body for pose in trajectory]),
    )
    middle_s = float(np.median(truth.stamps_s))
    first = [reading for reading in readings if reading.stamp_s <= middle_s]
    second = readings[len(first) :]
    engine, _ = map_readings(first, config)
    known = engine.stored()
    candidates = _known_places(known, second, truth)
    rng = np.random.default_rng(0)
    chosen = rng.choice(candidates, min(starts, len(candidates)), replace=False)
    awakenings = [awaken(known, second[start:], truth, config) for start in sorted(chosen)]
    return {"starts": [{"found_m": a.found_m, "wrong": a.wrong} for a in awakenings]}


def _known_places(known: StoredMap, readings: Sequence[Reading], truth: Truth) -> list[int]:
    """Return the readings at places that a map knows, with enough way after them."""
    places = np.array([truth.at(keyframe.stamp_s)[:2, 3] for keyframe in known.keyframes])
    path = np.array([truth.at(reading.stamp_s)[:2, 3] for reading in readings])
    ways_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return [
        index
        for index, position in enumerate(path)
        if np.linalg.norm(places - position, axis=1).min() <= _KNOWN_M
        and ways_m[-1] - ways_m[index] >= _WITHIN_M
    ]


def awaken(
    known: StoredMap, readings: Iterable[Reading], truth: Truth, config: Config
) -> Awakening:
    """Go on with a map from an unknown place until that is certain, or for 25 m.

    Args:
        known: The map.
        readings: What the robot sends from its awakening on.
        truth: Where it is, in any frame, also at the keyframes of the map.
        config: Settings of the map.
    """
    engine, odometry = Engine.restored(known), Odometry(config)
    places = np.array([truth.at(keyframe.stamp_s) for keyframe in known.keyframes])
    travelled_m = worst = 0.0
    before: Pose | None = None
    for reading in readings:
        tracking = odometry.process(reading)
        if tracking is None:
            continue
        engine.process(tracking)
        here = truth.at(tracking.stamp_s)
        if before is not None:
            travelled_m += float(np.linalg.norm((here - before)[:2, 3]))
        before = here
        if tracking.keyframe is None:
            continue
        right, wrong = _masses(engine.stored(), places, here)
        worst = max(worst, wrong)
        if right > _CERTAIN:
            return Awakening(travelled_m, worst)
        if travelled_m > _LONGEST_M:
            break
    return Awakening(None, worst)


def _masses(stored: StoredMap, places: FloatArray, here: Pose) -> tuple[float, float]:
    """Return the probabilities of the right place and of wrong ones.

    Args:
        stored: The map that goes on, the robot at its last keyframe.
        places: True poses of the keyframes of the map that was known, shape (K, 4, 4).
        here: The true pose of the robot, in the same frame.
    """
    right = wrong = 0.0
    relative = _within_visits(stored)
    for hypothesis in stored.hypotheses:
        if not _is_tied(hypothesis):
            continue
        poses = np.array(
            [hypothesis.reference_from_visit[visit] @ pose for visit, pose in relative]
        )
        robot = poses[-1]
        gaps_m = np.linalg.norm(poses[: len(places), :2, 3] - robot[:2, 3], axis=1)
        nearest = int(np.argmin(gaps_m))
        believed = inverse(poses[nearest]) @ robot
        gap = inverse(inverse(places[nearest]) @ here) @ believed
        is_near = np.linalg.norm(gap[:3, 3]) <= TOLERANCE_M
        if is_near and np.linalg.norm(log(gap)[:3]) <= TOLERANCE_RAD:
            right += math.exp(hypothesis.log_weight)
        else:
            wrong += math.exp(hypothesis.log_weight)
    return right, wrong


def _within_visits(stored: StoredMap) -> list[tuple[int, Pose]]:
    """Return the visit of each keyframe, and its pose there."""
    result = []
    for visit in stored.visits:
        pose = identity()
        for index in range(visit.first_keyframe, visit.last_keyframe + 1):
            if index > visit.first_keyframe:
                pose = pose @ stored.keyframes[index].previous_from_body.mean
            result.append((visit.visit, pose))
    return result


def _is_tied(hypothesis: StoredHypothesis) -> bool:
    """Return whether the latest visit has a place beside the first."""
    tight = [(f.visit_a, f.visit_b) for f in hypothesis.factors if not is_anywhere(f.a_from_b)]
    graph: nx.Graph[int] = nx.Graph(tight)
    last = hypothesis.assignments[-1].visit
    return graph.has_node(last) and graph.has_node(0) and bool(nx.has_path(graph, 0, last))


def _metrics(name: str, awakenings: Sequence[Awakening]) -> list[Metric]:
    found_m = [math.inf if a.found_m is None else a.found_m for a in awakenings]
    soon = float(np.mean([each <= _WITHIN_M for each in found_m]))
    wrong = float(np.mean([a.wrong > _CERTAIN for a in awakenings]))
    numbers = [
        Metric(f"{name}/starts", float(len(awakenings)), "1", _HIGHER, None),
        Metric(f"{name}/found_within_10_m", soon, "1", _HIGHER, 0.05),
        Metric(f"{name}/certain_and_wrong", wrong, "1", _LOWER, None),
    ]
    if math.isfinite(median := float(np.median(found_m))):
        numbers.append(Metric(f"{name}/found_after", median, "m", _LOWER, None))
    return numbers
