"""Resident memory of a process that does nothing but odometry, over the time of the robot.

The process gets one reading at a time through a pipe and answers with its memory, so that neither
what makes the readings nor a log of them counts: what grows is the odometry. It is a program of its
own, so that what its caller has loaded does not count either.

References: own.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import psutil

from benchmarks.processes import ChildFailed
from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import InvalidInput

_ROOT = Path(__file__).parents[1]
# A median over so long: a local map is larger in one place than in another.
_WINDOW_S = 60.0
_STOP_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class ResidentMemory:
    """Memory after each scan."""

    stamps_s: FloatArray
    """Stamps of the scans, ascending, shape (N,)."""
    rss_bytes: FloatArray
    """Resident memory after each, shape (N,)."""

    def at(self, elapsed_s: float) -> float:
        """Return the median memory over the minute up to some time since the first scan, in bytes.

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
    here, there = Pipe()
    with here, there:
        command = [sys.executable, "-m", __name__, str(there.fileno())]
        process = subprocess.Popen(command, pass_fds=[there.fileno()], cwd=_ROOT)
        try:
            there.close()
            here.send(config)
            samples = list(_samples(here, readings, until_s))
        except (EOFError, OSError) as error:
            code = process.wait(_STOP_S)
            raise ChildFailed(f"the odometry ended with code {code}") from error
        finally:
            process.kill()
            process.wait()
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


def _main(descriptor: str) -> None:
    """Track what comes through the pipe, and say how much memory there is."""
    process = psutil.Process()
    with Connection(int(descriptor)) as connection, suppress(EOFError, BrokenPipeError):
        odometry = Odometry(connection.recv())
        while True:
            odometry.process(connection.recv())
            connection.send(process.memory_info().rss)


if __name__ == "__main__":
    _main(*sys.argv[1:])
