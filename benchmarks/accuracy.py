"""Accuracy of the map: recorded logs by relations, simulated worlds by their true trajectory.

The odometry alone, beside KISS-ICP, is measured by `benchmarks.metric_level`.

References:
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27, 2009.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from benchmarks import metric_level
from benchmarks.cells import Result
from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.simulated import readings_of
from benchmarks.trajectories import (
    TrajectoryErrors,
    mean_errors,
    metrics_of,
    trajectory_errors,
)
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.types import StampedPose
from hmt_service.io.relations import ErrorStatistics, Relations, evaluate, read_relations
from hmt_service.runtime.messages import RunReport
from hmt_service.runtime.offline import map_readings
from hmt_service.sim.simulation import simulate
from hmt_service.sim.usual import USUAL_ROBOTS, preset_for
from hmt_service.sim.worlds.families import Family, draw

_LOGS = ("intel", "fr079", "aces")
_QUICK_SCANS = 2_000
_WORLDS = {
    Family.GARAGE: 1,
    Family.CAMPUS: 1,
    Family.NESTED_LOOPS: 2,
    Family.WAREHOUSE: 2,
    Family.ALIASED: 2,
    Family.OFFICE: 2,
}
"""How many worlds of each family, from seed 0."""
_QUICK_WORLDS = {Family.OFFICE: 1, Family.ALIASED: 1}
_QUICK_WORLD_SCANS = 400
_REPORT = TypeAdapter(Report)
_TOLERANCE_S = 0.005
# Least and largest time between the two poses of a relation, both excluded, s.
_GROUPS = {"all": (-1.0, math.inf), "over_60s": (60.0, math.inf), "under_20s": (-1.0, 20.0)}
_MEAN_TOLERANCE = 0.1
_STD_TOLERANCE = 0.25
_LOOPS_TOLERANCE = 0.2
_TIME_TOLERANCE = 0.5
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


def measure(run: Run) -> Report:
    """Map every recorded log that is there and some worlds of every family, then only track."""
    reports = [_measure_recorded(run, name) for name in _LOGS]
    reports += [measure_simulated(run), metric_level.measure(run)]
    return Report(
        tuple(metric for report in reports for metric in report.metrics),
        tuple(sentence for report in reports for sentence in report.skipped),
    )


# ------------------------------------------------------------------ simulated worlds


def measure_simulated(run: Run) -> Report:
    """Map some worlds of every family."""
    worlds, scans = (_QUICK_WORLDS, _QUICK_WORLD_SCANS) if run.is_quick else (_WORLDS, None)
    units = {
        f"{family}/{seed}": partial(_map_world, family, seed, scans)
        for family, count in worlds.items()
        for seed in range(count)
    }
    results = run.once_each(units, jobs=os.cpu_count() or 1)
    metrics: list[Metric] = []
    for family, count in worlds.items():
        each = [TrajectoryErrors(**results[f"{family}/{seed}"]) for seed in range(count)]
        metrics += metrics_of(f"simulated/{family}", mean_errors(each))
    return Report(tuple(metrics))


def _map_world(family: Family, seed: int, scans: int | None) -> Result:
    robot = USUAL_ROBOTS[family]
    instants = islice(simulate(draw(family, seed), robot, seed), scans)
    truth: list[StampedPose] = []
    engine, _ = map_readings(readings_of(instants, truth), load_config(preset_for(robot, family)))
    return asdict(trajectory_errors(engine.trajectory(), truth))


# ------------------------------------------------------------------ recorded logs


def _measure_recorded(run: Run, name: str) -> Report:
    log, truth = recorded_file(f"{name}.clf.bz2"), recorded_file(f"{name}.relations")
    if isinstance(log, Missing):
        return Report((), (f"{name}: {log.reason}",))
    if isinstance(truth, Missing):
        return Report((), (f"{name}: {truth.reason}",))
    result = run.once(f"recorded/{name}", partial(_map_log, name, log, truth, run.is_quick))
    return _REPORT.validate_python(result)


def _map_log(name: str, log: Path, truth: Path, is_quick: bool) -> Result:
    config, relations = load_config(), read_relations(truth)
    started = time.perf_counter()
    recorded = read_recorded(log, config)
    read_s = time.perf_counter() - started
    readings = first_scans(recorded, _QUICK_SCANS if is_quick else None)
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
    result: Result = _REPORT.dump_python(Report(tuple(metrics), tuple(skipped)), mode="json")
    return result


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
