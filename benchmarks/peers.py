"""Our chain beside KISS-SLAM on the same LiDAR scans: accuracy, speed and memory in one run.

Each maps alone in a process of its own, one after the other, from one file of scans. `hmt` uses all
readings; `hmt_scans_only` leaves the odometry out, which KISS-SLAM takes none of. KISS-SLAM runs
with its default settings: a voxel of 1 m, and as many threads as there are cores where ours has
one. *Speed* counts the time inside the methods that map, the optimisation at the end included;
*cpu* is the processor time of the same, all threads, which other work hardly touches.
*Map memory* is what the resident memory grows by from just before the first scan to the last one,
*peak memory* the largest as seen from outside, libraries included.

References:
    Guadagnino et al., KISS-SLAM, IROS 2025.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import islice
from pathlib import Path
from statistics import fmean

from benchmarks.cells import Result
from benchmarks.chain import ChainRun, read_readings, run_chain, write_readings
from benchmarks.kiss_slam import (
    ENVIRONMENT,
    KissSlamRun,
    find_environment,
    make_environment,
    run_kiss_slam,
)
from benchmarks.kitti import read_truth
from benchmarks.metric import Direction, Metric
from benchmarks.processes import ChildFailed
from benchmarks.recordings import Missing, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.revisits import gap_m, revisits
from benchmarks.simulated import readings_of
from benchmarks.trajectories import TrajectoryErrors, mean_errors, metrics_of, trajectory_errors
from hmt_service.core.config import Preset, load_config
from hmt_service.core.types import OdometryReading, StampedPose
from hmt_service.sim.simulation import LIDAR, simulate
from hmt_service.sim.worlds.families import Family, draw

Source = Callable[[Path], tuple[StampedPose, ...]]
"""Writes the readings of a drive to a file, and returns the true poses; none where unknown."""

_TIMEOUT_S = 3_600.0
_MB = 1e6
_QUICK_SCANS = 60
# Its robot turns a corner within these scans: errors along a line could not be told.
_QUICK_SEED = 2
_SEEDS: Mapping[Family, Sequence[int]] = {Family.GARAGE: range(1), Family.CAMPUS: range(1)}
# 300 m, before its first loop: all of it would take an hour.
_SCANS: Mapping[Family, int] = {Family.CAMPUS: 1_000}
_CPU_TOLERANCE = 0.3
_MEMORY_TOLERANCE = 0.3
_ERROR_TOLERANCE = 0.5
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER
_PEER = "kiss_slam"
_COSTS = {
    "speed": ("scans/s", _HIGHER),
    "cpu_per_scan": ("ms", _LOWER),
    "map_memory": ("MB", _LOWER),
    "peak_memory": ("MB", _LOWER),
    "loop_closures": ("1", _HIGHER),
}


def measure(run: Run) -> Report:
    """Map every drive that is there with both."""
    folder = run.out.parent / ENVIRONMENT
    try:
        run.say("installing KISS-SLAM")
        python = find_environment(folder) if run.is_quick else make_environment(folder)
    except ChildFailed as error:
        reason = str(error).splitlines()
        return Report(
            (), (f"all: KISS-SLAM cannot be installed: {reason[0]} {reason[-1].strip()}",)
        )
    if python is None:
        return Report((), ("all: KISS-SLAM is not installed, which only a full run does",))
    drives, skipped = _drives(run.is_quick)
    results: dict[str, list[Result]] = {}
    for name, sources in drives.items():
        for number, source in enumerate(sources):
            compute = partial(_compare, python, source)
            results.setdefault(name, []).append(run.once(f"{name}/{number}", compute))
    metrics = [metric for name in results for metric in _metrics(name, results[name])]
    return Report(tuple(metrics), tuple(skipped))


def _drives(is_quick: bool) -> tuple[dict[str, list[Source]], list[str]]:
    """Return the drives by name, and what there is none of."""
    if is_quick:
        return {"garage": [partial(_simulated, Family.GARAGE, _QUICK_SEED, _QUICK_SCANS)]}, []
    drives: dict[str, list[Source]] = {
        family.value: [partial(_simulated, family, seed, _SCANS.get(family)) for seed in seeds]
        for family, seeds in _SEEDS.items()
    }
    skipped = []
    for name, file, source in (
        ("kitti00_part", "kitti00-part/poses.txt", _kitti),
        ("imm_ring", "imm-ring.mcap", _recorded),
    ):
        path = recorded_file(file, "3d")
        if isinstance(path, Missing):
            skipped.append(f"{name}: {path.reason}")
        else:
            drives[name] = [partial(source, path)]
    return drives, skipped


def _simulated(family: Family, seed: int, scans: int | None, path: Path) -> tuple[StampedPose, ...]:
    truth: list[StampedPose] = []
    instants = islice(simulate(draw(family, seed), LIDAR, seed), scans)
    write_readings(readings_of(instants, truth), path)
    return tuple(truth)


def _kitti(poses: Path, path: Path) -> tuple[StampedPose, ...]:
    write_readings(read_recorded(poses.parent, load_config(Preset.OUTDOOR)), path)
    return read_truth(poses.parent)


def _recorded(log: Path, path: Path) -> tuple[StampedPose, ...]:
    write_readings(read_recorded(log, load_config(Preset.OUTDOOR)), path)
    return ()


def _compare(python: Path, source: Source) -> Result:
    """Map one drive with all programs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        readings = folder / "readings"
        truth = source(readings)
        chain = partial(
            run_chain, readings, load_config(Preset.OUTDOOR), folder, timeout_s=_TIMEOUT_S
        )
        runs: dict[str, ChainRun | KissSlamRun] = {"hmt": chain()}
        if any(isinstance(reading, OdometryReading) for reading in read_readings(readings)):
            runs["hmt_scans_only"] = chain(has_odometry=False)
        runs[_PEER] = run_kiss_slam(python, readings, folder, timeout_s=_TIMEOUT_S)
        pairs = () if truth else revisits(read_readings(readings))
    return {
        side: {
            "costs": _costs(run),
            **(
                {"errors": asdict(trajectory_errors(run.trajectory, truth))}
                if truth
                else {"revisit_gap_m": gap_m(pairs, run.trajectory)}
            ),
        }
        for side, run in runs.items()
    }


