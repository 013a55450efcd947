"""What runs in the child processes: the two stages of the engine, each behind a pipe.

The heavy libraries are imported here only, inside the child. A child has one thread and ends by
itself when its pipe does, that is, when the parent is gone, however it died.

References:
    own.
"""

from __future__ import annotations

import logging
import math
import signal
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, TypeVar

from hmt_service.core.config import Config
from hmt_service.core.types import Event, EventKind, Snapshot
from hmt_service.errors import (
    DaemonFailure,
    DeadlineExceeded,
    HmtError,
    InvalidInput,
    Unavailable,
)
from hmt_service.runtime.messages import (
    Answer,
    Answered,
    AreaRequest,
    Asked,
    AssertArcRequest,
    CompareRequest,
    Encode,
    Finish,
    Finished,
    Keeper,
    Mapped,
    MapRequest,
    News,
    Ready,
    RelocalizeRequest,
    Request,
    Result,
    RetractArcRequest,
    RunReport,
    Save,
    SaveRequest,
    Stop,
    Tracked,
    TrajectoryRequest,
    Wire,
    dump,
    load,
    parts_of,
)

if TYPE_CHECKING:
    from hmt_service.core.visits import MemoryBudget
    from hmt_service.runtime.recovery import Interrupted, MappedBefore, TrackedBefore

_LOG = logging.getLogger(__name__)
# The map file is written this often, and takes no larger share of the time.
_KEEP_S, _KEEP_SHARE = 1.0, 0.05
# Scans of a robot that stands are no hurry.
_MOST_UNSTORED = 1000
_MOST_WHOLE_BYTES = 8_000_000
"""Largest answer in one piece: whoever passes it on copies it with everything else standing still
(measured: 0.3 s for 100 MB)."""

T = TypeVar("T")


def run_odometry(work: Connection, config: Config) -> None:
    """Turn readings into trackings until the pipe ends."""
    _leave_signals_to_parent()
    from hmt_service.core.odometry import Odometry

    before: TrackedBefore = _opening(work)
    if before.memory is None:
        odometry = Odometry(config)
    else:
        odometry = Odometry.resumed(config, before.memory, before.window)
    processed, busy_s = before.processed, before.busy_s
    _send(work, Ready())
    for _, message in _received(work):
        if isinstance(message, Finish):
            _send(work, message)
            continue
        started = time.perf_counter()
        tracking = odometry.process(message)
        busy_s += time.perf_counter() - started
        processed += 1
        _send(work, Tracked(tracking, processed, busy_s, odometry.memory))


def run_topology(
    work: Connection,
    requests: Connection,
    config: Config,
    seed: int,
    save: Save | None,
    keeper: Keeper | None,
    budget: MemoryBudget | None,
    encode: Encode,
) -> None:
    """Turn trackings into the map until the pipes end, and answer requests between two scans."""
    _leave_signals_to_parent()
    before: MappedBefore = _opening(work)
    topology = _Topology(config, seed, save, keeper, budget, encode, before)

    def keep() -> None:
        # What is in the file must be what the parent knows to be in the map: after the answer.
        topology.keep()
        if topology.has_news:
            _send(work, topology.news())

    with closing(topology):
        _send(work, topology.ready())
        _send(work, topology.news())
        for connection, message in _received(requests, work, idle=keep):
            if connection is requests:
                results = topology.answer(message)
                if topology.has_news:
                    _send(work, topology.news())
                for result in results:
                    _send(requests, Answered(message.number, result))
            elif isinstance(message, Finish):
                _send(work, topology.finish(message))
            else:
                _send(work, topology.map(message))
                keep()


