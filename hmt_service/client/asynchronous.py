"""The client of asyncio programs: every call is awaited, and the event loop never waits.

References:
    own.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar

from hmt_service.client.calls import Ask, Calls
from hmt_service.client.connection import POLL_S, Connection, LoopWatch, Pressure
from hmt_service.client.feed import Feed
from hmt_service.core.types import Event, EventKind, HmtPose, Posterior, Reading
from hmt_service.errors import AccessDenied, DeadlineExceeded, Unavailable
from hmt_service.service.keys import Input, Keys, Topic
from hmt_service.service.readings import encode_reading, name_of

P = ParamSpec("P")
T = TypeVar("T")


class AsyncLive(Generic[T]):
    """What a daemon publishes, as it comes: an iterator, and a context manager that ends it."""

    def __init__(self, connection: Connection, feed: Feed[T]) -> None:
        self._connection = connection
        self._feed = feed
        self._changed = asyncio.Event()
        loop = asyncio.get_running_loop()

        def wake() -> None:
            with suppress(RuntimeError):  # the loop is closed, and nobody waits
                loop.call_soon_threadsafe(self._changed.set)

        feed.on_change(wake)
        self._changed.set()

    @property
    def dropped(self) -> int:
        """Number of values that this program was too slow for: the oldest ones that waited."""
        return self._feed.dropped

    async def next(self, timeout_s: float | None = None) -> T:
        """Return the next value.

        Args:
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If none comes in time.
            Unavailable: If the client is closed.
        """
        return await self.first(lambda _: True, timeout_s)

    async def first(self, is_wanted: Callable[[T], bool], timeout_s: float | None = None) -> T:
        """Return the first value that is wanted; those before it are gone.

        Args:
            is_wanted: Says of each value whether it is.
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If none comes in time.
            Unavailable: If the client is closed.
        """
        try:
            async with asyncio.timeout(timeout_s):
                async for value in self:
                    if is_wanted(value):
                        return value
        except TimeoutError as error:
            raise DeadlineExceeded(f"not published within {timeout_s:g} s") from error
        raise Unavailable("nothing more comes: the client is closed")

    async def close(self) -> None:
        """Want nothing more."""
        await asyncio.to_thread(self._connection.unsubscribe, self._feed)

    def __aiter__(self) -> Self:
        """Return the iterator."""
        return self

    async def __anext__(self) -> T:
        """Wait for the next value; the iteration ends when this or the client is closed."""
        while True:
            self._changed.clear()
            value = self._feed.get(0.0)
            if value is not None:
                return value
            if self._feed.is_over:
                raise StopAsyncIteration
            await self._changed.wait()

    async def __aenter__(self) -> Self:
        """Return the iterator."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Want nothing more."""
        await self.close()


def _answered(
    call: Callable[Concatenate[Calls, P], Ask[T]],
) -> Callable[Concatenate[AsyncHmtClient, P], Coroutine[Any, Any, T]]:
    """Return the method that asks this and awaits the answer."""

    @wraps(call)
    async def ask(client: AsyncHmtClient, /, *args: P.args, **kwargs: P.kwargs) -> T:
        asked = call(client._calls, *args, **kwargs)
        return await asyncio.wrap_future(client._connected.ask(asked))

    return ask


