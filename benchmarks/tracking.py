"""One odometry alone in a process of its own: its trajectory, and what it costs.

`run_tracker` runs this module as a program. It reads the scans of a file one by one and first takes
some of them with a tracker that is thrown away, so that nothing is loaded or compiled while time is
taken. Time is processor time inside the tracker, with one thread per library.

Ours is `Odometry` with its keyframes chained: no areas, no topology, no loop. KISS-ICP is its own
pipeline with its own defaults, but for the sensor's range, which its voxel follows from, and one
thread. Its poses belong to the moment of the last return of a sweep, whither its preprocessing
carries all points (`cpp/kiss_icp/core/Preprocessing.cpp`, 1.3.0; held to by a test), not to the end
of the sweep: each is stamped with that moment.

References:
    Vizzo et al., KISS-ICP, RA-L 2023.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from itertools import islice
from pathlib import Path
from typing import Protocol

import numpy as np

from benchmarks.chain import read_readings
from benchmarks.processes import run_child
from hmt_service.core.config import Config, Preset, load_config
from hmt_service.core.geometry import identity
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Reading, Scan, StampedPose

_ROOT = Path(__file__).parents[1]
_WARM_READINGS = 20
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)


class Program(StrEnum):
    """What can track scans."""

    HMT = "hmt"
    """Ours, with all readings."""
    HMT_SCANS_ONLY = "hmt_scans_only"
    """Ours, from the scans alone."""
    KISS_ICP = "kiss_icp"
    """KISS-ICP's own pipeline, which takes scans only."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackingRun:
    """What one odometry did with some scans."""

    trajectory: tuple[StampedPose, ...]
    """Pose at each scan, at the moment that it belongs to, in a frame that starts at the first."""
    cpu_s: float
    """Processor time of all scans."""
    failures: int
    """Scans that ours could not register; 0 for KISS-ICP, which does not tell."""

    @property
    def speed_hz(self) -> float:
        """Scans per second of processor time."""
        return len(self.trajectory) / self.cpu_s


class Tracker(Protocol):
    """An odometry that gives every scan a pose in one frame."""

    failures: int
    """Scans that could not be registered."""

    def track(self, reading: Reading) -> StampedPose | None:
        """Return the pose of a scan; None for a reading that is none."""


class ChainedOdometry:
    """Our odometry, its keyframes chained to one trajectory."""

    def __init__(self, config: Config, *, has_odometry: bool = True) -> None:
        """Start without a map.

        Args:
            config: Settings of all stages.
            has_odometry: Whether it may use the odometry among the readings.
        """
        self.failures = 0
        self._odometry = Odometry(config)
        self._has_odometry = has_odometry
        self._start_from_keyframe = identity()

    def track(self, reading: Reading) -> StampedPose | None:
        """Return the pose of a scan; None for odometry."""
        if not (self._has_odometry or isinstance(reading, Scan)):
            return None
        tracking = self._odometry.process(reading)
        if tracking is None:
            return None
        self.failures += tracking.failure is not None
        if tracking.keyframe is not None:
            motion = tracking.keyframe.previous_from_body.mean
            self._start_from_keyframe = self._start_from_keyframe @ motion
        pose = self._start_from_keyframe @ tracking.keyframe_from_body.mean
        return StampedPose(tracking.stamp_s, pose)


class KissIcp:
    """KISS-ICP's own pipeline, with the settings that it reads from its environment variables."""

    def __init__(self) -> None:
        """Start without a map."""
        # Only where it runs as a program: the cap on its threads holds for a whole process.
        from kiss_icp.config import load_config as load_kiss_icp_config
        from kiss_icp.kiss_icp import KissICP

        self.failures = 0
        self._pipeline = KissICP(load_kiss_icp_config(None))
        self._before_s: float | None = None

    def track(self, reading: Reading) -> StampedPose | None:
        """Return the pose of a scan; None for odometry."""
        if not isinstance(reading, Scan):
            return None
        times = np.zeros(0) if reading.point_times is None else reading.point_times
        self._pipeline.register_frame(reading.points_in_body, times)
        moment_s = moment_of(reading, self._before_s)
        self._before_s = reading.stamp_s
        return StampedPose(moment_s, np.array(self._pipeline.last_pose))


