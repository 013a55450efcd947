"""Our chain in a process of its own, so that its memory is its own and not the benchmark's.

`run_chain` runs this module as a program: it reads the readings back one by one, as `hmt run` would
map them, and says what every scan has cost.

References: own.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import psutil

from benchmarks.handover import PoseRecord, Record, SweepRecord, read_records, write_record
from benchmarks.processes import MemorySample, run_child
from benchmarks.stages import StageClock
from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Event, EventKind, OdometryReading, Reading, Scan, StampedPose
from hmt_service.runtime.offline import map_readings

_ROOT = Path(__file__).parents[1]
_SCANS_ONLY = "--scans-only"


@dataclass(frozen=True, slots=True, eq=False)
class ChainRun:
    """What our chain did with one log."""

    busy_s: float
    """Time inside odometry and engine, all scans, as a clock on the wall shows it."""
    spent_s: FloatArray
    """Processor time of each `Stage` up to each scan and up to the end, (scans + 1, stages)."""
    empty_bytes: float
    """Resident memory before the first scan."""
    memory_bytes: FloatArray
    """Resident memory after each scan, shape (scans,)."""
    trajectory: tuple[StampedPose, ...]
    """Globally consistent poses of the scans."""
    areas: FloatArray
    """Different areas entered up to each scan, shape (scans,)."""
    loop_closures: int
    """How many visits of the best hypothesis are to areas known before."""
    samples: tuple[MemorySample, ...]
    """The memory as seen from outside."""

    @property
    def cpu_s(self) -> float:
        """Processor time of all stages."""
        return float(self.spent_s[-1].sum())


def write_readings(readings: Iterable[Reading], path: Path) -> int:
    """Write readings to a file that `run_chain` and other programs can read.

    Returns:
        Number of scans among them.
    """
    scans = 0
    with path.open("wb") as file:
        for reading in readings:
            write_reading(file, reading)
            scans += isinstance(reading, Scan)
    return scans


def write_reading(file: BinaryIO, reading: Reading) -> None:
    """Append one reading to a file that `run_chain` and other programs can read."""
    write_record(file, _record(reading))


def run_chain(
    readings: Path, config: Config, folder: Path, *, timeout_s: float, has_odometry: bool = True
) -> ChainRun:
    """Map the readings of a file in a process of its own.

    Args:
        readings: File that `write_readings` has written.
        config: Settings of all stages.
        folder: Where the process may leave its result.
        timeout_s: Longest that it may take.
        has_odometry: Whether it may use the odometry among the readings.

    Raises:
        ChildFailed: If it fails or takes longer.
    """
    result = folder / "chain.npz"
    arguments = [str(readings.resolve()), str(result.resolve()), config.model_dump_json()]
    child = run_child(
        [sys.executable, "-m", __name__, *arguments, *([] if has_odometry else [_SCANS_ONLY])],
        timeout_s=timeout_s,
        folder=_ROOT,
    )
    with np.load(result) as arrays:
        trajectory = tuple(
            StampedPose(float(stamp_s), pose)
            for stamp_s, pose in zip(arrays["stamps_s"], arrays["poses"], strict=True)
        )
        return ChainRun(
            busy_s=float(arrays["busy_s"]),
            spent_s=arrays["spent_s"],
            empty_bytes=float(arrays["empty_bytes"]),
            memory_bytes=arrays["memory_bytes"],
            trajectory=trajectory,
            areas=arrays["areas"],
            loop_closures=int(arrays["loop_closures"]),
            samples=child.samples,
        )


def _record(reading: Reading) -> Record:
    if isinstance(reading, OdometryReading):
        return PoseRecord(reading.stamp_s, reading.odom_from_body)
    times = reading.point_times
    return SweepRecord(reading.stamp_s, reading.points_in_body, reading.sensor_in_body, times)


def read_readings(path: Path) -> Iterator[Reading]:
    """Yield the readings of a file that `write_readings` has written."""
    for record in read_records(path):
        if isinstance(record, PoseRecord):
            yield OdometryReading(record.stamp_s, record.pose)
        else:
            yield Scan(record.stamp_s, record.points, record.sensor, record.times)


def _map(readings: Iterable[Reading], result: Path, config: Config) -> None:
    """Map in this process, and leave what it did and cost in a file."""
    process, clock = psutil.Process(), StageClock(now_s=time.process_time)
    empty_bytes: list[float] = []
    entered: set[float] = set()

    def enter(event: Event) -> None:
        if event.kind is EventKind.AREA_ENTERED:
            entered.add(event.numbers["area"])

    def row() -> FloatArray:
        rss = float(process.memory_info().rss)
        return np.array([float(len(entered)), rss, *clock.spent_s.values()])

    def measured() -> Iterator[Reading]:
        # Asked for the first time when all code is loaded, and there is no map yet.
        empty_bytes.append(float(process.memory_info().rss))
        yield from readings

    # What is measured is not kept in the memory that is measured.
    with tempfile.TemporaryFile() as file, clock.running():
        engine, cost = map_readings(
            measured(),
            config,
            on_scan=lambda: file.write(row().tobytes()),
            on_event=enter,
        )
        file.write(row().tobytes())
        file.seek(0)
        rows = np.frombuffer(file.read()).reshape(-1, 2 + len(clock.spent_s))
    trajectory, snapshot = engine.trajectory(), engine.snapshot()
    best = None if snapshot is None else snapshot.posterior.hypotheses[0]
    np.savez(
        result,
        busy_s=cost.busy_s,
        spent_s=rows[:, 2:],
        empty_bytes=empty_bytes[0],
        memory_bytes=rows[:-1, 1],
        areas=rows[:-1, 0].astype(int),
        stamps_s=np.array([pose.stamp_s for pose in trajectory]),
        poses=np.array([pose.reference_from_body for pose in trajectory]),
        loop_closures=0 if best is None else best.loop_closures,
    )


def _main(readings: str, result: str, config: str, *options: str) -> None:
    kept = (
        reading
        for reading in read_readings(Path(readings))
        if isinstance(reading, Scan) or _SCANS_ONLY not in options
    )
    _map(kept, Path(result), Config.model_validate_json(config))


if __name__ == "__main__":
    _main(*sys.argv[1:])
