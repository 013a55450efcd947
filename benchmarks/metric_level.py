"""The metric level alone: our odometry beside KISS-ICP, its worst steps, its speed, its memory.

`lidar` compares ours with KISS-ICP's own pipeline on the same scans in the same run, one program
after the other, each alone in a process of its own with one thread. `hmt_scans_only` and `kiss_icp`
get the same and are the fair pair; `hmt` has wheel odometry as well. Errors are those of the motion
over 10 m of path, each pose held against the truth at the moment that it belongs to: of ours the
stamp, which is the end of the sweep, of KISS-ICP the last return of the sweep (see
`benchmarks.tracking`). The truth in between is that of the simulated drive, known every 0.02 s;
a relative error would forgive a fixed offset of the body, not one of time.

References:
    Vizzo et al., KISS-ICP, RA-L 2023.
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27, 2009.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice, takewhile
from pathlib import Path

import numpy as np

from benchmarks import honesty
from benchmarks.cells import Result
from benchmarks.chain import write_readings
from benchmarks.kitti import read_truth
from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.relative_motion import motion_errors
from benchmarks.report import Report, Run
from benchmarks.resident import resident_memory
from benchmarks.short_steps import StepErrors, step_errors
from benchmarks.simulated import LIDAR_64, readings_of
from benchmarks.tracking import Program, TrackingRun, run_tracker
from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import FloatArray, exp, log
from hmt_service.core.types import OdometryReading, StampedPose
from hmt_service.io.relations import read_relations
from hmt_service.sim.simulation import INDOOR_LASER, LIDAR, Robot, simulate
from hmt_service.sim.trajectories import STEP_S
from hmt_service.sim.usual import preset_for
from hmt_service.sim.worlds.families import Family, draw


@dataclass(frozen=True, slots=True)
class _Drive:
    """The beginning of one simulated drive."""

    family: Family
    seed: int
    robot: Robot
    scans: int


@dataclass(frozen=True, slots=True)
class _Day:
    """A simulated drive of ten minutes and more."""

    family: Family
    robot: Robot
    parameters: Mapping[str, float]


Source = Callable[[Path], tuple[StampedPose, ...]]
"""Writes the readings of a drive to a file, and returns its true poses, a few per scan or more."""

_DRIVES = {
    "garage": _Drive(Family.GARAGE, 0, LIDAR, 600),
    "garage-64": _Drive(Family.GARAGE, 0, LIDAR_64, 300),
    "campus": _Drive(Family.CAMPUS, 0, LIDAR, 600),
    "campus-64": _Drive(Family.CAMPUS, 0, LIDAR_64, 300),
    "office": _Drive(Family.OFFICE, 0, LIDAR, 600),
}
# Its robot turns a corner within these scans.
_QUICK_DRIVES = {"garage": _Drive(Family.GARAGE, 2, LIDAR, 60)}
_KITTI = "kitti00_part"
_FAST = "garage-64"
"""The drive whose scans per second are told once more, under `speed`."""
_LOGS = ("intel", "fr079", "aces")
_FAST_LOG = "intel"
_QUICK_SCANS = 2_000
_DAYS = {
    "laser": _Day(Family.LONG, INDOOR_LASER, {}),
    # As many floors as there can be: the usual garage is over sooner.
    "lidar": _Day(Family.GARAGE, LIDAR, {"floors": 6}),
}
_QUICK_DAYS = {"laser": _DAYS["laser"]}
_SETTLED_S, _LATE_S = 120.0, 600.0
_TIMEOUT_S = 1_800.0
_MB = 1e6
_ERROR_TOLERANCE = 0.3
_CPU_TOLERANCE = 0.3
_STEP_TOLERANCE = 0.25
_RESIDENT_TOLERANCE = 0.2
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER
_PEER = Program.KISS_ICP
_COMPARED = {
    "relative_10m": ("m", _ERROR_TOLERANCE),
    "relative_10m_rotation": ("deg", _ERROR_TOLERANCE),
    "cpu_per_scan": ("ms", _CPU_TOLERANCE),
}


def measure(run: Run) -> Report:
    """Measure the metric level on everything that is there."""
    reports = (
        _measure_lidar(run),
        _measure_steps(run),
        honesty.measure(run),
        _measure_memory(run),
    )
    return Report(
        tuple(metric for report in reports for metric in report.metrics),
        tuple(sentence for report in reports for sentence in report.skipped),
    )


# ------------------------------------------------------------------ beside KISS-ICP


def _measure_lidar(run: Run) -> Report:
    drives = _QUICK_DRIVES if run.is_quick else _DRIVES
    units = {
        name: partial(_compare, preset_for(drive.robot, drive.family), partial(_simulated, drive))
        for name, drive in drives.items()
    }
    skipped = []
    if not run.is_quick:
        poses = recorded_file("kitti00-part/poses.txt", "3d")
        if isinstance(poses, Missing):
            skipped.append(f"lidar/{_KITTI}: {poses.reason}")
        else:
            source = partial(_kitti, poses.parent)
            units[_KITTI] = partial(_compare, Preset.OUTDOOR, source, has_odometry=False)
    metrics: list[Metric] = []
    for name, compute in units.items():
        sides = run.once(f"lidar/{name}", compute)
        metrics += _lidar_metrics(f"lidar/{name}", sides)
        if name == _FAST:
            speed_hz = 1e3 / sides[Program.HMT]["cpu_per_scan"]
            metrics.append(Metric(f"speed/{name}", speed_hz, "scans/s", _HIGHER, None))
    return Report(tuple(metrics), tuple(skipped))


def _simulated(drive: _Drive, path: Path) -> tuple[StampedPose, ...]:
    world = draw(drive.family, drive.seed)
    instants = islice(simulate(world, drive.robot, drive.seed), drive.scans)
    at_scans: list[StampedPose] = []
    write_readings(readings_of(instants, at_scans), path)
    end_s = at_scans[-1].stamp_s + STEP_S
    poses = drive.robot.follower.drive(world.route_m)
    return tuple(takewhile(lambda pose: pose.stamp_s <= end_s, poses))


def _kitti(folder: Path, path: Path) -> tuple[StampedPose, ...]:
    write_readings(read_recorded(folder, load_config(Preset.OUTDOOR)), path)
    return read_truth(folder)


def _compare(preset: Preset, source: Source, *, has_odometry: bool = True) -> Result:
    """Track one drive with all programs."""
    programs = list(Program) if has_odometry else [Program.HMT_SCANS_ONLY, Program.KISS_ICP]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        readings = folder / "readings"
        truth = source(readings)
        return {
            program.value: _side(
                run_tracker(program, readings, preset, folder, timeout_s=_TIMEOUT_S), truth
            )
            for program in programs
        }


def _side(run: TrackingRun, truth: Sequence[StampedPose]) -> dict[str, float]:
    moments_s = np.array([pose.stamp_s for pose in run.trajectory])
    errors = motion_errors(run.trajectory, poses_at(truth, moments_s))
    return {
        "relative_10m": errors.translation_m,
        "relative_10m_rotation": errors.rotation_deg,
        "cpu_per_scan": 1e3 / run.speed_hz,
        "failures": float(run.failures),
    }


def poses_at(truth: Sequence[StampedPose], stamps_s: FloatArray) -> tuple[StampedPose, ...]:
    """Return the poses at some times, at constant velocity between the two known ones around.

    Args:
        truth: Poses in the order of time, two at least; the robot stands still before and after.
        stamps_s: The times, shape (N,).
    """
    known_s = np.array([pose.stamp_s for pose in truth])
    poses = np.stack([pose.reference_from_body for pose in truth])
    at_s = stamps_s.clip(known_s[0], known_s[-1])
    after = np.searchsorted(known_s, at_s, side="right").clip(1, len(known_s) - 1)
    before = after - 1
    shares = (at_s - known_s[before]) / (known_s[after] - known_s[before])
    motions = log(np.linalg.inv(poses[before]) @ poses[after])
    found = poses[before] @ exp(shares[:, None] * motions)
    return tuple(map(StampedPose, stamps_s.tolist(), found))


def _lidar_metrics(prefix: str, sides: Mapping[str, Mapping[str, float]]) -> Iterator[Metric]:
    """Yield the numbers of each program, and those of ours over those of KISS-ICP."""
    peer = sides[_PEER]
    for side, numbers in sides.items():
        for key, (unit, tolerance) in _COMPARED.items():
            # Absolute numbers are for reading: of ours, the ratios are gated.
            yield Metric(f"{prefix}/{side}/{key}", numbers[key], unit, _LOWER, None)
            if side != _PEER:
                name, ratio = f"{prefix}/{side}/{key}_over_{_PEER}", numbers[key] / peer[key]
                yield Metric(name, ratio, "1", _LOWER, tolerance)
        speed_hz = 1e3 / numbers["cpu_per_scan"]
        yield Metric(f"{prefix}/{side}/speed", speed_hz, "scans/s", _HIGHER, None)
        if side != _PEER:
            yield Metric(f"{prefix}/{side}/failures", numbers["failures"], "1", _LOWER, None)


# ------------------------------------------------------------------ steps of recorded logs


def _measure_steps(run: Run) -> Report:
    metrics: list[Metric] = []
    skipped = []
    for name in _LOGS:
        log_file, truth = recorded_file(f"{name}.clf.bz2"), recorded_file(f"{name}.relations")
        if isinstance(log_file, Missing):
            skipped.append(f"steps/{name}: {log_file.reason}")
            continue
        if isinstance(truth, Missing):
            skipped.append(f"steps/{name}: {truth.reason}")
            continue
        scans = _QUICK_SCANS if run.is_quick else None
        result = run.once(f"steps/{name}", partial(_track_log, log_file, truth, scans))
        metrics += _step_metrics(f"steps/{name}", StepErrors(**result["errors"]))
        if name == _FAST_LOG:
            metrics.append(Metric(f"speed/{name}", result["speed"], "scans/s", _HIGHER, None))
    return Report(tuple(metrics), tuple(skipped))


def _track_log(log_file: Path, truth: Path, scans: int | None) -> Result:
    readings = first_scans(read_recorded(log_file, load_config()), scans)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_readings(readings, folder / "readings")
        run = run_tracker(
            Program.HMT, folder / "readings", Preset.PLANAR, folder, timeout_s=_TIMEOUT_S
        )
    wheels = [
        StampedPose(reading.stamp_s, reading.odom_from_body)
        for reading in readings
        if isinstance(reading, OdometryReading)
    ]
    errors = step_errors(run.trajectory, wheels, read_relations(truth))
    return {"errors": asdict(errors), "speed": run.speed_hz}


def _step_metrics(prefix: str, errors: StepErrors) -> Iterator[Metric]:
    yield Metric(f"{prefix}/relations", float(errors.relations), "1", _HIGHER, 0.0)
    for key, value_m, tolerance in (
        ("worst_step", errors.worst_m, _STEP_TOLERANCE),
        ("p99_step", errors.p99_m, _STEP_TOLERANCE),
        ("worst_step_raw", errors.worst_raw_m, None),
        ("worst_step_ours_vs_raw", errors.worst_ours_vs_raw_m, None),
    ):
        yield Metric(f"{prefix}/{key}", value_m, "m", _LOWER, tolerance)


# ------------------------------------------------------------------ memory


def _measure_memory(run: Run) -> Report:
    metrics: list[Metric] = []
    for name, day in (_QUICK_DAYS if run.is_quick else _DAYS).items():
        result = run.once(f"memory/{name}", partial(_watch, day))
        metrics += _memory_metrics(f"memory/{name}", result["settled"], result["late"])
    return Report(tuple(metrics))


def _watch(day: _Day) -> Result:
    instants = simulate(draw(day.family, 0, **day.parameters), day.robot, 0)
    readings = (reading for instant in instants for reading in instant.readings)
    config = load_config(preset_for(day.robot, day.family))
    memory = resident_memory(readings, config, until_s=_LATE_S)
    return {"settled": memory.at(_SETTLED_S), "late": memory.at(_LATE_S)}


def _memory_metrics(prefix: str, settled_bytes: float, late_bytes: float) -> Iterator[Metric]:
    growth_mb = (late_bytes - settled_bytes) / _MB
    ratio = late_bytes / settled_bytes
    yield Metric(f"{prefix}/growth", growth_mb, "MB", _LOWER, None)
    yield Metric(f"{prefix}/growth_ratio", ratio, "1", _LOWER, _RESIDENT_TOLERANCE)
    yield Metric(f"{prefix}/resident", late_bytes / _MB, "MB", _LOWER, None)