def moment_of(scan: Scan, before_s: float | None) -> float:
    """Return when the last return of a scan was taken, which KISS-ICP's pose belongs to.

    Args:
        scan: Its stamp is the end of its sweep.
        before_s: Stamp of the scan before, where the sweep began; None: unknown, the robot stands.
    """
    if scan.point_times is None or not len(scan.point_times) or before_s is None:
        return scan.stamp_s
    return scan.stamp_s - (1.0 - float(scan.point_times.max())) * (scan.stamp_s - before_s)


def run_tracker(
    program: Program, readings: Path, preset: Preset, folder: Path, *, timeout_s: float
) -> TrackingRun:
    """Track the scans of a file in a process of its own.

    Args:
        program: What tracks them.
        readings: File that `chain.write_readings` has written, with a scan at least.
        preset: Our settings for the kind of sensor; KISS-ICP takes the range from them.
        folder: Where the process may leave its result.
        timeout_s: Longest that it may take.

    Raises:
        ChildFailed: If it fails or takes longer.
    """
    result = folder / f"{program}.npz"
    arguments = [readings.resolve(), result.resolve(), program.value, preset.value]
    run_child(
        [sys.executable, "-m", __name__, *arguments],
        timeout_s=timeout_s,
        folder=_ROOT,
        environment={**_ONE_THREAD, **kiss_icp_variables(load_config(preset).sensor.max_range_m)},
    )
    with np.load(result) as arrays:
        poses = zip(arrays["stamps_s"].tolist(), arrays["poses"], strict=True)
        return TrackingRun(
            trajectory=tuple(StampedPose(stamp_s, pose) for stamp_s, pose in poses),
            cpu_s=float(arrays["cpu_s"]),
            failures=int(arrays["failures"]),
        )


def kiss_icp_variables(max_range_m: float) -> dict[str, str]:
    """Return the environment variables that KISS-ICP's own loader takes its settings from.

    Args:
        max_range_m: Range of the sensor; the voxel is a hundredth of it by KISS-ICP's default.
    """
    return {
        "KISS_ICP_DATA": json.dumps({"max_range": max_range_m}),
        "KISS_ICP_REGISTRATION": json.dumps({"max_num_threads": 1}),
    }


def _tracker(program: Program, preset: Preset) -> Tracker:
    if program is Program.KISS_ICP:
        return KissIcp()
    return ChainedOdometry(load_config(preset), has_odometry=program is Program.HMT)


def _track(tracker: Tracker, readings: Iterable[Reading]) -> tuple[list[StampedPose], float]:
    """Return the poses of the scans, and the processor time inside the tracker."""
    poses: list[StampedPose] = []
    cpu_s = 0.0
    for reading in readings:
        started_s = time.process_time()
        pose = tracker.track(reading)
        cpu_s += time.process_time() - started_s
        if pose is not None:
            poses.append(pose)
    return poses, cpu_s


def _main(readings: str, result: str, program: str, preset: str) -> None:
    path, kind = Path(readings), (Program(program), Preset(preset))
    _track(_tracker(*kind), islice(read_readings(path), _WARM_READINGS))
    tracker = _tracker(*kind)
    poses, cpu_s = _track(tracker, read_readings(path))
    np.savez(
        result,
        stamps_s=np.array([pose.stamp_s for pose in poses]),
        poses=np.array([pose.reference_from_body for pose in poses]),
        cpu_s=cpu_s,
        failures=tracker.failures,
    )


if __name__ == "__main__":
    _main(*sys.argv[1:])
