"""A map that grows in a process of its own, and what it takes there: time, memory, file.

The process gets its readings through a pipe, so that whatever makes them takes nothing of its time
and memory. It says what they have cost as it goes along, so that what is known is never lost. Costs
are processor time: all of the work is done by one thread, and does not wait for anything.

References: own.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import psutil

from hmt_service.core.config import Config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import EventKind, MapMethod, Reading
from hmt_service.io.map_file import write_map

_STOP_S = 5.0
_LONGEST = 160
"""Characters of an error that are told."""


@dataclass(frozen=True, slots=True)
class Entry:
    """The robot has entered an area, known or new."""

    areas: int
    """Different areas entered so far."""
    entry_s: float
    """Time of the scan at which that was decided, odometry included."""
    scans: int
    """Scans between the entry before and that one."""
    scans_s: float
    """Time of all these."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What a map of so many areas takes."""

    areas: int
    """How many."""
    consistent_s: float
    """Time of a globally consistent map without points, the map being new."""
    shortest_path_s: float
    """Time of a map along shortest paths without points."""
    snapshot_s: float
    """Time of what the daemon asks after each keyframe, the map being known already."""
    save_s: float
    """Time to write the map file."""
    memory_bytes: int
    """Resident memory that has come since the start."""
    file_bytes: int
    """Size of the map file."""


@dataclass(frozen=True, slots=True)
class End:
    """The drive is over; always the last thing said."""

    elapsed_s: float
    """Time since the first reading, with everything, by the clock on the wall."""
    is_complete: bool
    """Whether all readings were mapped."""
    failure: str | None = None
    """What went wrong, if something did."""


def drive(
    readings: Iterable[Reading], config: Config, *, checkpoints: Sequence[int], budget_s: float
) -> Generator[Entry | Checkpoint | End, None, None]:
    """Map readings in a process of its own until they, or the time, come to an end.

    What goes wrong there is told at the end: how far a map can grow is a result.

    Args:
        readings: In the order of time; taken as they are needed.
        config: Settings of all stages.
        checkpoints: Numbers of areas at which the map is looked at, ascending.
        budget_s: Time since the first reading, by the clock on the wall, after which none is used.
    """
    context = get_context("spawn")
    here, there = context.Pipe()
    arguments = (there, config, tuple(checkpoints), budget_s)
    process = context.Process(target=_map, args=arguments, daemon=True)
    started_s = time.perf_counter()
    process.start()
    there.close()
    try:
        yield from _exchange(here, readings)
    except (EOFError, OSError):
        process.join(_STOP_S)
        failure = f"the mapping process ended with code {process.exitcode}"
        yield End(time.perf_counter() - started_s, False, failure)
    finally:
        here.close()
        process.join(_STOP_S)
        process.kill()
        process.join()


def _exchange(
    connection: Connection, readings: Iterable[Reading]
) -> Iterator[Entry | Checkpoint | End]:
    """Hand readings over, and yield what is said meanwhile."""
    for reading in readings:
        connection.send(reading)
        while connection.poll():
            message = connection.recv()
            yield message
            if isinstance(message, End):
                return
    connection.send(None)
    while not isinstance(message := connection.recv(), End):
        yield message
    yield message


def _map(
    connection: Connection, config: Config, checkpoints: Sequence[int], budget_s: float
) -> None:
    """Map what comes through the pipe, and say what it takes; runs in a process of its own."""
    with suppress(EOFError, BrokenPipeError):  # nobody is interested any more
        reading = connection.recv()
        started_s = time.perf_counter()
        grown = _Grown(config, checkpoints)
        is_complete, failure = False, None
        try:
            while reading is not None and time.perf_counter() - started_s < budget_s:
                for message in grown.by(reading):
                    connection.send(message)
                reading = connection.recv()
            is_complete = reading is None
        except Exception as error:  # noqa: BLE001 - how far a map can grow is what is asked
            failure = f"{type(error).__name__}: {' '.join(str(error).split())[:_LONGEST]}"
        connection.send(End(time.perf_counter() - started_s, is_complete, failure))
        while True:  # whoever is about to send more must not wait for ever
            connection.recv_bytes()


class _Grown:
    """A map as it grows, and what that has taken."""

    def __init__(self, config: Config, checkpoints: Sequence[int]) -> None:
        self._odometry, self._engine = Odometry(config), Engine(config)
        self._memory_before = _memory_bytes()
        self._awaited = list(checkpoints)
        self._areas: set[float] = set()
        self._scans, self._scans_s = 0, 0.0

    def by(self, reading: Reading) -> Iterator[Entry | Checkpoint]:
        """Map one reading, and yield what there is to say."""
        started_s = time.process_time()
        tracking = self._odometry.process(reading)
        if tracking is None:
            return
        events = self._engine.process(tracking)
        scan_s = time.process_time() - started_s
        entered = [e.numbers["area"] for e in events if e.kind is EventKind.AREA_ENTERED]
        if not entered:
            self._scans, self._scans_s = self._scans + 1, self._scans_s + scan_s
            return
        self._areas.update(entered)
        yield Entry(len(self._areas), scan_s, self._scans, self._scans_s)
        self._scans, self._scans_s = 0, 0.0
        if self._awaited and len(self._areas) >= self._awaited[0]:
            yield _look_at(self._engine, self._awaited.pop(0), self._memory_before)


def _look_at(engine: Engine, areas: int, memory_before: int) -> Checkpoint:
    memory_bytes = _memory_bytes() - memory_before
    # The first one solves the graph, as it does after every change; a snapshot finds it solved.
    consistent_s = _timed(lambda: engine.global_map(MapMethod.CONSISTENT, with_points=False))
    shortest_s = _timed(lambda: engine.global_map(MapMethod.SHORTEST_PATH, with_points=False))
    snapshot_s = _timed(engine.snapshot)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.hmt"
        save_s = _timed(lambda: write_map(path, engine.stored()))
        file_bytes = path.stat().st_size
    return Checkpoint(areas, consistent_s, shortest_s, snapshot_s, save_s, memory_bytes, file_bytes)


def _timed(work: Callable[[], object]) -> float:
    started_s = time.process_time()
    work()
    return time.process_time() - started_s


def _memory_bytes() -> int:
    return int(psutil.Process().memory_info().rss)
