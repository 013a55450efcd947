"""The daemon's side of Zenoh: samples come in, publications and answers go out.

Nothing here takes long: fast calls are answered from the latest values, slow ones are handed to the
topology process and answered when it has answered.

References:
    own.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import zenoh

from hmt_service import __version__
from hmt_service.core.audit import Audit, belief_of
from hmt_service.core.config import Config
from hmt_service.core.geometry import GaussianPose, isotropic_covariance, pose_of
from hmt_service.core.types import (
    Event,
    EventKind,
    History,
    Hypotheses,
    MapMethod,
    Snapshot,
    Tracking,
)
from hmt_service.errors import DaemonFailure, HmtError, InvalidInput, Unavailable
from hmt_service.io.ros_messages import RosType
from hmt_service.runtime.localization import Localizer
from hmt_service.runtime.messages import (
    AreaRequest,
    AssertArcRequest,
    CompareRequest,
    Finish,
    Finished,
    Mapped,
    MapRequest,
    ProcessFailure,
    ProcessName,
    RelocalizeRequest,
    Request,
    RetractArcRequest,
    RunReport,
    SaveRequest,
    TrajectoryRequest,
    Wire,
)
from hmt_service.runtime.pipeline import Pipeline
from hmt_service.service.codec import Value, encode
from hmt_service.service.delivery import Deliveries
from hmt_service.service.intake import Intake, IntakeLimits
from hmt_service.service.keys import Call, Control, Input, Keys, Topic
from hmt_service.service.questions import Name, Question, receive
from hmt_service.service.readings import ReadingDecoder
from hmt_service.service.reports import Ack, DaemonState, Status
from hmt_service.service.ros2 import Ros2Input, encoding_under, input_of
from hmt_service.service.rpc import ARC, RPCS
from hmt_service.service.senders import Senders

_LOG = logging.getLogger(__name__)
_WARNINGS = (
    EventKind.PRESET_DOUBTED,
    EventKind.NOT_SAVED,
    EventKind.OVER_BUDGET,
    EventKind.PROCESS_FAILED,
)
_KEPT_EVENTS = 1000
_KEPT_BELIEFS = 20_000
_ANSWER_S = 8.0
"""Time for a slow call of a client that says no deadline: less than Zenoh's own ten seconds, so
that it learns the reason."""
_REPORT_S = 1.0
"""Shortest time between two events about refused input."""


@dataclass(frozen=True, slots=True)
class MapChange:
    """A client wants to go on with another map."""

    name: str | None
    """Name of its file; None for an empty map instead of the one that there is."""
    answer: Callable[[tuple[str, ...] | HmtError], None]
    """To be called once: with the files that hold what there was, or why it stays."""


class Gateway:
    """Owner of everything that is declared on Zenoh, and of the latest values to answer from."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        config: Config,
        pipeline: Pipeline,
        *,
        ros2: Ros2Input,
        limits: IntakeLimits,
        shut_down: Callable[[], None],
        change_map: Callable[[MapChange], None],
    ) -> None:
        """Prepare; `open` opens.

        Args:
            session: Where to declare; stays the caller's.
            keys: Under which names.
            config: Settings of the mapping core.
            pipeline: Where readings and slow calls go; stays the caller's.
            ros2: What to take from ROS 2 beside the robot's own keys.
            limits: What may wait at the input.
            shut_down: Called when a client asks for it.
            change_map: Called when a client wants to go on with another map.
        """
        self._session = session
        self._keys = keys
        self._config = config
        self._pipeline = pipeline
        self._shut_down = shut_down
        self._change_map = change_map
        self._ros2 = ros2
        decoder = ReadingDecoder(config.sensor, ros2.body_from_sensor)
        self._intake = Intake(decoder, limits, submit=pipeline.submit, finish=pipeline.finish)
        self._localizer = Localizer()
        self._deliveries = Deliveries()
        self._senders = Senders()
        self._snapshot: Snapshot | None = None
        self._report = RunReport(0, 0.0, 0.0)
        self._audit = Audit(events=_KEPT_EVENTS, beliefs=_KEPT_BELIEFS)
        self._changes = 0
        self._encoded: dict[Call, tuple[int, Wire]] = {}
        self._lock = threading.Lock()
        self._is_stopping = False
        self._finishes = 0
        self._on_finished: dict[int, Callable[[Finished], None]] = {}
        self._started_s = time.monotonic()
        self._reported: Counter[str] = Counter()
        self._reported_s = self._started_s

    def open(self) -> None:
        """Declare everything, and take input from now on."""
        self._publishers = {
            topic: self._session.declare_publisher(self._keys.topic(topic)) for topic in Topic
        }
        self._intake.start()
        # In the receiving thread itself: what a client sent before it asked is in the queue when
        # its question arrives (measured: with a thread of its own, `finish` overtook up to 50 of
        # 4,000 scans).
        self._subscribers = [self._subscribe(self._keys.inputs, self._on_sample)]
        for key, kind in self._ros2.keys().items():
            encoding_under(key, kind)  # loads what it needs, for which no sample should wait
            self._subscribers.append(self._subscribe(key, partial(self._on_ros_sample, kind)))
        self._queryables = [
            self._session.declare_queryable(self._keys.calls, self._on_call),
            self._session.declare_queryable(self._keys.controls, self._on_control),
        ]
        self._token = self._session.liveliness().declare_token(self._keys.liveliness)

    def close_input(self) -> None:
        """Take no more samples, and say so to everybody who asks."""
        self._is_stopping = True
        # Samples still come while a subscriber is undeclared: behind the last `Finish` they would
        # be mapped after the map was saved.
        self._intake.close()
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def close(self) -> None:
        """Take everything back; calls that still wait get an error."""
        self._intake.stop()
        reason = "the daemon stopped before the map was saved"
        self._finish_until(Finished(self._finishes, (), reason))
        self._token.undeclare()
        for queryable in self._queryables:
            queryable.undeclare()

    @property
    def stamp_s(self) -> float:
        """Stamp of the last reading handed on, s; -inf before the first."""
        return self._intake.last_stamp_s

    def failure(self) -> ProcessFailure | None:
        """Return what is wrong when input is no longer processed; None when all is well."""
        if not self._intake.is_broken:
            return None
        reason = "no longer processes its input: see the log"
        return ProcessFailure(ProcessName.GATEWAY, os.getpid(), reason)

    def tick(self) -> None:
        """Do what is due at this moment; called a few times per second."""
        self._pipeline.tick()
        now = time.monotonic()
        if now - self._reported_s >= _REPORT_S:
            self._reported_s = now
            self._report_refused()

    def finish(
        self,
        on_finished: Callable[[Finished], None],
        *,
        is_urgent: bool = False,
        is_last: bool = False,
    ) -> None:
        """Process what has arrived, complete the map and save it; input may follow.

        Args:
            on_finished: Called once with the outcome, from any thread.
            is_urgent: Whether there is no time to smooth the trajectory.
            is_last: Whether what follows waits for `go_on`.
        """
        with self._lock:
            self._finishes += 1
            self._on_finished[self._finishes] = on_finished
            self._intake.finish(Finish(self._finishes, is_urgent, is_last))

    def go_on(self) -> None:
        """Let the input go on that waits for another map."""
        self._intake.go_on()

    def finish_map(self) -> None:
        """Do the same with the scans that the topology has: nothing comes through the odometry."""
        self._pipeline.finish_map(Finish(self._finishes, is_urgent=True))

    def discard(self) -> None:
        """Throw away what waits to be decoded."""
        self._intake.discard()

    def publish(self, events: Iterable[Event]) -> None:
        """Keep, log and publish events."""
        for event in events:
            level = logging.WARNING if event.kind in _WARNINGS else logging.INFO
            _LOG.log(level, "%s: %s", event.kind, event.message, extra={"event": event})
            self._audit.note([event])
            self._changes += 1
            self._put(Topic.EVENT, event)

    def status(self) -> Status:
        """Return everything that an operator may ask."""
        snapshot = self._snapshot
        return Status(
            version=__version__,
            config_hash=self._config.hash(),
            state=self._state(),
            uptime_s=time.monotonic() - self._started_s,
            input=self._intake.counts(),
            tracked_scans=self._pipeline.tracked_scans,
            processed_scans=self._report.scans,
            processes=self._pipeline.status(),
            revision=snapshot.posterior.revision if snapshot else 0,
            areas=snapshot.areas if snapshot else 0,
            arcs=snapshot.arcs if snapshot else 0,
            keyframes=snapshot.keyframes if snapshot else 0,
            hypotheses=len(snapshot.posterior.hypotheses) if snapshot else 0,
            hypothesis=snapshot.posterior.hypotheses[0].hypothesis if snapshot else None,
            stored_keyframes=self._report.stored_keyframes,
            localization=snapshot.localization if snapshot else None,
            senders=self._senders.counts(),
            clock_s=time.time(),
        )

    def on_tracking(self, tracking: Tracking) -> None:
        """Publish where the robot is."""
        self._localizer.track(tracking)
        if self._localizer.pose is not None:
            self._put(Topic.POSE, self._localizer.pose)

    def on_map(self, mapped: Mapped) -> None:
        """Publish the belief and what has happened to the map."""
        self._report = mapped.report
        if mapped.snapshot is not None:
            self._snapshot = mapped.snapshot
            self._localizer.update(mapped.snapshot)
            self._audit.believe(belief_of(mapped.snapshot.posterior))
            self._changes += 1
            self._put(Topic.POSTERIOR, mapped.snapshot.posterior)
        self.publish(mapped.events)
        if mapped.finished is not None:
            self._finish_until(mapped.finished)

    def on_failure(self, failure: ProcessFailure, *, is_session_over: bool) -> None:
        """Tell what died, and what comes of it."""
        consequence = "another one goes on where it was"
        if is_session_over:
            consequence = "a new session begins, with the map that was stored"
        message = f"{failure}: {consequence}"
        self.publish([Event(EventKind.PROCESS_FAILED, self.stamp_s, message)])

    def on_session_over(self) -> None:
        """Forget the map and where the robot is in it."""
        self._snapshot = None
        self._changes += 1
        self._report = replace(self._report, stored_keyframes=0)
        self._localizer.forget()

    def on_recovery(self, name: ProcessName, outage_s: float) -> None:
        """Tell that all is well again."""
        message = f"process {name} works again after {outage_s:.1f} s"
        numbers = {"outage_s": outage_s}
        self.publish([Event(EventKind.PROCESS_RESTARTED, self.stamp_s, message, numbers)])

    def _finish_until(self, finished: Finished) -> None:
        # Earlier ones too: their tokens are lost when the odometry is.
        with self._lock:
            numbers = [number for number in self._on_finished if number <= finished.number]
            waiting = [self._on_finished.pop(number) for number in numbers]
        for on_finished in waiting:
            on_finished(finished)

    def _state(self) -> DaemonState:
        if self._is_stopping:
            return DaemonState.STOPPING
        return DaemonState.RUNNING if self._pipeline.is_ready else DaemonState.STARTING

    def _put(self, topic: Topic, value: Value) -> None:
        message = encode(value)
        self._publishers[topic].put(message.payload, encoding=message.encoding)

    def _report_refused(self) -> None:
        refused = Counter(self._intake.counts().refused)
        new = refused - self._reported
        if not new:
            return
        self._reported = refused
        reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(new.items()))
        message = f"{new.total()} samples refused: {reasons}"
        numbers = {reason: float(count) for reason, count in new.items()}
        self.publish([Event(EventKind.INPUT_DROPPED, self.stamp_s, message, numbers)])

    def _subscribe(
        self, key: str, on_sample: Callable[[zenoh.Sample], None]
    ) -> zenoh.Subscriber[None]:
        callback = zenoh.handlers.Callback(on_sample, indirect=False)
        return self._session.declare_subscriber(key, callback)

    def _on_ros_sample(self, kind: RosType, sample: zenoh.Sample) -> None:
        encoding = encoding_under(str(sample.key_expr), kind)
        self._intake.offer(
            input_of(kind) if sample.kind == zenoh.SampleKind.PUT else None,
            len(sample.payload),
            lambda: (sample.payload.to_bytes(), encoding),
        )

    def _on_sample(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        is_known = sample.kind == zenoh.SampleKind.PUT and name in set(Input)
        if is_known and sample.attachment is not None:
            self._senders.note(Input(name), sample.attachment.to_bytes())
        self._intake.offer(
            Input(name) if is_known else None,
            len(sample.payload),
            lambda: (sample.payload.to_bytes(), str(sample.encoding)),
        )

    def _on_call(self, query: zenoh.Query) -> None:
        receive(query, {call: self._keys.call(call) for call in Call}, self._handle_call)

    def _on_control(self, query: zenoh.Query) -> None:
        keys = {control: self._keys.control(control) for control in Control}
        receive(query, keys, self._handle_control)

    def _handle_call(self, question: Question[Call]) -> Value | None:
        question.allow(*RPCS[question.name].parameters)
        match question.name:
            case Call.MAP:
                return self._ask(
                    question,
                    MapRequest(
                        question.choice("method", MapMethod.CONSISTENT),
                        question.integer("reference"),
                        question.integer("hypothesis"),
                        with_points=question.integer("points") != 0,
                        known=question.versions("known"),
                    ),
                )
            case Call.AREA:
                return self._ask(question, _area_request(question))
            case Call.TRAJECTORY:
                return self._ask(question, _trajectory_request(question))
            case Call.AREAS:
                return self._ask(
                    question,
                    MapRequest(
                        MapMethod.CONSISTENT,
                        question.integer("reference"),
                        question.integer("hypothesis"),
                        with_points=False,
                    ),
                )
            case Call.COMPARE:
                return self._ask(
                    question,
                    CompareRequest(question.integer("reference"), question.integer("hypothesis")),
                )
            case Call.STATUS | Call.POSE:
                return self._latest(question.name)
            case _:
                question.reply(self._latest_encoded(question.name))
                return None

    def _handle_control(self, question: Question[Control]) -> Value | None:
        question.allow(*RPCS[question.name].parameters)
        match question.name:
            case Control.FINISH if self._is_stopping:
                raise Unavailable("the daemon is stopping, and saves the map by itself")
            case Control.FINISH:
                self.finish(lambda finished: question.answer(self._finished_ack(finished)))
                return None
            case Control.SAVE:
                return self._ask(question, SaveRequest())
            case Control.RELOCALIZE:
                return self._ask(question, RelocalizeRequest())
            case Control.ASSERT_ARC:
                return self._ask(question, _statement(question))
            case Control.RETRACT_ARC:
                return self._ask(question, RetractArcRequest(question.needed_integer("statement")))
            case Control.LOAD | Control.RESET if self._is_stopping:
                raise Unavailable("the daemon is stopping")
            case Control.LOAD | Control.RESET:
                name = question.text("map") if question.name is Control.LOAD else None
                self._change_map(MapChange(name, lambda result: self._answer(question, result)))
                return None
            case Control.SHUTDOWN:
                self._shut_down()
                return self._ack()

    def _latest_encoded(self, call: Call) -> Wire:
        """Return an answer as it was sent before, unless it has changed: who asks next waits."""
        changes = self._changes
        known, wire = self._encoded.get(call, (-1, None))
        if wire is None or known != changes:
            wire = encode(self._latest(call))
            self._encoded[call] = changes, wire
        return wire

    def _latest(self, call: Call) -> Value:
        pose, snapshot = self._localizer.pose, self._snapshot
        match call:
            case Call.STATUS:
                return self.status()
            case Call.EVENTS:
                return self._audit.events
            case Call.HISTORY:
                revision = snapshot.posterior.revision if snapshot else 0
                return History(revision, self._audit.beliefs)
            case Call.HYPOTHESES if snapshot is not None:
                posterior = snapshot.posterior
                return Hypotheses(posterior.stamp_s, posterior.revision, posterior.hypotheses)
            case Call.POSE if pose is not None:
                return pose
            case Call.POSTERIOR if snapshot is not None:
                return snapshot.posterior
        received = self._intake.counts().received
        raise Unavailable(f"no {call} yet: the map has no keyframe, {received} samples received")

    def _ask(self, question: Question[Name], request: Request) -> Value | None:
        """Hand a slow call to the topology process, which has it answered later: no value yet."""
        timeout_s, part_bytes = question.deadline_s(_ANSWER_S), question.part_bytes
        on_result = self._deliveries.begin(question, self._ack)
        self._pipeline.request(request, on_result, timeout_s=timeout_s, part_bytes=part_bytes)
        return None

    def _answer(self, question: Question[Control], result: tuple[str, ...] | HmtError) -> None:
        question.answer(self._ack(result) if isinstance(result, tuple) else result)

    def _finished_ack(self, finished: Finished) -> Ack | HmtError:
        return DaemonFailure(finished.failure) if finished.failure else self._ack(finished.files)

    def _ack(self, files: tuple[str, ...] = ()) -> Ack:
        counts = self._intake.counts()
        refused = sum(counts.refused.values())
        return Ack(counts.received, counts.accepted, refused, self._report.scans, files)


def _statement(question: Question[Control]) -> AssertArcRequest:
    x, y, z, *quaternion, sigma_m, sigma_rad, probability = map(question.needed_number, ARC)
    if sigma_m <= 0.0 or sigma_rad <= 0.0:
        raise InvalidInput(f"standard deviations {sigma_m:g} m, {sigma_rad:g} rad are not above 0")
    pose = pose_of(np.array(quaternion), np.array([x, y, z]))
    covariance = isotropic_covariance(sigma_rad=sigma_rad, sigma_m=sigma_m)
    return AssertArcRequest(
        question.needed_integer("area_a"),
        question.needed_integer("area_b"),
        GaussianPose(pose, covariance),
        probability,
    )


def _area_request(question: Question[Call]) -> AreaRequest:
    return AreaRequest(
        question.needed_integer("area"),
        question.integer("reference"),
        question.integer("hypothesis"),
        with_points=question.integer("points") != 0,
        known=question.versions("known"),
    )


def _trajectory_request(question: Question[Call]) -> TrajectoryRequest:
    start_s, end_s = question.number("from"), question.number("to")
    return TrajectoryRequest(
        -math.inf if start_s is None else start_s,
        math.inf if end_s is None else end_s,
        question.integer("hypothesis"),
    )
