"""Waking up in a known map: the first half of a drive is mapped, the second begins anywhere.

Once it is a new session; once the robot is carried there while it runs, and its wheels say that it
stands still meanwhile. Where one scan fits the other, being carried is not noticed.

Where the robot really is the simulator knows, or, for a recorded log, the same log mapped in one
go, whose error over relations is centimetres. A hypothesis is right if the robot is where it says,
relative to the keyframe of the map that it puts nearest to it, to within `scoring`'s tolerance; a
session that is not tied to the map is neither right nor wrong.

References:
    Blanco et al. 2008, section II (the awakening problem).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import networkx as nx
import numpy as np

from benchmarks.belief_figures import draw_reliability
from benchmarks.calibration import Scores, probability_right, score
from benchmarks.cells import Result
from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.scoring import TOLERANCE_M, TOLERANCE_RAD, Decision, Option
from benchmarks.simulated import readings_of
from hmt_service.core.awakening import is_anywhere
from hmt_service.core.config import Config, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, log
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredHypothesis, StoredMap
from hmt_service.core.types import EventKind, OdometryReading, Reading, StampedPose
from hmt_service.runtime.offline import map_readings
from hmt_service.sim.simulation import SHORT_SIGHTED, simulate
from hmt_service.sim.worlds.families import Family, draw

_LOGS = ("intel", "fr079", "aces")
_STARTS, _QUICK_STARTS = 25, 2
# Buildings of rooms that are equal to the bit.
_ALIASED, _QUICK_ALIASED, _ALIASED_STARTS = range(400, 410), (), 5
_CERTAIN = 0.95
# The map knows a place if it has a keyframe so near.
_KNOWN_M = 1.0
# A robot that is carried is so far from where it was, and blind for so long.
_CARRIED_M, _LIFTED_S = 2.0, 0.2
_WITHIN_M, _LONGEST_M = 10.0, 25.0
FIGURE = "awakening.png"
"""Name of the figure."""
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Where the robot was, over the whole drive."""

    stamps_s: FloatArray
    """Of the scans, shape (S,)."""
    poses: FloatArray
    """Their poses in one frame, shape (S, 4, 4)."""

    @classmethod
    def of(cls, trajectory: Sequence[StampedPose]) -> Truth:
        """Return what a trajectory says."""
        return cls(
            np.array([pose.stamp_s for pose in trajectory]),
            np.array([pose.reference_from_body for pose in trajectory]),
        )

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
    """Largest probability of a wrong place on the way there, since it was noticed."""
    is_noticed: bool
    """Whether the odometry found out that it was lost; a new session always is."""
    decisions: tuple[Decision, ...]
    """What was believed at each keyframe of the first 10 m, since it was noticed."""


def measure(run: Run) -> Report:
    """Wake up at many places of each log that is there, and of buildings of equal rooms."""
    config, drives, skipped = load_config(), {}, []
    for name in _LOGS[1:2] if run.is_quick else _LOGS:
        path = recorded_file(f"{name}.clf.bz2")
        if isinstance(path, Missing):
            skipped.append(f"{name}: {path.reason}")
            continue
        starts = _QUICK_STARTS if run.is_quick else _STARTS
        drives[name] = partial(_woken_in_log, path, starts, config)
    for seed in _QUICK_ALIASED if run.is_quick else _ALIASED:
        drives[f"aliased/{seed}"] = partial(_woken_in_aliased, seed, config)
    found: dict[str, list[Awakening]] = {}
    for name, drive in drives.items():
        for how, results in run.once(name, drive).items():
            awakenings = [_from_result(each) for each in results]
            found.setdefault(f"{how}/{name.partition('/')[0]}", []).extend(awakenings)
            if name in _LOGS:
                found.setdefault(f"{how}/all", []).extend(awakenings)
    metrics = [metric for name, each in found.items() for metric in _metrics(name, each)]
    if scores := {name: scored for name, each in found.items() if (scored := _scores(each))}:
        draw_reliability(scores, run.out / FIGURE)
    return Report(tuple(metrics), tuple(skipped))


def _woken_in_log(path: Path, starts: int, config: Config) -> Result:
    readings = tuple(read_recorded(path, config))
    engine, _ = map_readings(readings, config)
    return _woken(readings, Truth.of(engine.trajectory()), starts, config)


def _woken_in_aliased(seed: int, config: Config) -> Result:
    truth: list[StampedPose] = []
    world = draw(Family.ALIASED, seed, severity=1.0)
    readings = tuple(readings_of(simulate(world, SHORT_SIGHTED, seed), truth))
    return _woken(readings, Truth.of(truth), _ALIASED_STARTS, config)


