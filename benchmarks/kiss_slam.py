"""KISS-SLAM from PyPI in an environment of its own, and what it does with a log.

It needs other versions of packages than we do, so it never shares our environment. Its default
settings are used: what the benchmark of a peer tunes, it tunes against it.

References:
    Guadagnino et al., KISS-SLAM, IROS 2025.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.chain import write_reading
from benchmarks.processes import MemorySample, run_child
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Reading, StampedPose

PINS = (
    "kiss-slam==0.0.2",
    "kiss-icp==1.3.0",
    "map_closures==2.2.0",
    # 0.20 does not load without libusb and libEGL, but is the first for Python 3.13.
    'open3d==0.19.0; python_version < "3.13"',
    'open3d==0.20.0; python_version >= "3.13"',
    "psutil==7.2.2",
)
"""What is installed; pip adds what these need."""
_ROOT = Path(__file__).parents[1]
_CREATE_S, _INSTALL_S, _IMPORT_S, _MAP_S = 120.0, 1_800.0, 120.0, 3_600.0
ENVIRONMENT = "kiss-slam-environment"
"""Name of the folder that benchmarks share."""


@dataclass(frozen=True, slots=True, eq=False)
class KissSlamRun:
    """What KISS-SLAM did with one log."""

    busy_s: float
    """Time inside it, all scans and the optimisation at the end, by a clock on the wall."""
    cpu_s: float
    """Processor time of the same, all threads."""
    empty_bytes: float
    """Resident memory before the first scan."""
    memory_bytes: FloatArray
    """Resident memory after each scan, shape (scans,)."""
    trajectory: tuple[StampedPose, ...]
    """Optimised poses of the scans."""
    loop_closures: int
    """How many it has found."""
    samples: tuple[MemorySample, ...]
    """The memory as seen from outside."""


def find_environment(folder: Path) -> Path | None:
    """Return the Python of an environment that `make_environment` has completed with these pins.

    Args:
        folder: The environment.
    """
    try:
        is_complete = _marker(folder).read_text() == _signature()
    except OSError:
        return None
    return _python(folder) if is_complete else None


def make_environment(folder: Path) -> Path:
    """Return the Python of an environment with KISS-SLAM, made unless it is there already.

    Args:
        folder: The environment, about 2 GB; made anew if it is not complete.

    Raises:
        ChildFailed: If the packages cannot be installed, or do not load on this machine.
    """
    if found := find_environment(folder):
        return found
    shutil.rmtree(folder, ignore_errors=True)
    run_child([sys.executable, "-m", "venv", folder.resolve()], timeout_s=_CREATE_S)
    python = _python(folder)
    run_child([python, "-m", "pip", "install", "--quiet", *PINS], timeout_s=_INSTALL_S)
    run_child([python, "-c", "import kiss_slam.slam"], timeout_s=_IMPORT_S)
    _marker(folder).write_text(_signature())
    return python


def run_kiss_slam(python: Path, readings: Path, folder: Path, *, timeout_s: float) -> KissSlamRun:
    """Map the scans of a file.

    Args:
        python: What `make_environment` has returned.
        readings: File that `chain.write_readings` has written; odometry in it is not used.
        folder: Where to leave the result.
        timeout_s: Longest that it may take.

    Raises:
        ChildFailed: If it fails or takes longer.
    """
    result = folder / "kiss-slam.npz"
    arguments = [readings.resolve(), result.resolve()]
    child = run_child(
        [python, "-m", "benchmarks.kiss_slam_runner", *arguments],
        timeout_s=timeout_s,
        folder=_ROOT,
    )
    with np.load(result) as arrays:
        poses = zip(arrays["stamps_s"].tolist(), arrays["poses"], strict=True)
        return KissSlamRun(
            busy_s=float(arrays["busy_s"]),
            cpu_s=float(arrays["cpu_s"]),
            empty_bytes=float(arrays["empty_bytes"]),
            memory_bytes=arrays["memory_bytes"],
            trajectory=tuple(StampedPose(stamp_s, pose) for stamp_s, pose in poses),
            loop_closures=int(arrays["loop_closures"]),
            samples=child.samples,
        )


class KissSlamPeer:
    """Keeps what a robot sends in a file, and lets KISS-SLAM map it when all of it is there."""

    def __init__(self, python: Path, folder: Path) -> None:
        """Begin without a scan.

        Args:
            python: What `make_environment` has returned.
            folder: Where to keep the scans and leave the result.
        """
        self._python, self._folder = python, folder
        self._readings = folder / "readings"
        self._file = self._readings.open("wb")

    def take(self, reading: Reading) -> None:
        """Take what the robot sends."""
        write_reading(self._file, reading)

    def poses(self, stamps_s: FloatArray) -> FloatArray:
        """Return where the robot was at the scans nearest to some stamps, shape (K, 4, 4).

        Raises:
            ChildFailed: If KISS-SLAM fails or takes longer than an hour.
        """
        self._file.close()
        run = run_kiss_slam(self._python, self._readings, self._folder, timeout_s=_MAP_S)
        known_s = np.array([pose.stamp_s for pose in run.trajectory])
        nearest = np.abs(known_s[None] - stamps_s[:, None]).argmin(axis=1)
        return np.array([run.trajectory[index].reference_from_body for index in nearest])


def _python(folder: Path) -> Path:
    return folder.resolve() / "bin" / "python"


def _marker(folder: Path) -> Path:
    return folder / "complete.txt"


def _signature() -> str:
    return "\n".join((sys.version, *PINS))
