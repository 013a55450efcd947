"""What runs in the child processes: the two stages of the engine, each behind a pipe.

The heavy libraries are imported here only, inside the child. A child has one thread and ends by
itself when its pipe does, that is, when the parent is gone, however it died.

References:
    own.
"""

from __future__ import annotations

import logging
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from hmt_service.core.config import Config
from hmt_service.core.types import Event
from hmt_service.errors import DaemonFailure, HmtError, Unavailable
from hmt_service.runtime.messages import (
    CompareRequest,
    Finish,
    Finished,
    Mapped,
    MapRequest,
    Ready,
    Request,
    Result,
    RunReport,
    Save,
    SaveRequest,
    Stop,
    Tracked,
    dump,
    load,
)

_LOG = logging.getLogger(__name__)

T = TypeVar("T")


def run_odometry(work: Connection, config: Config) -> None:
    """Turn readings into trackings until the pipe ends."""
    _leave_signals_to_parent()
    from hmt_service.core.odometry import Odometry

    odometry = Odometry(config)
    processed, busy_s = 0, 0.0
    _send(work, Ready())
    for _, message in _received(work):
        if isinstance(message, Finish):
            _send(work, message)
            continue
        started = time.perf_counter()
        tracking = odometry.process(message)
        busy_s += time.perf_counter() - started
        processed += 1
        _send(work, Tracked(tracking, processed, busy_s))


def run_topology(
    work: Connection, requests: Connection, config: Config, seed: int, save: Save | None
) -> None:
    """Turn trackings into the map until the pipes end, and answer requests between two scans."""
    _leave_signals_to_parent()
    topology = _Topology(config, seed, save)
    _send(work, Ready())
    for connection, message in _received(requests, work):
        if connection is requests:
            _send(requests, topology.answer(message))
        elif isinstance(message, Finish):
            _send(work, topology.finish(message))
        else:
            _send(work, topology.map(message))


class _Topology:
    """The engine, what it has cost, and where it is saved."""

    def __init__(self, config: Config, seed: int, save: Save | None) -> None:
        from hmt_service.core.engine import Engine

        self._engine = Engine(config, seed=seed)
        self._save = save
        self._scans = 0
        self._odometry_busy_s = 0.0
        self._busy_s = 0.0

    def map(self, tracked: Tracked) -> Mapped:
        """Take one scan into the map, unless what it is relative to was thrown away before.

        A daemon that has no time left discards what waits, and may still forward what comes after.
        """
        assert tracked.tracking is not None, "the parent forwards scans only"
        if self._engine.misses(tracked.tracking):
            return Mapped(None, (), self._report())
        started = time.perf_counter()
        events = self._engine.process(tracked.tracking)
        self._busy_s += time.perf_counter() - started
        self._scans += 1
        self._odometry_busy_s = tracked.busy_s
        has_changed = tracked.tracking.keyframe is not None or bool(events)
        return Mapped(self._engine.snapshot() if has_changed else None, events, self._report())

    def finish(self, finish: Finish) -> Mapped:
        """Complete the map and save it."""
        events, finished = self._finished(finish.number, is_urgent=True)
        if not finish.is_urgent:
            # Smoothing takes a while: what there is has been saved, should the daemon be stopped.
            more, finished = self._finished(finish.number, is_urgent=False)
            events = (*events, *more)
        return Mapped(self._engine.snapshot(), events, self._report(), finished)

    def _finished(self, number: int, *, is_urgent: bool) -> tuple[tuple[Event, ...], Finished]:
        started = time.perf_counter()
        events = self._engine.finish(is_urgent=is_urgent)
        self._busy_s += time.perf_counter() - started
        save = self._save
        saved = () if save is None else _guarded(lambda: save(self._engine, self._report()))
        if isinstance(saved, HmtError):
            return events, Finished(number, (), str(saved))
        return events, Finished(number, saved)

    def answer(self, request: Request) -> Result:
        """Return what was asked for, or why there is none."""
        return _guarded(lambda: self._answer(request))

    def _answer(self, request: Request) -> Result:
        match request:
            case MapRequest():
                return self._engine.global_map(
                    request.method,
                    reference_area=request.reference_area,
                    hypothesis=request.hypothesis,
                    with_points=request.with_points,
                )
            case CompareRequest():
                return self._engine.compare(
                    reference_area=request.reference_area, hypothesis=request.hypothesis
                )
            case SaveRequest():
                if self._save is None:
                    raise Unavailable("the daemon has no output folder to save to")
                return self._save(self._engine, self._report())

    def _report(self) -> RunReport:
        return RunReport(self._scans, self._odometry_busy_s, self._busy_s)


def _guarded(answer: Callable[[], T]) -> T | HmtError:
    """Return the answer, or why there is none: no question may cost the map."""
    try:
        return answer()
    except HmtError as error:
        return error
    except OSError as error:
        return DaemonFailure(f"the map was not saved: {error}")
    except Exception as error:  # noqa: BLE001 - whatever it is, the map is still there
        _LOG.exception("a request failed")
        return DaemonFailure(f"the request failed: {error!r}")


def _leave_signals_to_parent() -> None:
    # A terminal or a service manager signals the whole group, and the parent still needs its
    # children to finish.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _send(connection: Connection, message: object) -> None:
    try:
        connection.send_bytes(dump(message))
    except OSError as error:
        raise SystemExit from error  # the parent is gone


def _received(*connections: Connection) -> Iterator[tuple[Connection, Any]]:
    """Yield messages until told to stop; connections that have one take turns."""
    turns = deque(connections)
    while True:
        ready = wait(connections)
        connection = next(c for c in turns if c in ready)
        turns.remove(connection)
        turns.append(connection)
        try:
            message = load(connection.recv_bytes())
        except (EOFError, OSError):
            return  # the parent is gone
        if isinstance(message, Stop):
            return
        yield connection, message
