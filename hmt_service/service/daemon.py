"""The life of the daemon: start, serve, and stop in time whatever happens.

References:
    own.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import zenoh

from hmt_service.core.config import Config
from hmt_service.core.types import Event, EventKind
from hmt_service.errors import DaemonFailure, HmtError, InvalidInput, Unavailable
from hmt_service.runtime.messages import Finished, ProcessFailure, ProcessName, Save
from hmt_service.runtime.pipeline import Pipeline
from hmt_service.service.codec import encode
from hmt_service.service.gateway import Gateway, MapChange
from hmt_service.service.intake import IntakeLimits
from hmt_service.service.kept_map import KeptMap
from hmt_service.service.keys import Keys
from hmt_service.service.reports import Status
from hmt_service.service.ros2 import Ros2Input
from hmt_service.service.session import Endpoints, open_session

if TYPE_CHECKING:
    from hmt_service.core.visits import MemoryBudget

_LOG = logging.getLogger(__name__)
_TICK_S = 0.1
_POLL_S = 0.02
_DRAIN_S = 3.0
"""Time for the input that waits when the daemon is told to stop."""
_SAVE_S = 4.2
"""Time, from the same moment, after which the map is given up."""
_GRACE_S = 0.3
"""Time for a process to end by itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaemonSettings:
    """What a daemon is started with."""

    keys: Keys
    """Under which names it serves."""
    endpoints: Endpoints
    """Where it meets others."""
    config: Config
    """Settings of the mapping core."""
    ros2: Ros2Input = field(default_factory=Ros2Input)
    """What to take from ROS 2 beside the robot's own keys."""
    seed: int = 0
    """Seed of the engine's random generator."""
    save: Save | None = None
    """Writes the results, in the topology process; None for never."""
    keeper: KeptMap | None = None
    """Owner of the map file that the map goes on in; None for none."""
    budget: MemoryBudget | None = None
    """How much of the map may be in memory; None for all of it."""
    limits: IntakeLimits = field(default_factory=IntakeLimits)
    """What may wait at the input."""
    metrics_port: int | None = None
    """Loopback port of the Prometheus metrics; None for none."""


@dataclass(frozen=True, slots=True)
class StopReport:
    """How the daemon ended."""

    reason: str
    """Who or what stopped it."""
    failure: ProcessFailure | None
    """The process that could not be replaced, if there is one."""
    status: Status
    """Its last words."""
    finished: Finished | None
    """What was saved; None when there was nothing, no time for it, or nobody to do it."""
    killed: tuple[ProcessName, ...]
    """Processes that did not end in time."""

    @property
    def unprocessed(self) -> int:
        """Samples that were neither refused nor came into the map."""
        counts, status = self.status.input, self.status
        processed = {process.name: process.processed for process in status.processes}
        readings = counts.received - sum(counts.refused.values())
        scans = status.tracked_scans - status.processed_scans
        return readings - processed[ProcessName.ODOMETRY] + scans


