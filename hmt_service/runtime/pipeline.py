"""The child processes as one object: readings go in, trackings, maps and answers come out.

    submit -> [odometry] -> on_tracking -> [topology] -> on_map
                             request -> [topology] -> on_result

No cycle of waiting exists: answers of a child are always read, whatever waits to be sent to it.

References:
    own.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from typing import TYPE_CHECKING, Protocol

from hmt_service.core.config import Config
from hmt_service.core.types import Keyframe, Reading, Tracking
from hmt_service.errors import DeadlineExceeded, HmtError, Unavailable
from hmt_service.runtime.links import Link
from hmt_service.runtime.messages import (
    Answered,
    Asked,
    Encode,
    Finish,
    Finished,
    Keeper,
    Mapped,
    News,
    Part,
    ProcessFailure,
    ProcessName,
    ProcessStatus,
    Ready,
    Request,
    Result,
    Save,
    Stop,
    Tracked,
    dump,
)
from hmt_service.runtime.recovery import MappedBefore, Session, TrackedBefore
from hmt_service.runtime.workers import run_odometry, run_topology

if TYPE_CHECKING:
    from hmt_service.core.visits import MemoryBudget

_LOG = logging.getLogger(__name__)
_READINGS_BYTES = 4_000_000
"""Readings that wait for the odometry here; the rest wait, still encoded, at the input."""
_TRACKINGS_BYTES = 256_000_000
"""Trackings that wait for the topology: hours of keyframes: it never blocks the odometry."""
_MAX_REQUESTS = 32
"""Requests that may wait for the topology."""
_GRACE_S = 1.0
_STOP_S = 5.0
"""Time for a topology to leave its map file at rest before another map is loaded."""
_MOST_STILLBORN = 3
"""Processes in a row that may die before they are ready; then another one would, too."""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Listener(Protocol):
    """Whom the pipeline tells; called from its threads, and expected to return at once."""

    def on_tracking(self, tracking: Tracking) -> None:
        """Take what the odometry says of the latest scan."""

    def on_map(self, mapped: Mapped) -> None:
        """Take what the topology made of one scan, or of a `Finish`."""

    def on_failure(self, failure: ProcessFailure, *, is_session_over: bool) -> None:
        """Learn that another process takes the place of one that died."""

    def on_session_over(self) -> None:
        """Learn that the next tracking is the first of a new odometry, in whatever map comes."""

    def on_recovery(self, name: ProcessName, outage_s: float) -> None:
        """Learn that a process which took the place of one that died is as far as that was."""


@dataclass(slots=True)
class _Pending:
    on_result: Callable[[Result], None] | None
    """None once it was called with the answer, the last part of it, or an error."""
    deadline_s: float


@dataclass(slots=True)
class _Child:
    """One of the two stages: a process at a time, and what became of those before it."""

    links: tuple[Link, ...]
    process: SpawnProcess | None = None
    restarts: int = 0
    stillborn: int = 0
    """Processes in a row that died before they were ready."""
    died_s: float | None = None
    """When the last one died, as long as the next one is not ready."""


class Pipeline:
    """Owner of both child processes and of the links to them."""

    def __init__(
        self,
        config: Config,
        *,
        encode: Encode,
        seed: int = 0,
        save: Save | None = None,
        keeper: Keeper | None = None,
        budget: MemoryBudget | None = None,
    ) -> None:
        """Prepare; `start` starts.

        Args:
            config: Settings of the mapping core.
            encode: Serialises answers, in the topology process.
            seed: Seed of the engine's random generator.
            save: Writes the results, in the topology process, when the map is finished or saved;
                None for never.
            keeper: Reads the map that the topology process goes on with, and writes it as it grows;
                None for none.
            budget: How much of the map the topology process may have in memory; None for all.
        """
        self._config = config
        self._seed, self._save, self._keeper = seed, save, keeper
        self._budget, self._encode = budget, encode
        self._progress = Tracked(None, 0, 0.0)
        self._window: deque[Keyframe] = deque(maxlen=config.odometry.window_keyframes)
        self._session = Session()
        self._tracked_scans = 0
        self._pending: dict[int, _Pending] = {}
        self._asked = 0
        self._pending_lock = threading.Lock()
        self._odometry = Link("odometry", limit_bytes=_READINGS_BYTES, receive=self._on_odometry)
        self._topology = Link("topology", limit_bytes=_TRACKINGS_BYTES, receive=self._on_topology)
        self._requests = Link("requests", limit_bytes=_READINGS_BYTES, receive=self._on_result)
        self._children = {
            ProcessName.ODOMETRY: _Child((self._odometry,)),
            ProcessName.TOPOLOGY: _Child((self._topology, self._requests)),
        }

    def start(self, listener: Listener) -> None:
        """Start both processes; work may be handed over before they are ready."""
        self._listener = listener
        self._start(ProcessName.ODOMETRY, is_resumed=False)
        self._start(ProcessName.TOPOLOGY, is_resumed=False)

    def _start(self, name: ProcessName, *, is_resumed: bool) -> None:
        """Start a process, which goes on where the one before it was, or begins a new session."""
        target: Callable[..., None] = run_odometry
        args: tuple[object, ...] = (self._config,)
        before: object = self._tracked_before(is_resumed=is_resumed)
        if name is ProcessName.TOPOLOGY:
            target, args = run_topology, (*args, self._seed, self._save, self._keeper)
            args = (*args, self._budget, self._encode)
            interrupted = self._session.interrupted if is_resumed else None
            before = MappedBefore(self._session.report, interrupted)
        context = multiprocessing.get_context("spawn")
        child = self._children[name]
        pipes = [context.Pipe() for _ in child.links]
        theirs = [end for _, end in pipes]
        # Few arguments: who starts a process waits until it has read them, or for ever.
        process = context.Process(target=target, args=(*theirs, *args), name=f"hmt-{name}")
        with _one_thread_per_library():
            process.start()
        child.process = process
        openings = [before, *([None] * len(child.links))]
        for link, (ours, end), opening in zip(child.links, pipes, openings, strict=False):
            # A child's death ends a pipe only when nobody else holds that end.
            end.close()
            link.connect(ours, opening)

    def _tracked_before(self, *, is_resumed: bool) -> TrackedBefore:
        progress = self._progress
        if not is_resumed:
            return TrackedBefore(processed=progress.processed, busy_s=progress.busy_s)
        window = tuple(self._window)
        return TrackedBefore(progress.memory, window, progress.processed, progress.busy_s)

    def end(self) -> None:
        """End the session and both processes: nothing is written any more; `begin` must follow.

        Readings wait meanwhile. Not to be called while another thread watches.
        """
        topology = self._children[ProcessName.TOPOLOGY].process
        if topology is not None:
            # It leaves its file at rest.
            self._topology.clear()
            self._topology.put_token(Stop())
            topology.join(_STOP_S)
            self._bury(ProcessName.TOPOLOGY)
            self._topology.clear()
        self._end_session()

    def begin(self, keeper: Keeper | None) -> None:
        """End the session if there is one, and begin one with another map.

        Args:
            keeper: Owner of that map's file; None for an empty map that is kept nowhere.
        """
        self._end_session()
        self._keeper = keeper
        for name in self._children:
            self._start(name, is_resumed=False)

    @property
    def is_ready(self) -> bool:
        """Whether both processes have loaded their libraries."""
        return self._odometry.is_ready and self._topology.is_ready

    @property
    def tracked_scans(self) -> int:
        """Number of scans that the odometry has processed."""
        return self._tracked_scans

    def is_alive(self, name: ProcessName) -> bool:
        """Whether a child runs."""
        process = self._children[name].process
        return process is not None and process.is_alive()

    def status(self) -> tuple[ProcessStatus, ...]:
        """Return what both processes are doing."""
        progress, report = self._progress, self._session.report
        return (
            self._status(ProcessName.ODOMETRY, self._odometry, progress.processed, progress.busy_s),
            self._status(
                ProcessName.TOPOLOGY, self._topology, report.scans, report.topology_busy_s
            ),
        )

    def submit(self, reading: Reading) -> bool:
        """Hand over the next reading, waiting for room; return False when the odometry is gone."""
        return self._odometry.put(dump(reading))

    def finish(self, finish: Finish) -> bool:
        """Complete and save the map behind the readings so far; `on_map` gets the outcome.

        Returns:
            False when the odometry is gone.
        """
        return self._odometry.put_token(finish)

    def finish_map(self, finish: Finish) -> bool:
        """Complete and save the map with the scans that the topology has; False when it is gone."""
        return self._topology.put_token(finish)

    def request(
        self,
        request: Request,
        on_result: Callable[[Result], None],
        *,
        timeout_s: float,
        part_bytes: int | None = None,
    ) -> None:
        """Ask the topology.

        Args:
            request: The question.
            on_result: Called, from any thread, with every part of the answer in order, or once with
                why there is none; an error may also follow some parts. While it blocks, nobody
                else is answered.
            timeout_s: Time of the wall clock after which there is none.
            part_bytes: Largest part that the answer may be cut into; None if it must be whole.
        """
        pending = _Pending(on_result, time.monotonic() + timeout_s)
        with self._pending_lock:
            waiting = len(self._pending)
            number = self._asked = self._asked + 1
            asked = Asked(number, request, pending.deadline_s, part_bytes)
            is_taken = waiting < _MAX_REQUESTS and self._requests.put_token(asked)
            if is_taken:
                self._pending[number] = pending
        if not is_taken:
            on_result(Unavailable(f"the topology process takes no request, {waiting} wait for it"))

    def tick(self) -> None:
        """Answer the requests whose time is over."""
        now = time.monotonic()
        with self._pending_lock:
            late = [p for p in self._pending.values() if p.deadline_s < now]
        for pending in late:
            self._answer(pending, DeadlineExceeded("no answer of the topology process in time"))

    def watch(self, timeout_s: float) -> ProcessFailure | None:
        """Wait until a process ends, and put another one in its place; at most `timeout_s`.

        Returns:
            What is wrong if that is of no use any more; None otherwise.
        """
        alive = {c.process.sentinel: c for c in self._children.values() if c.process is not None}
        over = wait(list(alive), timeout_s)
        ended = [child for sentinel, child in alive.items() if sentinel in over]
        # The odometry may wait for room at the topology: that one first.
        for name in (ProcessName.TOPOLOGY, ProcessName.ODOMETRY):
            child = self._children[name]
            process, is_broken = child.process, any(link.is_broken for link in child.links)
            if process is None or not (child in ended or is_broken):
                continue
            process.join(_GRACE_S)  # a pipe ends a moment before its process
            failure = ProcessFailure(name, process.pid or 0, _reason(process.exitcode))
            if not self._replace(name, failure):
                return failure
        return None

    def _replace(self, name: ProcessName, failure: ProcessFailure) -> bool:
        """Start a process in the place of one that died; return whether that makes sense."""
        child, is_topology = self._children[name], name is ProcessName.TOPOLOGY
        child.died_s = child.died_s or time.monotonic()
        self._bury(name)
        fatal = None
        if child.links[0].was_ready:
            child.stillborn, fatal = 0, child.links[0].take_fatal()
        else:
            child.stillborn += 1
        if child.stillborn >= _MOST_STILLBORN:
            for link in child.links:
                link.abandon()
            return False
        if fatal is not None:
            reason = f"{failure.reason} as the one before, of the same message, which is left out"
            failure = replace(failure, reason=reason)
        # Who is killed while it starts has tried nothing yet; twice, and what it is to go on with
        # may be the reason.
        is_over = child.stillborn > 1 or (
            is_topology and (fatal is not None or not self._session.can_go_on)
        )
        if is_over:
            self._end_session()
        self._listener.on_failure(failure, is_session_over=is_over)
        if isinstance(fatal, Finish):
            self._fail(fatal, failure)
        child.restarts += 1
        try:
            for each in self._children:
                if each is name or is_over:
                    self._start(each, is_resumed=not is_over)
        except OSError as error:
            _LOG.error("no process %s can be started: %s", name, error)
            return False
        return True

    def _bury(self, name: ProcessName) -> None:
        """Make sure that a process is gone, and answer those who wait for it alone."""
        child, gone = self._children[name], Unavailable("the topology process is gone: ask again")
        if child.process is not None:
            child.process.kill()
            child.process.join()
            child.process = None
        if name is ProcessName.TOPOLOGY:
            # First: who takes an answer slowly would be waited for.
            self._fail_requests(gone)
        for link in child.links:
            link.disconnect()
        if name is ProcessName.TOPOLOGY:
            self._requests.clear()
            self._fail_requests(gone)

    def _fail_requests(self, error: HmtError) -> None:
        with self._pending_lock:
            waiting, self._pending = list(self._pending.values()), {}
        for pending in waiting:
            self._answer(pending, error)

    def _end_session(self) -> None:
        """Forget what only the processes that are gone could go on with."""
        self._bury(ProcessName.TOPOLOGY)
        self._topology.discard_all()  # who waits for room there could not be buried
        self._bury(ProcessName.ODOMETRY)
        self._topology.discard_all()
        self._window.clear()
        self._progress = replace(self._progress, memory=None)
        self._session = Session(report=self._session.report)
        self._listener.on_session_over()

    def _fail(self, finish: Finish, failure: ProcessFailure) -> None:
        finished = Finished(finish.number, (), f"{failure} while it finished the map")
        scans, stored = self._session.known_scans, self._session.stored_scans
        self._listener.on_map(Mapped(None, (), self._session.report, scans, stored, finished))

    def discard(self) -> None:
        """Throw away what no process has begun with."""
        self._odometry.discard()
        self._topology.discard()

    def stop(self, timeout_s: float) -> tuple[ProcessName, ...]:
        """End both processes, and return which ones had to be killed after `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        for child in self._children.values():
            for link in child.links:
                link.stop()
        killed = []
        for name, child in self._children.items():
            if child.process is None:
                continue
            child.process.join(max(0.0, deadline_s - time.monotonic()))
            if child.process.is_alive():
                child.process.kill()
                child.process.join()
                killed.append(name)
        self._fail_requests(Unavailable("the daemon is stopping"))
        self._topology.abandon()
        for child in self._children.values():
            for link in child.links:
                link.disconnect()
        return tuple(killed)

    def _on_odometry(self, message: Ready | Tracked | Finish, _: bytes, __: bytes) -> None:
        if isinstance(message, Ready):
            self._recovered(ProcessName.ODOMETRY)
        elif isinstance(message, Finish):
            self._topology.put_token(message)
        else:
            self._progress = message
            if message.tracking is not None:
                self._tracked(message, message.tracking)

    def _tracked(self, message: Tracked, tracking: Tracking) -> None:
        if tracking.keyframe is not None:
            self._window.append(tracking.keyframe)
        self._tracked_scans += 1
        self._listener.on_tracking(tracking)
        self._topology.put(dump(replace(message, memory=None)))

    def _on_topology(self, message: Ready | News | Mapped, _: bytes, sent: bytes) -> None:
        if isinstance(message, Ready):
            self._session.first_keyframe = message.first_keyframe
            self._recovered(ProcessName.TOPOLOGY)
        elif isinstance(message, News):
            self._mapped(message.mapped, None)
        else:
            self._mapped(message, sent)

    def _mapped(self, message: Mapped, told: bytes | None) -> None:
        self._session.note(told, message)
        self._listener.on_map(message)

    def _recovered(self, name: ProcessName) -> None:
        child = self._children[name]
        died_s, child.died_s = child.died_s, None
        if died_s is not None:
            self._listener.on_recovery(name, time.monotonic() - died_s)

    def _on_result(self, message: Answered, _: bytes, __: bytes) -> None:
        with self._pending_lock:
            pending = self._pending.get(message.number)
        if pending is not None:
            self._answer(pending, message.result)
        if message.is_last:
            with self._pending_lock:
                self._pending.pop(message.number, None)

    def _answer(self, pending: _Pending, result: Result) -> None:
        with self._pending_lock:
            on_result = pending.on_result
            # Who takes a part slowly must still learn that its time is over.
            if not isinstance(result, Part):
                pending.on_result = None
        if on_result is None:
            return
        try:
            on_result(result)
        except Exception:  # noqa: BLE001 - whatever is wrong with one client, others wait, too
            _LOG.exception("an answer could not be passed on")

    def _status(
        self, name: ProcessName, link: Link, processed: int, busy_s: float
    ) -> ProcessStatus:
        child = self._children[name]
        pid = 0 if child.process is None else child.process.pid or 0
        return ProcessStatus(
            name, pid, link.is_ready, link.backlog, processed, busy_s, child.restarts
        )


def _reason(exitcode: int | None) -> str:
    if exitcode is None:
        return "closed its pipe"
    if exitcode < 0:
        return f"was killed by {signal.Signals(-exitcode).name}"
    return f"ended with exit code {exitcode}"


@contextmanager
def _one_thread_per_library() -> Iterator[None]:
    """Give processes that start meanwhile one thread for linear algebra: they share a machine."""
    before = {name: os.environ.get(name) for name in _THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
