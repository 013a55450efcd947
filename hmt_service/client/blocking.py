"""The client of ordinary programs: every call waits for its answer.

References:
    own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Concatenate, Generic, ParamSpec, Self, TypeVar

from hmt_service.client.calls import Ask, Calls
from hmt_service.client.connection import POLL_S, Connection, LoopWatch, Pressure
from hmt_service.client.feed import Feed
from hmt_service.core.types import Event, EventKind, HmtPose, Posterior, Reading
from hmt_service.errors import AccessDenied, DeadlineExceeded, Unavailable
from hmt_service.service.keys import Input, Keys, Topic
from hmt_service.service.readings import encode_reading, name_of

P = ParamSpec("P")
T = TypeVar("T")


class Live(Generic[T]):
    """What a daemon publishes, as it comes: an iterator, and a context manager that ends it."""

    def __init__(self, connection: Connection, feed: Feed[T]) -> None:
        self._connection = connection
        self._feed = feed

    @property
    def dropped(self) -> int:
        """Number of values that this program was too slow for: the oldest ones that waited."""
        return self._feed.dropped

    def next(self, timeout_s: float | None = None) -> T:
        """Return the next value.

        Args:
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If none comes in time.
            Unavailable: If the client is closed.
        """
        value = self._feed.get(timeout_s)
        if value is not None:
            return value
        if self._feed.is_over:
            raise Unavailable("nothing more comes: the client is closed")
        raise DeadlineExceeded(f"nothing was published for {timeout_s:g} s")

    def first(self, is_wanted: Callable[[T], bool], timeout_s: float | None = None) -> T:
        """Return the first value that is wanted; those before it are gone.

        Args:
            is_wanted: Says of each value whether it is.
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If none comes in time.
            Unavailable: If the client is closed.
        """
        end_s = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            value = self.next(None if end_s is None else max(0.0, end_s - time.monotonic()))
            if is_wanted(value):
                return value

    def close(self) -> None:
        """Want nothing more."""
        self._connection.unsubscribe(self._feed)

    def __iter__(self) -> Self:
        """Return the iterator."""
        return self

    def __next__(self) -> T:
        """Wait for the next value; the iteration ends when this or the client is closed."""
        value = self._feed.get()
        if value is None:
            raise StopIteration
        return value

    def __enter__(self) -> Self:
        """Return the iterator."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Want nothing more."""
        self.close()


