"""What a daemon publishes, on its way to a program that may be slower.

References:
    own.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Feed(Generic[T]):
    """The latest values, in order, from one thread to another; the oldest make room for new ones.

    What cannot be understood waits in its place as the error that it is.
    """

    def __init__(self, capacity: int) -> None:
        """Start empty and open.

        Args:
            capacity: How many values may wait, >= 1.
        """
        self._values: deque[T | Exception] = deque(maxlen=capacity)
        self._dropped = 0
        self._is_closed = False
        self._changed = threading.Condition()
        self._wake: Callable[[], object] = lambda: None

    @property
    def dropped(self) -> int:
        """Number of values that nobody took in time."""
        return self._dropped

    @property
    def is_over(self) -> bool:
        """Whether there is no value and none will come."""
        return self._is_closed and not self._values

    def on_change(self, wake: Callable[[], object]) -> None:
        """Have a function called, from any thread, after each change."""
        self._wake = wake

    def put(self, value: T | Exception) -> None:
        """Append a value."""
        with self._changed:
            self._dropped += len(self._values) == self._values.maxlen
            self._values.append(value)
            self._changed.notify_all()
        self._wake()

    def close(self) -> None:
        """Take nothing more; what waits can still be taken out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._wake()

    def get(self, timeout_s: float | None = None) -> T | None:
        """Return the oldest value; None after `timeout_s`, or when the feed is over.

        Raises:
            InvalidInput: If it could not be understood.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._values or self._is_closed, timeout_s)
            if not self._values:
                return None
            value = self._values.popleft()
        if isinstance(value, Exception):
            raise value
        return value
