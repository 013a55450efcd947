"""The core that both clients share: questions and readings go out, answers and publications come.

Nothing here waits for an answer: it arrives in a future, and publications in a feed.

References:
    own.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, InvalidStateError
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Generic, TypeVar, cast

import zenoh

from hmt_service.client.calls import Ask
from hmt_service.client.feed import Feed
from hmt_service.core.types import Posterior
from hmt_service.errors import AccessDenied, DeadlineExceeded, HmtError, InvalidInput, Unavailable
from hmt_service.service.codec import PREFIX, decode, decode_place, encode_origin
from hmt_service.service.keys import Input, Keys, Topic
from hmt_service.service.questions import DEADLINE, PART_BYTES
from hmt_service.service.reports import Status
from hmt_service.service.session import client_endpoints, open_session

T = TypeVar("T")

_PART_BYTES = 524_288
_GRACE_S = 1.0
"""How much longer than the daemon the client waits, so that it learns the daemon's reason."""
_MOST_CONNECTING_S = 3.0
_CHECK_EVERY_BYTES = 1_000_000
_MOST_QUEUED_BYTES = 64_000_000
POLL_S = 0.1
"""How often a sender that waits for room asks whether there is some."""


class Connection:
    """One session with the daemon of one robot; may be used from any thread."""

    def __init__(
        self, endpoint: str | None, keys: Keys, timeout_s: float, zenoh_config: Path | None
    ) -> None:
        """Connect.

        Args:
            endpoint: Zenoh endpoint of the daemon, or of a router that reaches it; None for the
                one that `zenoh_config` names, or `DEFAULT_ENDPOINT`.
            keys: Names of the robot.
            timeout_s: How long to wait for answers, wall clock.
            zenoh_config: File of Zenoh settings: certificates or a password.

        Raises:
            InvalidInput: If Zenoh refuses the file.
            NotFound: If there is no such file.
            Unavailable: If nobody listens at the endpoint, or does not let this client in.
        """
        waiting_s = min(_MOST_CONNECTING_S, timeout_s)
        endpoints = client_endpoints(endpoint, timeout_s=waiting_s, zenoh_config=zenoh_config)
        self.endpoint = ", ".join(endpoints.connect)
        self.keys = keys
        self.timeout_s = timeout_s
        self._session = open_session(endpoints)
        self._publishers: dict[Input, zenoh.Publisher] = {}
        self._sender = 1 + secrets.randbelow(2**64 - 1)
        self._sent = dict.fromkeys(Input, 0)
        self._feeds: list[tuple[Feed[object], zenoh.Subscriber[None]]] = []
        self._lock = threading.Lock()
        self._publishing = threading.Lock()

    def close(self) -> None:
        """End all feeds, and disconnect."""
        with self._lock:
            feeds = [feed for feed, _ in self._feeds]
        for feed in feeds:
            feed.close()
        self._session.close()

    def ask(self, ask: Ask[T]) -> Future[T]:
        """Send a question; the future gets its answer, or the error."""
        timeout_s = ask.timeout_s or self.timeout_s
        more = {DEADLINE: f"{timeout_s:g}", PART_BYTES: _PART_BYTES}
        exchange = _Exchange(self, ask, timeout_s)
        try:
            self._session.get(
                ask.selector(more),
                zenoh.handlers.Callback(exchange.take, drop=exchange.end),
                timeout=timeout_s + _GRACE_S,
                # The parts of an answer have the same key.
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        except zenoh.ZError as error:
            exchange.fail(Unavailable(f"{ask.key} cannot be asked: {error}"))
        return exchange.future

    def put(self, name: Input, payload: bytes, encoding: str) -> None:
        """Send a reading; waits while the network is behind, and drops nothing.

        Raises:
            Unavailable: If nobody takes it.
        """
        # Until a daemon is there the first reading waits, and with it nothing but readings.
        with self._publishing:
            if name not in self._publishers:
                self._publishers[name] = self._publisher(self.keys.input(name))
        with self._lock:
            number = self._sent[name]
            self._sent[name] = number + 1
        origin = encode_origin(self._sender, number)
        with _open(self.endpoint):
            self._publishers[name].put(payload, encoding=encoding, attachment=origin)

    def sent(self) -> Mapping[Input, int]:
        """Return how many readings were sent until now."""
        with self._lock:
            return dict(self._sent)

    def lost_of(self, sent: Mapping[Input, int], status: Status) -> Mapping[Input, int]:
        """Return how many of the readings sent before had not arrived when this was said."""
        received = {c.input: c.received for c in status.senders if c.sender == self._sender}
        return {name: max(0, count - received.get(name, 0)) for name, count in sent.items()}

    def subscribe(self, topic: Topic, kind: type[T], capacity: int) -> Feed[T]:
        """Return what is published from now on."""

        def value_of(sample: zenoh.Sample) -> T:
            value = decode(sample.payload.to_bytes(), str(sample.encoding))
            if not isinstance(value, kind):
                raise InvalidInput(f"{topic} was published as a {type(value).__name__}")
            return value

        feed: Feed[T] = Feed(capacity)

        def on_sample(sample: zenoh.Sample) -> None:
            try:
                feed.put(value_of(sample))
            except InvalidInput as error:
                feed.put(error)

        key = self.keys.topic(topic)
        with _open(self.endpoint):
            subscriber = self._session.declare_subscriber(key, zenoh.handlers.Callback(on_sample))
        return self._keep(feed, subscriber)

    def watch_daemon(self) -> Feed[bool]:
        """Return whether a daemon serves the robot: now, and at every change."""
        feed: Feed[bool] = Feed(capacity=16)

        def on_sample(sample: zenoh.Sample) -> None:
            feed.put(sample.kind == zenoh.SampleKind.PUT)

        with _open(self.endpoint):
            subscriber = self._session.liveliness().declare_subscriber(
                self.keys.liveliness, zenoh.handlers.Callback(on_sample), history=True
            )
        return self._keep(feed, subscriber)

    def unsubscribe(self, feed: Feed[T]) -> None:
        """End a feed."""
        feed.close()
        with self._lock:
            ended = [subscriber for known, subscriber in self._feeds if known is feed]
            self._feeds = [entry for entry in self._feeds if entry[0] is not feed]
        for subscriber in ended:
            subscriber.undeclare()

    def unanswered(self, key: str) -> Unavailable:
        """Ask why there is no answer, and return it: nobody is there, or not for this client."""
        name = f"daemon of site {self.keys.site}, robot {self.keys.robot}"
        with _open(self.endpoint):
            liveliness = self._session.liveliness()
            tokens = liveliness.get(self.keys.liveliness, timeout=_MOST_CONNECTING_S)
            if any(reply.ok is not None for reply in tokens):
                where = f"the {name} is at {self.endpoint}"
                return AccessDenied(f"{where}, and {key} is not granted here")
        return Unavailable(f"nobody answers {key} at {self.endpoint}: no {name}")

    def _keep(self, feed: Feed[T], subscriber: zenoh.Subscriber[None]) -> Feed[T]:
        with self._lock:
            self._feeds.append((cast(Feed[object], feed), subscriber))
        return feed

    def _publisher(self, key: str) -> zenoh.Publisher:
        with _open(self.endpoint):
            publisher = self._session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.BLOCK,
                reliability=zenoh.Reliability.RELIABLE,
            )
        # Before the daemon's subscription is known here, samples would go nowhere.
        is_matched = threading.Event()
        listener = publisher.declare_matching_listener(lambda _: is_matched.set())
        # The stubs say bool, and the object is always true.
        status = cast(zenoh.MatchingStatus, publisher.matching_status)
        is_there = status.matching or is_matched.wait(self.timeout_s)
        listener.undeclare()
        if not is_there:
            raise self.unanswered(key)
        return publisher


