"""Readings in a file that can be read one by one, also by a program without our package.

A stream of numpy arrays: for a scan its stamp, points, sensor position and point times (empty: at
once); for odometry its stamp and pose. A reader holds one record in memory, never the log: what a
program's memory grows by is its map.

References:
    NumPy enhancement proposal 1 (the `.npy` format, which may be concatenated).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SweepRecord:
    """One scan."""

    stamp_s: float
    """Sensor time."""
    points: Array
    """Returns in the robot's frame, shape (N, 3), m."""
    sensor: Array
    """Position of the sensor, shape (3,), m."""
    times: Array | None
    """Capture time of each point as a share of the sweep, shape (N,); None: at once."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseRecord:
    """One odometry reading."""

    stamp_s: float
    """Sensor time."""
    pose: Array
    """Pose in the odometry's frame, shape (4, 4)."""


Record = SweepRecord | PoseRecord


def write_record(file: BinaryIO, record: Record) -> None:
    """Append one record to an open file."""
    arrays: tuple[Array, ...]
    if isinstance(record, SweepRecord):
        arrays = (
            record.points,
            record.sensor,
            np.zeros(0) if record.times is None else record.times,
        )
    else:
        arrays = (record.pose,)
    np.save(file, np.array([record.stamp_s, len(arrays)]))
    for array in arrays:
        np.save(file, array)


def read_records(path: Path) -> Iterator[Record]:
    """Yield the records of a file in their order."""
    size = path.stat().st_size
    with path.open("rb") as file:
        while file.tell() < size:
            stamp_s, count = np.load(file)
            arrays = [np.load(file) for _ in range(int(count))]
            if len(arrays) == 1:
                yield PoseRecord(float(stamp_s), arrays[0])
            else:
                points, sensor, times = arrays
                yield SweepRecord(float(stamp_s), points, sensor, times if len(times) else None)
