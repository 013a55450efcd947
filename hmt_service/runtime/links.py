"""The parent's end of the pipes to children, one after the other: neither side waits for the other.

References:
    own.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from hmt_service.runtime.messages import Answered, News, Ready, Stop, dump, load
from hmt_service.runtime.queues import SizedQueue

_IN_FLIGHT = 2
"""Messages sent and not yet answered: one that the child works on, and the next."""


@dataclass(frozen=True, slots=True, eq=False)
class _Message:
    data: bytes
    is_token: bool


class _HungUp:
    """Wakes the writing thread of a line whose child is gone."""


class Link:
    """Messages to a child, and its one answer to each, in order; outlives the child.

    What the child has not taken yet waits here, where it can be counted and discarded, not in the
    pipe. What one child has not answered is sent to the next one first.
    """

    def __init__(
        self, name: str, *, limit_bytes: int, receive: Callable[[Any, bytes, bytes], None]
    ) -> None:
        """Prepare; `connect` connects.

        Args:
            name: Name of the threads.
            limit_bytes: Size of what may wait here.
            receive: Called with `Ready`, `News` and every answer of a child, as a message, as the
                bytes that it came in and those that it answers, from the reading thread; while it
                blocks, the child gets no more work.
        """
        self._name = name
        self._receive = receive
        self._outbox: SizedQueue[_Message | _HungUp] = SizedQueue(limit_bytes)
        self._unanswered: deque[_Message] = deque()
        self._suspect: _Message | None = None
        self._line: _Line | None = None
        self.was_ready = False
        """Whether the last child that is disconnected had said that it takes work."""

    def connect(self, connection: Connection, opening: object = None) -> None:
        """Talk to a child from now on; the one before is gone and disconnected.

        Args:
            connection: The parent's end of the pipe, owned from now on.
            opening: What the child is told first, without an answer; None for nothing.
        """
        first = () if opening is None else (dump(opening),)
        self._line = _Line(
            connection, self._name, self._outbox, self._unanswered, first, receive=self._receive
        )

    @property
    def is_ready(self) -> bool:
        """Whether the child has said that it takes work."""
        return self._line is not None and self._line.is_ready

    @property
    def is_broken(self) -> bool:
        """Whether a thread has ended: the child is gone, or the code here is wrong."""
        return self._line is not None and self._line.is_broken

    @property
    def backlog(self) -> int:
        """Number of messages that wait here or at the child."""
        return len(self._outbox) + len(self._unanswered)

    def put(self, data: bytes) -> bool:
        """Send a message as soon as there is room for it; return False when the link is closed."""
        return self._outbox.put(_Message(data, is_token=False), len(data))

    def put_token(self, message: object) -> bool:
        """Send a message that is never discarded; return False when the link is closed."""
        return self._outbox.put_token(_Message(dump(message), is_token=True))

    def discard(self) -> int:
        """Throw away what was not sent yet, tokens apart, and return how many messages."""
        return self._outbox.discard()

    def disconnect(self) -> None:
        """Wait for the threads, which end when the child has, and free the pipe."""
        if self._line is not None:
            self._line.join()
            self.was_ready = self._line.is_ready
            self._line = None

    def take_fatal(self) -> Any:
        """Take out the message that two children in a row have died of; None if there is none.

        To be called once after each of them that was ready has died and is disconnected.
        """
        before, self._suspect = self._suspect, None
        if not self._unanswered:
            return None
        if self._unanswered[0] is before:
            return load(self._unanswered.popleft().data)
        self._suspect = self._unanswered[0]
        return None

    def clear(self) -> None:
        """Throw away all that waits, and what the child that is gone has not answered."""
        self._outbox.clear()
        self._unanswered.clear()

    def discard_all(self) -> None:
        """Throw away what waits and what the child that is gone has not answered, tokens apart."""
        self._outbox.discard()
        tokens = [message for message in self._unanswered if message.is_token]
        self._unanswered.clear()
        self._unanswered.extend(tokens)

    def stop(self) -> None:
        """Send what waits, then tell the child to end; nothing more is taken."""
        self.put_token(Stop())
        self._outbox.close()

    def abandon(self) -> None:
        """Take nothing more, and forget what waits: there will be no child any more."""
        self._outbox.close()
        self._outbox.discard()


class _Line:
    """The pipe to one child, and both threads at its end."""

    def __init__(
        self,
        connection: Connection,
        name: str,
        outbox: SizedQueue[_Message | _HungUp],
        unanswered: deque[_Message],
        first: tuple[bytes, ...],
        *,
        receive: Callable[[Any, bytes, bytes], None],
    ) -> None:
        self._connection = connection
        self._outbox = outbox
        self._unanswered = unanswered
        self._receive = receive
        self._first = (*first, *(message.data for message in unanswered))
        self._credit = threading.Semaphore(_IN_FLIGHT - len(unanswered))
        self._hung_up = _HungUp()
        self._is_over = False
        self.is_ready = False
        self._threads = (
            threading.Thread(target=self._write, name=f"{name}-write", daemon=True),
            threading.Thread(target=self._read, name=f"{name}-read", daemon=True),
        )
        for thread in self._threads:
            thread.start()

    @property
    def is_broken(self) -> bool:
        return not all(thread.is_alive() for thread in self._threads)

    def join(self) -> None:
        for thread in self._threads:
            thread.join()
        self._connection.close()

    def _write(self) -> None:
        try:
            for data in self._first:
                self._connection.send_bytes(data)
            while (message_or_end := self._next()) is not None:
                self._unanswered.append(message_or_end)
                self._connection.send_bytes(message_or_end.data)
        except OSError:
            pass  # the child is gone, and the reading thread learns it too

    def _next(self) -> _Message | None:
        """Return what to send next, as soon as the child may have it; None at the end."""
        self._credit.acquire()
        while not self._is_over:
            item = self._outbox.get()
            if item is None or item is self._hung_up:
                return None
            if isinstance(item, _Message):
                return item
        return None

    def _read(self) -> None:
        try:
            while True:
                data = self._connection.recv_bytes()
                message = load(data)
                if isinstance(message, Ready | News):
                    self.is_ready = True
                    self._receive(message, data, b"")
                    continue
                self._receive(message, data, self._unanswered[0].data)
                if isinstance(message, Answered) and not message.is_last:
                    continue
                self._unanswered.popleft()
                self._credit.release()
        except (EOFError, OSError):
            pass  # the child is gone
        finally:
            self._is_over = True
            self._credit.release()
            self._outbox.put_token(self._hung_up)