def _costs(run: ChainRun | KissSlamRun) -> dict[str, float]:
    return {
        "speed": len(run.memory_bytes) / run.busy_s,
        "cpu_per_scan": 1e3 * run.cpu_s / len(run.memory_bytes),
        "map_memory": (float(run.memory_bytes[-1]) - run.empty_bytes) / _MB,
        "peak_memory": max(sample.rss_bytes for sample in run.samples) / _MB,
        "loop_closures": float(run.loop_closures),
    }


def _metrics(name: str, results: Sequence[Result]) -> Iterator[Metric]:
    """Yield the numbers of one kind of drive, means over its seeds."""
    for key, direction, tolerance in (
        ("speed", _HIGHER, None),
        ("cpu_per_scan", _LOWER, _CPU_TOLERANCE),
        ("map_memory", _LOWER, _MEMORY_TOLERANCE),
        ("peak_memory", _LOWER, _MEMORY_TOLERANCE),
    ):
        ratio = _mean_cost(results, "hmt", key) / _mean_cost(results, _PEER, key)
        yield Metric(f"{name}/{key}_over_{_PEER}", ratio, "1", direction, tolerance)
    ratio = _error_m(results, "hmt") / _error_m(results, _PEER)
    yield Metric(f"{name}/error_over_{_PEER}", ratio, "1", _LOWER, _ERROR_TOLERANCE)
    for side in results[0]:
        prefix = f"{name}/{side}"
        for key, (unit, direction) in _COSTS.items():
            yield Metric(f"{prefix}/{key}", _mean_cost(results, side, key), unit, direction, None)
        for metric in _error_metrics(prefix, [result[side] for result in results]):
            # What others do is no reason to fail; of ours, the ratios are gated.
            yield replace(metric, rel_tol=None)


def _error_metrics(prefix: str, sides: Sequence[Result]) -> Iterable[Metric]:
    if "errors" in sides[0]:
        return metrics_of(prefix, mean_errors([TrajectoryErrors(**s["errors"]) for s in sides]))
    gap = fmean(side["revisit_gap_m"] for side in sides)
    return (Metric(f"{prefix}/revisit_gap", gap, "m", _LOWER, None),)


def _error_m(results: Sequence[Result], side: str) -> float:
    return fmean(
        result[side]["errors"]["absolute_rmse_m"]
        if "errors" in result[side]
        else result[side]["revisit_gap_m"]
        for result in results
    )


def _mean_cost(results: Sequence[Result], side: str, key: str) -> float:
    return fmean(result[side]["costs"][key] for result in results)