def _answered(
    call: Callable[Concatenate[Calls, P], Ask[T]],
) -> Callable[Concatenate[HmtClient, P], T]:
    """Return the method that asks this and waits for the answer."""

    @wraps(call)
    def ask(client: HmtClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return client._connection.ask(call(client._calls, *args, **kwargs)).result()

    return ask


class HmtClient:
    """One connection to the daemon of one robot; a context manager that closes it.

    May be used from several threads at once.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        site: str = "site",
        robot: str = "robot",
        timeout_s: float = 10.0,
        zenoh_config: Path | None = None,
    ) -> None:
        """Connect.

        Args:
            endpoint: Zenoh endpoint of the daemon, or of a router that reaches it; None for the
                one that `zenoh_config` names, or `DEFAULT_ENDPOINT`.
            site: Where the robot works.
            robot: Which one it is.
            timeout_s: How long to wait for an answer, wall clock, 600 at most.
            zenoh_config: File of Zenoh settings: certificates or a password.

        Raises:
            InvalidInput: If a name cannot be part of a key, or Zenoh refuses the file.
            NotFound: If there is no such file.
            Unavailable: If nobody listens at the endpoint, or does not let this client in.
        """
        keys = Keys(site, robot)
        self._calls = Calls(keys)
        self._connection = Connection(endpoint, keys, timeout_s, zenoh_config)
        self._pressure = Pressure()

    def close(self) -> None:
        """Close the connection; iterations over publications end."""
        self._connection.close()

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the connection."""
        self.close()

    status = _answered(Calls.status)
    pose = _answered(Calls.pose)
    posterior = _answered(Calls.posterior)
    hypotheses = _answered(Calls.hypotheses)
    events = _answered(Calls.events)
    history = _answered(Calls.history)
    map = _answered(Calls.map)
    areas = _answered(Calls.areas)
    area = _answered(Calls.area)
    trajectory = _answered(Calls.trajectory)
    compare = _answered(Calls.compare)
    finish = _answered(Calls.finish)
    save = _answered(Calls.save)
    relocalize = _answered(Calls.relocalize)
    load = _answered(Calls.load)
    reset = _answered(Calls.reset)
    assert_arc = _answered(Calls.assert_arc)
    retract_arc = _answered(Calls.retract_arc)
    shut_down = _answered(Calls.shut_down)

    def poses_live(self, *, capacity: int = 100) -> Live[HmtPose]:
        """Return where the robot is, at every scan from now on.

        Args:
            capacity: How many poses may wait to be taken; then the oldest are dropped.
        """
        return Live(self._connection, self._connection.subscribe(Topic.POSE, HmtPose, capacity))

    def posteriors_live(self, *, capacity: int = 100) -> Live[Posterior]:
        """Return the belief over topologies, whenever it changes from now on.

        Args:
            capacity: How many may wait to be taken; then the oldest are dropped.
        """
        return Live(
            self._connection, self._connection.subscribe(Topic.POSTERIOR, Posterior, capacity)
        )

    def events_live(self, *, capacity: int = 1000) -> Live[Event]:
        """Return what is decided from now on, with the numbers that caused it.

        Args:
            capacity: How many events may wait to be taken; then the oldest are dropped.
        """
        return Live(self._connection, self._connection.subscribe(Topic.EVENT, Event, capacity))

    def wait_for_daemon(self, timeout_s: float | None = None) -> None:
        """Return as soon as a daemon serves the robot, which a router may know before it does.

        Args:
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If there is none in time.
        """
        with Live(self._connection, self._connection.watch_daemon()) as changes:
            changes.first(bool, timeout_s)

    def wait_for_event(self, *kinds: EventKind, timeout_s: float | None = None) -> Event:
        """Return the first event of certain kinds from now on.

        Args:
            kinds: Which ones; any if none is given.
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If there is none in time.
        """
        with self.events_live() as events:
            return events.first(lambda event: not kinds or event.kind in kinds, timeout_s)

    def wait_for_loop(
        self, *, probability: float = 0.95, timeout_s: float | None = None
    ) -> Posterior:
        """Return the belief as soon as it says that the robot is back in a known area.

        Args:
            probability: How sure that must be: mass of the hypotheses in which it has entered a
                known area since the call, in (0, 1].
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If it does not in time.
            AccessDenied: If this client may not ask for the posterior.
        """
        with self.posteriors_live() as posteriors:
            try:
                before = self.posterior()
            except (AccessDenied, DeadlineExceeded):
                raise
            except Unavailable:
                before = None
            watch = LoopWatch(before, probability)
            return posteriors.first(watch.is_seen_in, timeout_s)

    def publish(self, reading: Reading) -> int:
        """Send a reading; waits while the network or the daemon is behind, and drops nothing.

        Returns:
            The size of what was sent, bytes.

        Raises:
            InvalidInput: If the stamp is not finite.
            Unavailable: If nobody takes it, or not from this client.
        """
        message = encode_reading(reading)
        if self._pressure.is_due(len(message.payload)):
            while not self._pressure.has_room(self.status()):
                time.sleep(POLL_S)
        name = name_of(reading)
        self._connection.put(name, message.payload, message.encoding)
        return len(message.payload)

    def lost(self) -> Mapping[Input, int]:
        """Return how many of the readings published here never arrived.

        None while the connection lasts; it comes back by itself, but what is sent meanwhile is
        lost. What became of the others is in `status`: refused by reason, or in the map.
        """
        sent = self._connection.sent()
        return self._connection.lost_of(sent, self.status())

    def publish_raw(self, name: Input, payload: bytes, encoding: str) -> None:
        """Send any payload as a scan or as odometry; waits while the network is behind.

        Args:
            name: What it is sent as.
            payload: A serialised message.
            encoding: Its name, such as `application/protobuf;foxglove.LaserScan`.

        Raises:
            Unavailable: If nobody takes it, or not from this client.
        """
        self._connection.put(name, payload, encoding)
