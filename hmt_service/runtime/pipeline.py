"""The child processes as one object: readings go in, trackings, maps and answers come out.

    submit -> [odometry] -> on_tracking -> [topology] -> on_map
                             request -> [topology] -> on_result

No cycle of waiting exists: answers of a child are always read, whatever waits to be sent to it.

References:
    own.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from typing import TYPE_CHECKING, Protocol

from hmt_service.core.config import Config
from hmt_service.core.types import Reading, Tracking
from hmt_service.errors import DeadlineExceeded, Unavailable
from hmt_service.runtime.links import Link
from hmt_service.runtime.messages import (
    Asked,
    Encode,
    Finish,
    Keeper,
    Mapped,
    Part,
    ProcessFailure,
    ProcessName,
    ProcessStatus,
    Request,
    Result,
    RunReport,
    Save,
    Tracked,
    dump,
)
from hmt_service.runtime.workers import run_odometry, run_topology

if TYPE_CHECKING:
    from hmt_service.core.visits import MemoryBudget

_READINGS_BYTES = 4_000_000
"""Readings that wait for the odometry here; the rest wait, still encoded, at the input."""
_TRACKINGS_BYTES = 256_000_000
"""Trackings that wait for the topology: hours of keyframes: it never blocks the odometry."""
_MAX_REQUESTS = 32
"""Requests that may wait for the topology."""
_GRACE_S = 0.2
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Listener(Protocol):
    """Whom the pipeline tells; called from its threads, and expected to return at once."""

    def on_tracking(self, tracking: Tracking) -> None:
        """Take what the odometry says of the latest scan."""

    def on_map(self, mapped: Mapped) -> None:
        """Take what the topology made of one scan, or of a `Finish`."""


@dataclass(slots=True)
class _Pending:
    on_result: Callable[[Result], None] | None
    """None once it was called with the answer, the last part of it, or an error."""
    deadline_s: float


class Pipeline:
    """Owner of both child processes and of the pipes to them."""

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
        self._seed = seed
        self._save = save
        self._keeper = keeper
        self._budget = budget
        self._encode = encode
        self._progress = Tracked(None, 0, 0.0)
        self._tracked_scans = 0
        self._report = RunReport(0, 0.0, 0.0)
        self._pending: deque[_Pending] = deque()
        self._pending_lock = threading.Lock()

    def start(self, listener: Listener) -> None:
        """Start both processes; work may be handed over before they are ready."""
        self._listener = listener
        context = multiprocessing.get_context("spawn")
        odometry_end, for_odometry = context.Pipe()
        topology_end, for_topology = context.Pipe()
        requests_end, for_requests = context.Pipe()
        self._processes: dict[ProcessName, SpawnProcess] = {
            ProcessName.ODOMETRY: context.Process(
                target=run_odometry, args=(for_odometry, self._config), name="hmt-odometry"
            ),
            ProcessName.TOPOLOGY: context.Process(
                target=run_topology,
                args=(
                    for_topology,
                    for_requests,
                    self._config,
                    self._seed,
                    self._save,
                    self._keeper,
                    self._budget,
                    self._encode,
                ),
                name="hmt-topology",
            ),
        }
        with _one_thread_per_library():
            for process in self._processes.values():
                process.start()
        # A child's death ends a pipe only when nobody else holds that end.
        for connection in (for_odometry, for_topology, for_requests):
            connection.close()
        self._odometry = Link(
            odometry_end, "odometry", limit_bytes=_READINGS_BYTES, receive=self._on_odometry
        )
        self._topology = Link(
            topology_end, "topology", limit_bytes=_TRACKINGS_BYTES, receive=self._on_topology
        )
        self._requests = Link(
            requests_end, "requests", limit_bytes=_READINGS_BYTES, receive=self._on_result
        )
        self._links = (
            (ProcessName.ODOMETRY, self._odometry),
            (ProcessName.TOPOLOGY, self._topology),
            (ProcessName.TOPOLOGY, self._requests),
        )
        for _, link in self._links:
            link.start()

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
        return self._processes[name].is_alive()

    def status(self) -> tuple[ProcessStatus, ...]:
        """Return what both processes are doing."""
        progress, report = self._progress, self._report
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
            asked = Asked(request, pending.deadline_s, part_bytes)
            is_taken = waiting < _MAX_REQUESTS and self._requests.put_token(asked)
            if is_taken:
                self._pending.append(pending)
        if not is_taken:
            on_result(Unavailable(f"the topology process takes no request, {waiting} wait for it"))

    def tick(self) -> None:
        """Answer the requests whose time is over."""
        now = time.monotonic()
        with self._pending_lock:
            late = [p for p in self._pending if p.deadline_s < now]
        for pending in late:
            self._answer(pending, DeadlineExceeded("no answer of the topology process in time"))

    def failure(self, timeout_s: float) -> ProcessFailure | None:
        """Wait until a child ends, and return which and how; None after `timeout_s`."""
        sentinels = [process.sentinel for process in self._processes.values()]
        is_over = bool(wait(sentinels, timeout_s))
        for name, link in self._links:
            process = self._processes[name]
            if is_over or link.is_broken:
                process.join(_GRACE_S)  # a pipe ends a moment before its process
            if not process.is_alive() or link.is_broken:
                return ProcessFailure(name, process.pid or 0, _reason(process.exitcode))
        return None

    def discard(self) -> None:
        """Throw away what no process has begun with."""
        self._odometry.discard()
        self._topology.discard()

    def stop(self, timeout_s: float) -> tuple[ProcessName, ...]:
        """End both processes, and return which ones had to be killed after `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        for _, link in self._links:
            link.stop()
        killed = []
        for name, process in self._processes.items():
            process.join(max(0.0, deadline_s - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
                killed.append(name)
        for _, link in self._links:
            link.join()
        with self._pending_lock:
            pending = list(self._pending)
        for one in pending:
            self._answer(one, Unavailable("the daemon is stopping"))
        return tuple(killed)

    def _on_odometry(self, message: Tracked | Finish, data: bytes) -> None:
        if isinstance(message, Finish):
            self._topology.put_token(message)
            return
        self._progress = message
        if message.tracking is not None:
            self._tracked_scans += 1
            self._listener.on_tracking(message.tracking)
            self._topology.put(data)

    def _on_topology(self, message: Mapped, _: bytes) -> None:
        self._report = message.report
        self._listener.on_map(message)

    def _on_result(self, message: Result, _: bytes) -> None:
        with self._pending_lock:
            is_over = not isinstance(message, Part) or message.is_last
            pending = self._pending.popleft() if is_over else self._pending[0]
        self._answer(pending, message)

    def _answer(self, pending: _Pending, result: Result) -> None:
        with self._pending_lock:
            on_result = pending.on_result
            if not isinstance(result, Part) or result.is_last:
                pending.on_result = None
        if on_result is not None:
            on_result(result)

    def _status(
        self, name: ProcessName, link: Link, processed: int, busy_s: float
    ) -> ProcessStatus:
        pid = self._processes[name].pid or 0
        return ProcessStatus(name, pid, link.is_ready, link.backlog, processed, busy_s)


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