class AsyncHmtClient:
    """One connection to the daemon of one robot; an asynchronous context manager that opens it."""

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        site: str = "site",
        robot: str = "robot",
        timeout_s: float = 10.0,
        zenoh_config: Path | None = None,
    ) -> None:
        """Prepare; `async with` connects.

        Args:
            endpoint: Zenoh endpoint of the daemon, or of a router that reaches it; None for the
                one that `zenoh_config` names, or `DEFAULT_ENDPOINT`.
            site: Where the robot works.
            robot: Which one it is.
            timeout_s: How long to wait for an answer, wall clock, 600 at most.
            zenoh_config: File of Zenoh settings: certificates or a password.

        Raises:
            InvalidInput: If a name cannot be part of a key.
        """
        self._endpoint, self._zenoh_config = endpoint, zenoh_config
        self._keys = Keys(site, robot)
        self._timeout_s = timeout_s
        self._calls = Calls(self._keys)
        self._connection: Connection | None = None
        self._pressure = Pressure()

    async def __aenter__(self) -> Self:
        """Connect, and return the client.

        Raises:
            InvalidInput: If Zenoh refuses the file.
            NotFound: If there is no such file.
            Unavailable: If nobody listens at the endpoint, or does not let this client in.
        """
        self._connection = await asyncio.to_thread(
            Connection, self._endpoint, self._keys, self._timeout_s, self._zenoh_config
        )
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the connection; iterations over publications end."""
        await asyncio.to_thread(self._connected.close)

    @property
    def _connected(self) -> Connection:
        if self._connection is None:
            raise Unavailable("the client is not connected: use `async with`")
        return self._connection

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

    def poses_live(self, *, capacity: int = 100) -> AsyncLive[HmtPose]:
        """Return where the robot is, at every scan from now on.

        Args:
            capacity: How many poses may wait to be taken; then the oldest are dropped.
        """
        return self._live(Topic.POSE, HmtPose, capacity)

    def posteriors_live(self, *, capacity: int = 100) -> AsyncLive[Posterior]:
        """Return the belief over topologies, whenever it changes from now on.

        Args:
            capacity: How many may wait to be taken; then the oldest are dropped.
        """
        return self._live(Topic.POSTERIOR, Posterior, capacity)

    def events_live(self, *, capacity: int = 1000) -> AsyncLive[Event]:
        """Return what is decided from now on, with the numbers that caused it.

        Args:
            capacity: How many events may wait to be taken; then the oldest are dropped.
        """
        return self._live(Topic.EVENT, Event, capacity)

    async def wait_for_daemon(self, timeout_s: float | None = None) -> None:
        """Return as soon as a daemon serves the robot, which a router may know before it does.

        Args:
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If there is none in time.
        """
        async with AsyncLive(self._connected, self._connected.watch_daemon()) as changes:
            await changes.first(bool, timeout_s)

    async def wait_for_event(self, *kinds: EventKind, timeout_s: float | None = None) -> Event:
        """Return the first event of certain kinds from now on.

        Args:
            kinds: Which ones; any if none is given.
            timeout_s: How long to wait for it, wall clock; None for as long as it takes.

        Raises:
            DeadlineExceeded: If there is none in time.
        """
        async with self.events_live() as events:
            return await events.first(lambda event: not kinds or event.kind in kinds, timeout_s)

    async def wait_for_loop(
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
        async with self.posteriors_live() as posteriors:
            try:
                before = await self.posterior()
            except (AccessDenied, DeadlineExceeded):
                raise
            except Unavailable:
                before = None
            watch = LoopWatch(before, probability)
            return await posteriors.first(watch.is_seen_in, timeout_s)

    async def publish(self, reading: Reading) -> int:
        """Send a reading; waits while the network or the daemon is behind, and drops nothing.

        Returns:
            The size of what was sent, bytes.

        Raises:
            InvalidInput: If the stamp is not finite.
            Unavailable: If nobody takes it, or not from this client.
        """
        message = encode_reading(reading)
        if self._pressure.is_due(len(message.payload)):
            while not self._pressure.has_room(await self.status()):
                await asyncio.sleep(POLL_S)
        name = name_of(reading)
        # The network may take its time.
        await asyncio.to_thread(self._connected.put, name, message.payload, message.encoding)
        return len(message.payload)

    async def lost(self) -> Mapping[Input, int]:
        """Return how many of the readings published here never arrived.

        None while the connection lasts; it comes back by itself, but what is sent meanwhile is
        lost. What became of the others is in `status`: refused by reason, or in the map.
        """
        sent = self._connected.sent()
        return self._connected.lost_of(sent, await self.status())

    def _live(self, topic: Topic, kind: type[T], capacity: int) -> AsyncLive[T]:
        return AsyncLive(self._connected, self._connected.subscribe(topic, kind, capacity))