class _Topology:
    """The engine, what it has cost, and where it is saved."""

    def __init__(
        self,
        config: Config,
        seed: int,
        save: Save | None,
        keeper: Keeper | None,
        budget: MemoryBudget | None,
        encode: Encode,
        before: MappedBefore,
    ) -> None:
        from hmt_service.core.engine import Engine

        report, interrupted = before.report, before.interrupted
        if keeper is None:
            self._engine = Engine(config, seed=seed, budget=budget)
        else:
            first = None if interrupted is None else interrupted.first_keyframe
            self._engine = keeper.engine(config, seed=seed, budget=budget, first_of_session=first)
        self._save = save
        self._encode = encode
        self._keeper = None if keeper is None or keeper.is_frozen else keeper
        self._stored_keyframes = self._engine.keyframes
        self._stored_scans = self._engine.scans
        self._is_stale = False
        self.has_news = False
        self._kept_s = -math.inf
        self._pause_s = _KEEP_S
        self._untold: tuple[Event, ...] = ()
        self._scans = report.scans
        self._odometry_busy_s = report.odometry_busy_s
        self._busy_s = report.topology_busy_s
        if interrupted is not None:
            self._replay(interrupted)

    def _replay(self, interrupted: Interrupted) -> None:
        """Take in what was in the map before, and is not in the file.

        Raises:
            DaemonFailure: If some of it is lost.
        """
        missing = interrupted.known_scans - self._engine.scans
        kept = len(interrupted.journal)
        if not 0 <= missing <= kept:
            raise DaemonFailure(f"{missing} scans are not in the map file, {kept} are kept")
        for data in interrupted.journal[kept - missing :]:
            tracked: Tracked = load(data)
            assert tracked.tracking is not None, "only scans are kept"
            self._engine.process(tracked.tracking)
        if interrupted.wakes_up:
            self._engine.relocalize()

    def ready(self) -> Ready:
        """Return what the session begins with."""
        return Ready(self._engine.first_of_session)

    def news(self) -> News:
        """Return the map, and what has happened to it although no scan has come."""
        events, self._untold = self._untold, ()
        self.has_news = False
        return News(self._mapped(self._engine.snapshot(), events))

    def map(self, tracked: Tracked) -> Mapped:
        """Take one scan into the map, unless what it is relative to was thrown away before.

        A daemon that has no time left discards what waits, and may still forward what comes after.
        """
        assert tracked.tracking is not None, "the parent forwards scans only"
        if self._engine.misses(tracked.tracking):
            return self._mapped(None, ())
        started = time.perf_counter()
        events = self._engine.process(tracked.tracking)
        self._busy_s += time.perf_counter() - started
        self._scans += 1
        self._odometry_busy_s = tracked.busy_s
        events, self._untold = (*events, *self._untold), ()
        has_changed = tracked.tracking.keyframe is not None or bool(events)
        return self._mapped(self._engine.snapshot() if has_changed else None, events)

    def finish(self, finish: Finish) -> Mapped:
        """Complete the map and save it."""
        events, finished = self._finished(finish.number, is_urgent=True)
        if not finish.is_urgent:
            # Smoothing takes a while: what there is has been saved, should the daemon be stopped.
            more, finished = self._finished(finish.number, is_urgent=False)
            events = (*events, *more)
        return self._mapped(self._engine.snapshot(), events, finished)

    def _finished(self, number: int, *, is_urgent: bool) -> tuple[tuple[Event, ...], Finished]:
        started = time.perf_counter()
        events = self._engine.finish(is_urgent=is_urgent)
        self._busy_s += time.perf_counter() - started
        saved = _guarded(self._write)
        if isinstance(saved, HmtError):
            return events, Finished(number, (), str(saved))
        return events, Finished(number, saved)

    def answer(self, asked: Asked) -> Iterable[Result]:
        """Return what was asked for, in parts, or why there is none."""
        result = _guarded(lambda: self._answered(asked))
        if isinstance(result, Wire):
            return parts_of(result, asked.part_bytes or _MOST_WHOLE_BYTES)
        return [result]

    def _answered(self, asked: Asked) -> Wire | tuple[str, ...]:
        if time.monotonic() > asked.deadline_s:
            raise DeadlineExceeded("the request waited for the topology process until its deadline")
        answer = self._answer(asked.request)
        if isinstance(answer, tuple):
            return answer
        whole = self._encode(answer)
        if asked.part_bytes is None and len(whole.payload) > _MOST_WHOLE_BYTES:
            raise InvalidInput(
                f"the answer has {len(whole.payload) / 1e6:.1f} MB, and {_MOST_WHOLE_BYTES / 1e6:g}"
                " MB at most come in one piece: ask for parts"
            )
        return whole

    def _answer(self, request: Request) -> Answer | tuple[str, ...]:
        match request:
            case MapRequest():
                return self._engine.global_map(
                    request.method,
                    reference_area=request.reference_area,
                    hypothesis=request.hypothesis,
                    with_points=request.with_points,
                    known=request.known,
                )
            case AreaRequest():
                return self._engine.area_details(
                    request.area,
                    reference_area=request.reference_area,
                    hypothesis=request.hypothesis,
                    with_points=request.with_points,
                    known=request.known,
                )
            case TrajectoryRequest():
                return self._engine.trajectory_between(
                    request.start_s, request.end_s, hypothesis=request.hypothesis
                )
            case CompareRequest():
                return self._engine.compare(
                    reference_area=request.reference_area, hypothesis=request.hypothesis
                )
            case RelocalizeRequest():
                self._engine.relocalize()
                self.has_news = True
                return ()
            case AssertArcRequest():
                effect = self._engine.assert_arc(
                    request.area_a,
                    request.area_b,
                    request.a_from_b,
                    probability=request.probability,
                )
                self._keep_what_was_told()
                return effect
            case RetractArcRequest():
                effect = self._engine.retract_arc(request.statement)
                self._keep_what_was_told()
                return effect
            case SaveRequest():
                if self._save is None and self._keeper is None:
                    raise Unavailable("the daemon has no output folder and no map file to save to")
                return self._write()

    def _write(self) -> tuple[str, ...]:
        """Write all results, and the map file."""
        files: tuple[str, ...] = ()
        # The map goes on in this file: nothing that fails with the others may keep it back.
        if self._keeper is not None and self._engine.keyframes > 0:
            self._keeper.write(self._engine)
            self._note_stored()
            files = (str(self._keeper.path),)
        if self._save is not None:
            kept = None if self._keeper is None else self._keeper.path
            files = (*files, *self._save(self._engine, self._report(), kept))
        return files

    def _keep_what_was_told(self) -> None:
        """Write the map file with what nobody says twice; if that fails, it is tried again."""
        self._is_stale, self._kept_s = True, -math.inf
        self._untold = (*self._untold, *self._engine.untold())
        self.has_news = True
        self.keep()

    def keep(self) -> None:
        """Write the map file if it lacks keyframes, but not all the time; then there is news."""
        keeper, started_s = self._keeper, time.monotonic()
        unstored_scans = self._engine.scans - self._stored_scans
        has_new = self._engine.keyframes != self._stored_keyframes or self._is_stale
        if not has_new and unstored_scans < _MOST_UNSTORED:
            return
        if keeper is None or self._engine.keyframes == 0:
            return
        if started_s - self._kept_s < self._pause_s:
            return
        failed = _guarded(lambda: keeper.write(self._engine))
        self._kept_s = time.monotonic()
        self._pause_s = max(_KEEP_S, (self._kept_s - started_s) / _KEEP_SHARE)
        self.has_news = True
        if failed is None:
            self._note_stored()
            return
        keyframes, stored = float(self._engine.keyframes), float(self._stored_keyframes)
        numbers = {"keyframes": keyframes, "stored": stored}
        snapshot = self._engine.snapshot()
        stamp_s = 0.0 if snapshot is None else snapshot.posterior.stamp_s
        event = Event(EventKind.NOT_SAVED, stamp_s, str(failed), numbers)
        self._untold = (*self._untold, event)

    def close(self) -> None:
        """Leave the map file at rest."""
        if self._keeper is not None:
            self._keeper.close()

    def _note_stored(self) -> None:
        self._stored_keyframes, self._stored_scans = self._engine.keyframes, self._engine.scans
        self._is_stale = False

    def _report(self) -> RunReport:
        return RunReport(self._scans, self._odometry_busy_s, self._busy_s, self._stored_keyframes)

    def _mapped(
        self,
        snapshot: Snapshot | None,
        events: tuple[Event, ...],
        finished: Finished | None = None,
    ) -> Mapped:
        scans, stored = self._engine.scans, self._stored_scans
        wakes_up = self._engine.wakes_up
        return Mapped(snapshot, events, self._report(), scans, stored, finished, wakes_up)


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


def _opening(connection: Connection) -> Any:
    """Return what the parent says first."""
    try:
        return load(connection.recv_bytes())
    except (EOFError, OSError) as error:
        raise SystemExit from error  # the parent is gone


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


def _received(
    *connections: Connection, idle: Callable[[], object] = lambda: None
) -> Iterator[tuple[Connection, Any]]:
    """Yield messages until told to stop; connections that have one take turns.

    Args:
        connections: Where messages come from.
        idle: Called now and then while there is none.
    """
    turns = deque(connections)
    while True:
        ready = wait(connections, _KEEP_S)
        if not ready:
            idle()
            continue
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