def _woken(readings: Sequence[Reading], truth: Truth, starts: int, config: Config) -> Result:
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


def _from_result(result: Result) -> Awakening:
    decisions = tuple(
        Decision(tuple(Option(**option) for option in each["options"]), each["is_return"])
        for each in result["decisions"]
    )
    return Awakening(**{**result, "decisions": decisions})


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
    """Go on with a map from an unknown place for 10 m, and until that is certain, at most 25 m.

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
    """Go on for 10 m, and until the right place is certain, but not beyond 25 m; see `awaken`.

    Args:
        engine: Holds the map.
        odometry: What it is told by.
        known: The map.
        steps: Readings, and where the robot is.
        truth: Where it was at the keyframes of the map.
    """
    places = np.array([truth.at(keyframe.stamp_s) for keyframe in known.keyframes])
    travelled_m = worst = 0.0
    found_m: float | None = None
    decisions: list[Decision] = []
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
        decision = _decision(engine.stored(), places, here)
        if found_m is None:
            worst = max(worst, _of_wrong_place(decision))
            found_m = travelled_m if probability_right(decision) > _CERTAIN else None
        # As far for everybody: who is found early must not count less.
        if travelled_m <= _WITHIN_M:
            decisions.append(decision)
        elif found_m is not None or travelled_m > _LONGEST_M:
            break
    return Awakening(found_m, worst, is_lost, tuple(decisions))


def _of_wrong_place(decision: Decision) -> float:
    """Return the probability of the wrong place of the map that is believed most."""
    wrong = [o.probability for o in decision.options if o.is_known and not o.is_right]
    return max(wrong, default=0.0)


def _decision(stored: StoredMap, places: FloatArray, here: Pose) -> Decision:
    """Return the places that the robot may be at, one option each, and what is not tied to the map.

    Args:
        stored: The map that goes on, the robot at its last keyframe.
        places: True poses of the keyframes of the map that was known, shape (K, 4, 4).
        here: The true pose of the robot, in the same frame.
    """
    relative = _within_visits(stored)
    options: list[Option] = []
    likely = sorted(stored.hypotheses, key=lambda h: -h.log_weight)
    tied = {
        h.hypothesis: np.array([h.reference_from_visit[visit] @ pose for visit, pose in relative])
        for h in likely
        if _is_tied(h)
    }
    masses = {h.hypothesis: math.exp(h.log_weight) for h in likely}
    left = list(tied)
    while left:
        # Who puts the robot at the same place as the most probable one, says the same.
        poses = tied[left[0]]
        gaps_m = np.linalg.norm(poses[: len(places), :2, 3] - poses[-1][:2, 3], axis=1)
        nearest = int(np.argmin(gaps_m))
        robot = inverse(poses[nearest]) @ poses[-1]
        same = [h for h in left if _is_near(robot, inverse(tied[h][nearest]) @ tied[h][-1])]
        is_right = _is_near(robot, inverse(places[nearest]) @ here)
        options.append(Option(sum(masses[h] for h in same), is_known=True, is_right=is_right))
        left = [h for h in left if h not in same]
    nowhere = sum(mass for hypothesis, mass in masses.items() if hypothesis not in tied)
    options.append(Option(nowhere, is_known=False, is_right=False))
    return Decision(tuple(sorted(options, key=lambda o: -o.probability)), is_return=True)


def _is_near(pose: Pose, other: Pose) -> bool:
    gap = inverse(pose) @ other
    is_here = float(np.linalg.norm(gap[:3, 3])) <= TOLERANCE_M
    return is_here and float(np.linalg.norm(log(gap)[:3])) <= TOLERANCE_RAD


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
    if (scores := _scores(awakenings)) is not None:
        error = scores.expected_calibration_error
        numbers += [
            Metric(f"{name}/decisions", float(scores.decisions), "1", _HIGHER, None),
            Metric(f"{name}/brier", scores.brier, "1", _LOWER, None),
            Metric(f"{name}/log_loss", scores.log_loss, "nat", _LOWER, None),
            Metric(f"{name}/calibration_error", error, "1", _LOWER, None),
        ]
    return numbers


def _scores(awakenings: Sequence[Awakening]) -> Scores | None:
    decisions = [decision for awakening in awakenings for decision in awakening.decisions]
    return score(decisions) if decisions else None
