"""Accuracy of the map over ground-truth relations of recorded logs, and what it costs.

References:
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27, 2009.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.report import Report, Run
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.types import StampedPose
from hmt_service.io.relations import ErrorStatistics, Relations, evaluate, read_relations
from hmt_service.runtime.messages import RunReport
from hmt_service.runtime.offline import map_readings

_LOGS = ("intel", "fr079", "aces")
_QUICK_SCANS = 2_000
_TOLERANCE_S = 0.005
# Least and largest time between the two poses of a relation, both excluded, s.
_GROUPS = {"all": (-1.0, math.inf), "over_60s": (60.0, math.inf), "under_20s": (-1.0, 20.0)}
_MEAN_TOLERANCE = 0.1
_STD_TOLERANCE = 0.25
_LOOPS_TOLERANCE = 0.2
_TIME_TOLERANCE = 0.5
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


def measure(run: Run) -> Report:
    """Map every recorded log that is there."""
    metrics: list[Metric] = []
    skipped: list[str] = []
    for name in _LOGS:
        log, truth = recorded_file(f"{name}.clf.bz2"), recorded_file(f"{name}.relations")
        if isinstance(log, Missing):
            skipped.append(f"{name}: {log.reason}")
            continue
        if isinstance(truth, Missing):
            skipped.append(f"{name}: {truth.reason}")
            continue
        report = _measure_log(run, name, log, read_relations(truth))
        metrics += report.metrics
        skipped += report.skipped
    return Report(tuple(metrics), tuple(skipped))


def _measure_log(run: Run, name: str, path: Path, relations: Relations) -> Report:
    config = load_config()
    run.say(f"{name}: reading")
    started = time.perf_counter()
    recorded = read_recorded(path, config)
    read_s = time.perf_counter() - started
    readings = first_scans(recorded, _QUICK_SCANS if run.is_quick else None)
    run.say(f"{name}: mapping")
    engine, cost = map_readings(readings, config)
    trajectory = engine.trajectory()
    recorded_s = readings[-1].stamp_s - readings[0].stamp_s
    metrics = list(_costs(name, engine, cost, read_s=read_s, recorded_s=recorded_s))
    skipped = []
    for group, (above_s, below_s) in _GROUPS.items():
        covered = _covered(relations, trajectory, above_s, below_s)
        if not len(covered.stamps_s):
            skipped.append(f"{name}/{group}: {cost.scans} scans cover none of these relations")
            continue
        errors = evaluate(trajectory, covered, tolerance_s=_TOLERANCE_S)
        matched = float(errors.matched)
        metrics.append(Metric(f"{name}/{group}/relations", matched, "1", _HIGHER, 0.0))
        metrics += _errors(f"{name}/{group}", errors.all_pairs)
    return Report(tuple(metrics), tuple(skipped))


def _covered(
    relations: Relations, trajectory: Sequence[StampedPose], above_s: float, below_s: float
) -> Relations:
    """Return the relations within the time of a trajectory whose poses are so far apart in time.

    A pose that is missing in between stays a missing match, and shows in the number of relations.
    """
    stamps_s = np.array([pose.stamp_s for pose in trajectory])
    first_s, last_s = stamps_s.min() - _TOLERANCE_S, stamps_s.max() + _TOLERANCE_S
    gap_s = np.abs(np.diff(relations.stamps_s, axis=1))[:, 0]
    is_inside = ((relations.stamps_s >= first_s) & (relations.stamps_s <= last_s)).all(axis=1)
    chosen = is_inside & (gap_s > above_s) & (gap_s < below_s)
    return Relations(relations.stamps_s[chosen], relations.first_from_second[chosen])


def _errors(prefix: str, errors: ErrorStatistics) -> Iterator[Metric]:
    for name, value, unit, tolerance in (
        ("translation_mean", errors.translation_mean_m, "m", _MEAN_TOLERANCE),
        ("translation_std", errors.translation_std_m, "m", _STD_TOLERANCE),
        ("rotation_mean", errors.rotation_mean_deg, "deg", _MEAN_TOLERANCE),
        ("rotation_std", errors.rotation_std_deg, "deg", _STD_TOLERANCE),
    ):
        yield Metric(f"{prefix}/{name}", value, unit, _LOWER, tolerance)


def _costs(
    name: str, engine: Engine, cost: RunReport, *, read_s: float, recorded_s: float
) -> Iterator[Metric]:
    snapshot = engine.snapshot()
    if snapshot is not None:
        best = snapshot.posterior.hypotheses[0]
        loops = float(best.loop_closures)
        yield Metric(f"{name}/areas", float(best.areas), "1", _LOWER, None)
        yield Metric(f"{name}/loop_closures", loops, "1", _HIGHER, _LOOPS_TOLERANCE)
    for stage, seconds in (
        ("read", read_s),
        ("odometry", cost.odometry_busy_s),
        ("topology", cost.topology_busy_s),
    ):
        yield Metric(f"{name}/{stage}_time", seconds, "s", _LOWER, None)
    share = cost.topology_busy_s / cost.odometry_busy_s
    yield Metric(f"{name}/topology_over_odometry", share, "1", _LOWER, _TIME_TOLERANCE)
    speed = recorded_s / cost.busy_s  # scans/s of the chain over scans/s of the recording
    yield Metric(f"{name}/real_time_factor", speed, "1", _HIGHER, _TIME_TOLERANCE)
