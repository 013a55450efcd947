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
from hmt_service.errors import HmtError
from hmt_service.io.map_file import write_map

_STOP_S = 5.0


class DriveFailed(HmtError):
    """The process that maps has ended badly."""


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
    """Whether the readings came to an end; otherwise the time did."""


def drive(
    readings: Iterable[Reading], config: Config, *, checkpoints: Sequence[int], budget_s: float
) -> Generator[Entry | Checkpoint | End, None, None]:
    """Map readings in a process of its own until they, or the time, come to an end.

    Args:
        readings: In the order of time; taken as they are needed.
        config: Settings of all stages.
        checkpoints: Numbers of areas at which the map is looked at, ascending.
        budget_s: Time since the first reading, by the clock on the wall, after which none is used.

    Raises:
        DriveFailed: If the process ends badly.
    """
    context = get_context("spawn")
    here, there = context.Pipe()
    arguments = (there, config, tuple(checkpoints), budget_s)
    process = context.Process(target=_map, args=arguments, daemon=True)
    process.start()
    there.close()
    try:
        yield from _exchange(here, readings)
    except (EOFError, OSError) as error:
        process.join(_STOP_S)
        raise DriveFailed(f"the mapping process ended with code {process.exitcode}") from error
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
        is_complete, elapsed_s = _map_until(connection, config, checkpoints, budget_s)
        connection.send(End(elapsed_s, is_complete))
        while True:  # whoever is about to send more must not wait for ever
            connection.recv_bytes()


def _map_until(
    connection: Connection, config: Config, checkpoints: Sequence[int], budget_s: float
) -> tuple[bool, float]:
    """Return whether all readings were mapped, and how long that took."""
    odometry, engine = Odometry(config), Engine(config)
    memory_before = _memory_bytes()
    awaited = list(checkpoints)
    areas: set[float] = set()
    scans, scans_s = 0, 0.0
    reading = connection.recv()
    started_s = time.perf_counter()
    while reading is not None and time.perf_counter() - started_s < budget_s:
        scan_started_s = time.process_time()
        tracking = odometry.process(reading)
        events = () if tracking is None else engine.process(tracking)
        scan_s = time.process_time() - scan_started_s
        entered = [e.numbers["area"] for e in events if e.kind is EventKind.AREA_ENTERED]
        if entered:
            areas.update(entered)
            connection.send(Entry(len(areas), scan_s, scans, scans_s))
            scans, scans_s = 0, 0.0
            if awaited and len(areas) >= awaited[0]:
                connection.send(_look_at(engine, awaited.pop(0), memory_before))
        elif tracking is not None:
            scans, scans_s = scans + 1, scans_s + scan_s
        reading = connection.recv()
    return reading is None, time.perf_counter() - started_s


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
