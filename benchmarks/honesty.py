"""How honest the odometry is about its own error: NEES of the motion from keyframe to keyframe.

The worlds are others than those that the constants of the covariance were fitted in.

References:
    Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import islice

from benchmarks.calibration import consistency_metrics, normalised_error
from benchmarks.cells import Result
from benchmarks.metric import Direction, Metric
from benchmarks.report import Report, Run
from benchmarks.simulated import BLIND, LIDAR_64
from hmt_service.core.config import load_config
from hmt_service.core.geometry import Pose, inverse
from hmt_service.core.odometry import Odometry
from hmt_service.sim.simulation import LIDAR, Robot, simulate
from hmt_service.sim.usual import USUAL_ROBOTS, preset_for
from hmt_service.sim.worlds.families import Family, draw


@dataclass(frozen=True, slots=True)
class _Drive:
    """The beginning of a drive."""

    family: Family
    seed: int
    scans: int
    robot: Robot | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)
    people: int = 0


_DRIVES = {
    "office": _Drive(Family.OFFICE, 30, 2500),
    "office-people": _Drive(Family.OFFICE, 31, 2500, people=8),
    "aliased": _Drive(Family.ALIASED, 30, 2500),
    "nested-loops": _Drive(Family.NESTED_LOOPS, 30, 2500),
    "warehouse": _Drive(Family.WAREHOUSE, 30, 2500),
    "campus-laser": _Drive(Family.CAMPUS, 30, 2500, parameters={"relief_m": 0.0}),
    "office-blind": _Drive(Family.OFFICE, 32, 2500, BLIND),
    "aliased-blind": _Drive(Family.ALIASED, 32, 2500, BLIND, {"severity": 1.0}),
    "garage-64": _Drive(Family.GARAGE, 31, 300, LIDAR_64),
    "campus-64": _Drive(Family.CAMPUS, 31, 300, LIDAR_64),
} | {
    f"{family}-lidar/{seed}": _Drive(family, seed, 800, LIDAR)
    for family in (Family.GARAGE, Family.OFFICE, Family.CAMPUS, Family.WAREHOUSE)
    for seed in (30, 33, 34, 35)
}
_QUICK_DRIVES = {
    "office": _Drive(Family.OFFICE, 30, 600),
    "office-lidar": _Drive(Family.OFFICE, 30, 150, LIDAR),
}
_COVERAGE_TOLERANCE = 0.05
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


def measure(run: Run) -> Report:
    """Track the beginnings of drives in drawn worlds, and hold every step against the truth."""
    drives = _QUICK_DRIVES if run.is_quick else _DRIVES
    units = {f"honesty/{name}": partial(_track, drive) for name, drive in drives.items()}
    results = run.once_each(units, jobs=os.cpu_count() or 1)
    metrics: list[Metric] = []
    for sensor, is_planar in (("2d", True), ("3d", False)):
        found = {
            name: results[f"honesty/{name}"]["errors"]
            for name in drives
            if results[f"honesty/{name}"]["is_planar"] is is_planar
        }
        everything = [error for errors in found.values() for error in errors]
        for name, errors in {"all": everything, **found}.items():
            metrics += consistency_metrics(
                f"honesty/{sensor}/{name}",
                errors,
                is_planar=is_planar,
                coverage_tolerance=_COVERAGE_TOLERANCE,
            )
    return Report(tuple(metrics))


def _track(drive: _Drive) -> Result:
    robot = drive.robot or USUAL_ROBOTS[drive.family]
    config = load_config(preset_for(robot, drive.family))
    is_planar = config.sensor.is_planar
    world = draw(drive.family, drive.seed, **drive.parameters)
    odometry = Odometry(config)
    errors: list[float] = []
    before: Pose | None = None
    instants = simulate(world, robot, drive.seed, people=drive.people)
    for instant in islice(instants, drive.scans):
        for reading in instant.readings:
            tracking = odometry.process(reading)
            if tracking is None or tracking.keyframe is None:
                continue
            now = instant.truth.reference_from_body
            if before is not None and tracking.failure is None:
                belief = tracking.keyframe.previous_from_body
                errors.append(normalised_error(belief, inverse(before) @ now, is_planar=is_planar))
            before = now
    return {"errors": errors, "is_planar": is_planar}
