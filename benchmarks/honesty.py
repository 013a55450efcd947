"""How honest the odometry is about its own error: NEES of the motion from keyframe to keyframe.

The worlds are others than those that the constants of the covariance were fitted in.

References:
    Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, section 5.4.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice

from benchmarks.calibration import consistency, normalised_error
from benchmarks.cells import Result
from benchmarks.metric import Direction, Metric
from benchmarks.report import Report, Run
from hmt_service.core.config import load_config
from hmt_service.core.geometry import Pose, inverse
from hmt_service.core.odometry import Odometry
from hmt_service.sim.sensors import Laser2d, Lidar3d, WheelOdometry
from hmt_service.sim.simulation import LIDAR, Robot, simulate
from hmt_service.sim.usual import USUAL_ROBOTS, preset_for
from hmt_service.sim.worlds.families import Family, draw

_BLIND = Robot(
    sensor=Laser2d(max_range_m=4.0),
    odometry=WheelOdometry(
        scale=1.1, drift_rad_per_m=0.03, slips_per_m=0.05, slip_m=0.3, slip_sigma_rad=0.1
    ),
)
"""Sees walls beside it only in a corridor, and its wheels slip every 20 m."""
_LIDAR_64 = Robot(follower=LIDAR.follower, sensor=Lidar3d(rows=64, columns=1024), scan_period_s=0.1)


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
    "office-blind": _Drive(Family.OFFICE, 32, 2500, _BLIND),
    "aliased-blind": _Drive(Family.ALIASED, 32, 2500, _BLIND, {"severity": 1.0}),
    "garage-64": _Drive(Family.GARAGE, 31, 300, _LIDAR_64),
    "campus-64": _Drive(Family.CAMPUS, 31, 300, _LIDAR_64),
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
        metrics += _metrics(f"honesty/{sensor}", everything, is_planar=is_planar)
        for name, errors in found.items():
            metrics += _metrics(f"honesty/{sensor}/{name}", errors, is_planar=is_planar)
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


def _metrics(prefix: str, errors: Sequence[float], *, is_planar: bool) -> Iterator[Metric]:
    found = consistency(errors, is_planar=is_planar)
    yield Metric(f"{prefix}/steps", float(found.count), "1", _HIGHER, None)
    yield Metric(f"{prefix}/nees_mean", found.mean, "1", _LOWER, None)
    yield Metric(f"{prefix}/nees_median", found.median, "1", _LOWER, None)
    yield Metric(f"{prefix}/coverage", found.coverage, "1", _HIGHER, _COVERAGE_TOLERANCE)
