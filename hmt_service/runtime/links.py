"""The parent's end of a pipe to a child: one thread writes, one reads, neither waits for the other.

References:
    own.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from hmt_service.runtime.messages import Part, Ready, Stop, dump, load
from hmt_service.runtime.queues import SizedQueue

_IN_FLIGHT = 2
"""Messages sent and not yet answered: one that the child works on, and the next."""


class Link:
    """Messages to a child, and its one answer to each, in order.

    What the child has not taken yet waits here, where it can be counted and discarded, not in the
    pipe.
    """

    def __init__(
        self,
        connection: Connection,
        name: str,
        *,
        limit_bytes: int,
        receive: Callable[[Any, bytes], None],
    ) -> None:
        """Own the parent's end of a pipe.

        Args:
            connection: That end.
            name: Name of the threads.
            limit_bytes: Size of what may wait here.
            receive: Called with every answer of the child, as a message and as the bytes that it
                came in, from the reading thread; while it blocks, the child gets no more work.
        """
        self._connection = connection
        self._receive = receive
        self._outbox: SizedQueue[bytes] = SizedQueue(limit_bytes)
        self._credit = threading.Semaphore(_IN_FLIGHT)
        self._sent = 0
        self._answered = 0
        self._is_ready = False
        self._is_over = False
        self._threads = (
            threading.Thread(target=self._write, name=f"{name}-write", daemon=True),
            threading.Thread(target=self._read, name=f"{name}-read", daemon=True),
        )

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    @property
    def is_ready(self) -> bool:
        """Whether the child has said that it takes work."""
        return self._is_ready

    @property
    def is_broken(self) -> bool:
        """Whether a thread has ended: the child is gone, or the code here is wrong."""
        return not all(thread.is_alive() for thread in self._threads)

    @property
    def backlog(self) -> int:
        """Number of messages that wait here or at the child."""
        return len(self._outbox) + self._sent - self._answered

    def put(self, data: bytes) -> bool:
        """Send a message as soon as there is room for it; return False when the link is closed."""
        return self._outbox.put(data, len(data))

    def put_token(self, message: object) -> bool:
        """Send a message that is never discarded; return False when the link is closed."""
        return self._outbox.put_token(dump(message))

    def discard(self) -> int:
        """Throw away what was not sent yet, tokens apart, and return how many messages."""
        return self._outbox.discard()

    def stop(self) -> None:
        """Send what waits, then tell the child to end."""
        self.put_token(Stop())
        self._outbox.close()

    def join(self) -> None:
        """Wait for both threads, which end when the child has, and free the pipe."""
        for thread in self._threads:
            thread.join()
        self._connection.close()

    def _write(self) -> None:
        while (data := self._outbox.get()) is not None:
            self._credit.acquire()
            if self._is_over:
                break
            self._sent += 1
            try:
                self._connection.send_bytes(data)
            except OSError:
                break  # the child is gone, and the reading thread learns it too

    def _read(self) -> None:
        try:
            while True:
                data = self._connection.recv_bytes()
                message = load(data)
                if isinstance(message, Ready):
                    self._is_ready = True
                    if message.known is not None:
                        self._receive(message.known, data)
                    continue
                self._receive(message, data)
                if isinstance(message, Part) and not message.is_last:
                    continue
                self._answered += 1
                self._credit.release()
        except (EOFError, ConnectionResetError):
            pass  # the child is gone
        finally:
            self._is_over = True
            self._outbox.close()
            self._outbox.discard()
            self._credit.release()
