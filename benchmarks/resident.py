"""Resident memory of a process that does nothing but odometry, over the time of the robot.

The process gets one reading at a time through a pipe and answers with its memory, so that neither
what makes the readings nor a log of them counts: what grows is the odometry.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection

import numpy as np
import psutil

from benchmarks.processes import ChildFailed
from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import InvalidInput

# A median over so long: an allocator keeps a page more or less for a moment.
_WINDOW_S = 10.0
_STOP_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class ResidentMemory:
    """Memory after each scan."""

    stamps_s: FloatArray
    """Stamps of the scans, ascending, shape (N,)."""
    rss_bytes: FloatArray
    """Resident memory after each, shape (N,)."""

    def at(self, elapsed_s: float) -> float:
        """Return the median memory over the 10 s up to some time since the first scan, in bytes.

        Raises:
            InvalidInput: If the scans end before.
        """
        since_s = self.stamps_s - self.stamps_s[0]
        if since_s[-1] < elapsed_s:
            raise InvalidInput(f"scans of {since_s[-1]:g} s tell no memory at {elapsed_s:g} s")
        is_near = (since_s > elapsed_s - _WINDOW_S) & (since_s <= elapsed_s)
        return float(np.median(self.rss_bytes[is_near]))


def resident_memory(
    readings: Iterable[Reading], config: Config, *, until_s: float
) -> ResidentMemory:
    """Run our odometry in a process of its own, and watch its memory.

    Args:
        readings: In the order of time; taken as they are needed, none is held.
        config: Settings of all stages.
        until_s: Time since the first scan at which to stop.

    Raises:
        ChildFailed: If the process ends before the readings do.
    """
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_answer, args=(there, config), daemon=True)
    process.start()
    there.close()
    try:
        samples = list(_samples(here, readings, until_s))
    except (EOFError, OSError) as error:
        process.join(_STOP_S)
        raise ChildFailed(f"the odometry ended with code {process.exitcode}") from error
    finally:
        here.close()
        process.join(_STOP_S)
        process.kill()
        process.join()
    stamps_s, rss_bytes = np.array(samples).T
    return ResidentMemory(stamps_s, rss_bytes)


def _samples(
    connection: Connection, readings: Iterable[Reading], until_s: float
) -> Iterator[tuple[float, float]]:
    """Yield the stamp of each scan and the memory after it."""
    first_s: float | None = None
    for reading in readings:
        connection.send(reading)
        rss_bytes = float(connection.recv())
        if not isinstance(reading, Scan):
            continue
        yield reading.stamp_s, rss_bytes
        first_s = reading.stamp_s if first_s is None else first_s
        if reading.stamp_s - first_s >= until_s:
            return


def _answer(connection: Connection, config: Config) -> None:
    """Track what comes through the pipe, and say how much memory there is; runs by itself."""
    odometry, process = Odometry(config), psutil.Process()
    with suppress(EOFError, BrokenPipeError):  # nobody is interested any more
        while True:
            odometry.process(connection.recv())
            connection.send(process.memory_info().rss)
