"""Recorded logs, or pieces of them, as the benchmarks take them.

References: own.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from hmt_service.core.config import Config
from hmt_service.core.types import Reading, Scan
from hmt_service.io.logs import read_log


def first_scans(readings: Iterable[Reading], scans: int | None) -> tuple[Reading, ...]:
    """Return the readings up to and including scan number `scans`; all of them for None."""
    return tuple(readings) if scans is None else tuple(_until(readings, scans))


def _until(readings: Iterable[Reading], scans: int) -> Iterator[Reading]:
    for reading in readings:
        yield reading
        scans -= isinstance(reading, Scan)
        if scans <= 0:
            return


@dataclass(frozen=True, slots=True)
class Missing:
    """A recorded file that cannot be used."""

    reason: str
    """Why not, for a person; names no folder of this machine."""


def recorded_file(name: str, folder: str = "2d") -> Path | Missing:
    """Return a file below a folder of `HMT_DATA`, or why there is none."""
    data = os.environ.get("HMT_DATA")
    if not data:
        return Missing("HMT_DATA does not name the folder of recorded logs")
    path = Path(data) / folder / name
    if not path.is_file():
        return Missing(f"no file {folder}/{name} in the folder that HMT_DATA names")
    return path


def read_recorded(path: Path, config: Config) -> Iterable[Reading]:
    """Return the readings of a recorded log as `hmt run` sees them, again and again."""
    sensor = config.sensor
    return read_log(path, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m).readings