@contextmanager
def _open(endpoint: str) -> Iterator[None]:
    """Say of a session that is closed that it is.

    Raises:
        Unavailable: If it is.
    """
    try:
        yield
    except zenoh.ZError as error:
        raise Unavailable(f"the connection to {endpoint} is closed: {error}") from error


class _Exchange(Generic[T]):
    """One question on its way, and the replies so far."""

    def __init__(self, connection: Connection, ask: Ask[T], timeout_s: float) -> None:
        self.future: Future[T] = Future()
        self.future.set_running_or_notify_cancel()
        self._connection = connection
        self._ask = ask
        self._timeout_s = timeout_s
        self._encoding = ""
        self._parts: dict[int, bytes] = {}
        self._count = 0
        self._error: HmtError | None = None

    def take(self, reply: zenoh.Reply) -> None:
        """Take a reply, whole or a part."""
        answer = reply.result
        try:
            place, count = 0, 1
            if isinstance(answer, zenoh.Sample) and answer.attachment is not None:
                place, count = decode_place(answer.attachment.to_bytes())
            self._parts[place], self._count = answer.payload.to_bytes(), count
            self._encoding = str(answer.encoding)
            if reply.err is not None:
                self._error = self._error_of(self._parts.pop(place))
        except HmtError as error:
            self._error = error

    def end(self) -> None:
        """Give the answer, or the error: no more replies come."""
        if self._parts or self._error is not None:
            self._conclude()
        else:
            # Why not is asked, for which Zenoh's own thread must not wait.
            threading.Thread(target=self._conclude, name="unanswered", daemon=True).start()

    def _conclude(self) -> None:
        try:
            self.future.set_result(self._ask.complete(self._value()))
        except Exception as error:  # noqa: BLE001 - whoever waits must learn it
            self.fail(error)

    def fail(self, error: Exception) -> None:
        """Give an error instead of an answer, unless there is one already."""
        with suppress(InvalidStateError):
            self.future.set_exception(error)

    def _value(self) -> T:
        if self._error is not None:
            raise self._error
        if not self._parts:
            raise self._connection.unanswered(self._ask.key)
        if len(self._parts) < self._count:
            raise Unavailable(
                f"{len(self._parts)} of {self._count} parts of the answer to {self._ask.key} "
                "arrived: the connection was too slow, or broke"
            )
        whole = b"".join(self._parts[place] for place in range(self._count))
        self._parts.clear()
        value = decode(whole, self._encoding)
        if not isinstance(value, self._ask.kind):
            raise InvalidInput(f"{self._ask.key} was answered by a {type(value).__name__}")
        return value

    def _error_of(self, payload: bytes) -> HmtError:
        if not self._encoding.startswith(PREFIX):
            # Zenoh's own, which is about time.
            text = payload.decode(errors="replace")
            where = f"{self._ask.key} at {self._connection.endpoint}"
            return DeadlineExceeded(f"no answer in {self._timeout_s:g} s: {where}: {text}")
        error = decode(payload, self._encoding)
        return error if isinstance(error, HmtError) else InvalidInput(f"{self._ask.key}: {error}")


class Pressure:
    """Whether a sender has to look how far the daemon is behind: it drops what it cannot hold."""

    def __init__(self) -> None:
        self._unchecked_bytes = 0

    def is_due(self, size: int) -> bool:
        """Return whether so much was sent since the last look, `size` bytes included."""
        self._unchecked_bytes += size
        return self._unchecked_bytes > _CHECK_EVERY_BYTES

    def has_room(self, status: Status) -> bool:
        """Return whether the daemon takes more, as it says itself."""
        has_room = status.input.queued_bytes <= _MOST_QUEUED_BYTES
        if has_room:
            self._unchecked_bytes = 0
        return has_room


class LoopWatch:
    """Whether the robot has come back to a known area since a moment."""

    def __init__(self, before: Posterior | None, probability: float) -> None:
        """Begin.

        Args:
            before: What was believed at that moment; None before the first keyframe.
            probability: Mass of the hypotheses that must say so, in (0, 1].
        """
        self._known = 0 if before is None else before.hypotheses[0].loop_closures
        self._probability = probability

    def is_seen_in(self, posterior: Posterior) -> bool:
        """Return whether it has, as is believed now."""
        returned = (h.probability for h in posterior.hypotheses if h.loop_closures > self._known)
        return sum(returned) >= self._probability