class Daemon:
    """Owner of the session, the gateway and the pipeline."""

    def __init__(self, settings: DaemonSettings) -> None:
        self._settings = settings
        self._reason: str | None = None
        self._keeper = settings.keeper
        self._changes: deque[MapChange] = deque()

    def request_stop(self, reason: str) -> None:
        """Make `run` return soon; may be called from a signal handler or any thread."""
        self._reason = self._reason or reason

    def run(self, *, on_open: Callable[[], None] = lambda: None) -> StopReport:
        """Serve until asked to stop, or until no process can take the place of one that died.

        Args:
            on_open: Called when input is taken.

        Raises:
            Unavailable: If the endpoints or the port of the metrics cannot be used.
            DaemonFailure: If another daemon serves the same robot.
        """
        settings = self._settings
        with open_session(settings.endpoints) as session:
            _refuse_second(session, settings.keys)
            pipeline = Pipeline(
                settings.config,
                encode=encode,
                seed=settings.seed,
                save=settings.save,
                keeper=settings.keeper,
                budget=settings.budget,
            )
            gateway = Gateway(
                session,
                settings.keys,
                settings.config,
                pipeline,
                ros2=settings.ros2,
                limits=settings.limits,
                shut_down=lambda: self.request_stop("a client"),
                change_map=self._changes.append,
            )
            pipeline.start(gateway)
            try:
                gateway.open()
                with _metrics(settings, gateway.status):
                    on_open()
                    failure = self._serve(gateway, pipeline)
                    return self._stop(gateway, pipeline, failure)
            finally:
                pipeline.stop(0.0)

    def _serve(self, gateway: Gateway, pipeline: Pipeline) -> ProcessFailure | None:
        while self._reason is None:
            failure = pipeline.watch(_TICK_S) or gateway.failure()
            if failure is not None:
                return failure
            gateway.tick()
            if self._changes:
                self._change_map(self._changes.popleft(), gateway, pipeline)
        return None

    def _change_map(self, change: MapChange, gateway: Gateway, pipeline: Pipeline) -> None:
        """Complete and save the map, and go on with another one; or say why not."""
        try:
            change.answer(self._changed(change, gateway, pipeline))
        except HmtError as error:
            change.answer(error)
        except Exception as error:  # noqa: BLE001 - no operator's wish may cost the daemon
            _LOG.exception("another map was not begun")
            change.answer(DaemonFailure(f"another map was not begun: {error!r}"))
        finally:
            gateway.go_on()

    def _changed(self, change: MapChange, gateway: Gateway, pipeline: Pipeline) -> tuple[str, ...]:
        keeper, files = self._next_keeper(change.name), self._finished(gateway, pipeline)
        pipeline.end()
        try:
            if change.name is None and keeper is not None:
                files = keeper.set_aside()
            self._keeper = keeper
        finally:
            pipeline.begin(self._keeper)
        return files

    def _finished(self, gateway: Gateway, pipeline: Pipeline) -> tuple[str, ...]:
        """Have all that has arrived in the map, and the map saved; return the files.

        Raises:
            HmtError: If it is not.
        """
        future: Future[Finished] = Future()
        gateway.finish(future.set_result, is_urgent=True, is_last=True)
        while not wait([future], timeout=0.0).done:
            if self._reason is not None:
                raise Unavailable("the daemon is stopping")
            if (failure := pipeline.watch(_TICK_S) or gateway.failure()) is not None:
                raise Unavailable(str(failure))
            gateway.tick()
        finished = future.result()
        # Where there is no map there is nothing to save.
        if finished.failure is not None and gateway.status().keyframes > 0:
            raise DaemonFailure(finished.failure)
        return finished.files

    def _next_keeper(self, name: str | None) -> KeptMap | None:
        """Return the owner of the map to go on with; None for a name: of an empty one."""
        keeper = self._keeper
        if keeper is not None and keeper.is_frozen:
            raise InvalidInput(f"map {keeper.path} is frozen: it is neither left nor emptied")
        if name is None:
            return keeper
        if keeper is None:
            raise InvalidInput("the daemon has no map file, and no folder of maps to load from")
        other = keeper.beside(name)
        if other.path.resolve() == keeper.path.resolve():
            raise InvalidInput(f"{name} is the map that the daemon goes on with already")
        other.require(self._settings.config)
        return other

    def _stop(
        self, gateway: Gateway, pipeline: Pipeline, failure: ProcessFailure | None
    ) -> StopReport:
        gateway.close_input()
        while self._changes:
            self._changes.popleft().answer(Unavailable("the daemon is stopping"))
        if failure is not None:
            gateway.publish([Event(EventKind.PROCESS_FAILED, gateway.stamp_s, str(failure))])
        finished = _finish(gateway, pipeline, is_broken=failure is not None)
        # What children do from now on (load libraries, compute) is of no use to anybody.
        killed = pipeline.stop(_GRACE_S if finished is not None else 0.0)
        status = gateway.status()
        gateway.close()
        return StopReport(self._reason or str(failure), failure, status, finished, killed)


def _finish(gateway: Gateway, pipeline: Pipeline, *, is_broken: bool) -> Finished | None:
    """Process what waits, as far as time allows, and save the map; None without success."""
    if gateway.status().input.received == 0:
        return None
    started_s = time.monotonic()
    finished: Future[Finished] = Future()
    gateway.finish(finished.set_result, is_urgent=True)
    is_bypassed = False
    while not finished.done() and (elapsed_s := time.monotonic() - started_s) < _SAVE_S:
        if not pipeline.is_alive(ProcessName.TOPOLOGY):
            return None
        if not is_bypassed and (is_broken or not pipeline.is_alive(ProcessName.ODOMETRY)):
            # Nothing comes through the odometry any more: finish with what the topology has.
            gateway.discard()
            gateway.finish_map()
            is_bypassed = True
        if elapsed_s > _DRAIN_S:
            gateway.discard()
            pipeline.discard()
        wait([finished], timeout=_POLL_S)
    return finished.result() if finished.done() else None


def _metrics(
    settings: DaemonSettings, status: Callable[[], Status]
) -> AbstractContextManager[None]:
    """Serve the metrics meanwhile, if somebody wants them."""
    if settings.metrics_port is None:
        return nullcontext()
    # Half as long to load as Zenoh, and most daemons have no use for it.
    from hmt_service.service.metrics import metrics_server

    return metrics_server(settings.metrics_port, settings.keys, status)


def _refuse_second(session: zenoh.Session, keys: Keys) -> None:
    for reply in session.liveliness().get(keys.liveliness, timeout=_TICK_S):
        if reply.ok is not None:
            raise DaemonFailure(f"another daemon serves site {keys.site!r}, robot {keys.robot!r}")
