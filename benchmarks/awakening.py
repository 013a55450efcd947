"""Waking up in a known map: a recorded log's first half is mapped, the second begins anywhere.

Once it is a new session; once the robot is carried there while it runs, and its wheels say that it
stands still meanwhile. Where one scan fits the other, being carried is not noticed.

Where the robot really is comes from the same log mapped in one go, whose error over relations is
centimetres. A hypothesis is right if the robot is where it says, relative to the keyframe of the
map that it puts nearest to it, to within `scoring`'s tolerance; a session that is not tied to the
map is neither right nor wrong.

References:
    Blanco et al. 2008, section II (the awakening problem).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context

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
from hmt_service.core.types import EventKind, OdometryReading, Reading
from hmt_service.runtime.offline import map_readings

_LOGS = ("intel", "fr079", "aces")
_STARTS, _QUICK_STARTS = 25, 2
_CERTAIN = 0.95
# The map knows a place if it has a keyframe so near.
_KNOWN_M = 1.0
# A robot that is carried is so far from where it was, and blind for so long.
_CARRIED_M, _LIFTED_S = 2.0, 0.2
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
    """Largest probability of wrong places on the way there, since it was noticed."""
    is_noticed: bool
    """Whether the odometry found out that it was lost; a new session always is."""


def measure(run: Run) -> Report:
    """Wake up at many places of each log that is there."""
    metrics: list[Metric] = []
    skipped = []
    everything: dict[str, list[Awakening]] = {}
    for name in _LOGS[1:2] if run.is_quick else _LOGS:
        path = recorded_file(f"{name}.clf.bz2")
        if isinstance(path, Missing):
            skipped.append(f"{name}: {path.reason}")
            continue
        starts = _QUICK_STARTS if run.is_quick else _STARTS
        result = run.once(name, partial(_woken, tuple(read_recorded(path, load_config())), starts))
        for how, found in result.items():
            awakenings = [Awakening(**each) for each in found]
            metrics += _metrics(f"{how}/{name}", awakenings)
            everything.setdefault(how, []).extend(awakenings)
    for how, awakenings in everything.items():
        metrics += _metrics(f"{how}/all", awakenings)
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
    engine, odometry = Engine(config), Odometry(config)
    for reading in first:
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    known = engine.stored()
    candidates = _known_places(known, second, truth)
    rng = np.random.default_rng(0)
    chosen = rng.choice(candidates, min(starts, len(candidates)), replace=False)
    woken, carried = [], []
    for start in sorted(chosen):
        rest = second[start:]
        woken.append(awaken(known, rest, truth, config))
        way = inverse(truth.at(first[-1].stamp_s)) @ truth.at(rest[0].stamp_s)
        if np.linalg.norm(way[:2, 3]) < _CARRIED_M:
            continue
        lifted = _lifted(rest, _last_odometry(first), first[-1].stamp_s)
        steps = ((reading, truth.at(stamp_s)) for reading, stamp_s in lifted)
        carried.append(_in_a_copy(partial(_find, engine, odometry, known, steps, truth)))
    return {
        "woken": [asdict(awakening) for awakening in woken],
        "carried": [asdict(awakening) for awakening in carried],
    }


def _in_a_copy(find: Callable[[], Awakening]) -> Awakening:
    """Return what is found in a copy of this process, for the engine here must not go on."""
    context = get_context("fork")
    receiving, sending = context.Pipe(duplex=False)
    process = context.Process(target=lambda: sending.send(find()))
    process.start()
    sending.close()
    found: Awakening = receiving.recv()
    process.join()
    return found


def _last_odometry(readings: Sequence[Reading]) -> Pose:
    poses = [r.odom_from_body for r in readings if isinstance(r, OdometryReading)]
    return poses[-1]


def _lifted(
    readings: Iterable[Reading], odom_from_body: Pose, stamp_s: float
) -> Iterator[tuple[Reading, float]]:
    """Yield readings as if they followed others at once, and their own stamps.

    Args:
        readings: What the robot sends where it is put down; what comes before odometry is left out.
        odom_from_body: What its wheels said last.
        stamp_s: When that was.
    """
    moved: Pose | None = None
    later_s = 0.0
    for reading in readings:
        if moved is None and isinstance(reading, OdometryReading):
            moved = odom_from_body @ inverse(reading.odom_from_body)
            later_s = stamp_s + _LIFTED_S - reading.stamp_s
        if moved is None:
            continue
        lifted = replace(reading, stamp_s=reading.stamp_s + later_s)
        if isinstance(lifted, OdometryReading):
            lifted = replace(lifted, odom_from_body=moved @ lifted.odom_from_body)
        yield lifted, reading.stamp_s


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
    steps = ((reading, truth.at(reading.stamp_s)) for reading in readings)
    return _find(Engine.restored(known), Odometry(config), known, steps, truth)


def _find(
    engine: Engine,
    odometry: Odometry,
    known: StoredMap,
    steps: Iterable[tuple[Reading, Pose]],
    truth: Truth,
) -> Awakening:
    """Go on until the right place is certain, or for 25 m; see `awaken`.

    Args:
        engine: Holds the map.
        odometry: What it is told by.
        known: The map.
        steps: Readings, and where the robot is.
        truth: Where it was at the keyframes of the map.
    """
    places = np.array([truth.at(keyframe.stamp_s) for keyframe in known.keyframes])
    travelled_m = worst = 0.0
    before: Pose | None = None
    is_lost = False
    for reading, here in steps:
        tracking = odometry.process(reading)
        if tracking is None:
            continue
        events = engine.process(tracking)
        is_lost |= any(event.kind is EventKind.LOST for event in events)
        if before is not None:
            travelled_m += float(np.linalg.norm((here - before)[:2, 3]))
        before = here
        # Until it is noticed, a robot that is carried is where it was.
        if tracking.keyframe is None or not is_lost:
            continue
        right, wrong = _masses(engine.stored(), places, here)
        worst = max(worst, wrong)
        if right > _CERTAIN:
            return Awakening(travelled_m, worst, is_lost)
        if travelled_m > _LONGEST_M:
            break
    return Awakening(None, worst, is_lost)


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
    noticed = float(np.mean([a.is_noticed for a in awakenings]))
    numbers = [
        Metric(f"{name}/starts", float(len(awakenings)), "1", _HIGHER, None),
        Metric(f"{name}/found_within_10_m", soon, "1", _HIGHER, 0.05),
        Metric(f"{name}/certain_and_wrong", wrong, "1", _LOWER, None),
        Metric(f"{name}/noticed", noticed, "1", _HIGHER, None),
    ]
    if math.isfinite(median := float(np.median(found_m))):
        numbers.append(Metric(f"{name}/found_after", median, "m", _LOWER, None))
    return numbers
