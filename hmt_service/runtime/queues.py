"""A queue between threads that is bounded by the size of what it holds.

References:
    own.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class SizedQueue(Generic[T]):
    """First in, first out, between threads; bounded in bytes, tokens apart.

    Tokens mark places in the stream ("the input ends here"): they have no size, are never refused
    while the queue is open, and survive `discard`.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._items: deque[tuple[T, int | None]] = deque()
        self._bytes = 0
        self._tokens = 0
        self._is_closed = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        """Return the number of items that wait, without tokens."""
        return len(self._items) - self._tokens

    @property
    def size_bytes(self) -> int:
        """Size of all items that wait."""
        return self._bytes

    def offer(self, item: T, size: int) -> bool:
        """Append an item of `size` bytes and return True, or return False when it does not fit."""
        with self._changed:
            if self._is_closed or not self._fits(size):
                return False
            self._append(item, size)
            return True

    def put(self, item: T, size: int) -> bool:
        """Append an item of `size` bytes when there is room; return False when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_closed or self._fits(size))
            if self._is_closed:
                return False
            self._append(item, size)
            return True

    def put_token(self, item: T) -> bool:
        """Append an item that takes no room; return False when the queue is closed."""
        with self._changed:
            if self._is_closed:
                return False
            self._append(item, None)
            return True

    def get(self, timeout_s: float | None = None) -> T | None:
        """Return the oldest item; None after `timeout_s`, or when closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._is_closed, timeout_s)
            if not self._items:
                return None
            item, size = self._items.popleft()
            if size is None:
                self._tokens -= 1
            else:
                self._bytes -= size
            self._changed.notify_all()
            return item

    def discard(self) -> int:
        """Throw away all items but tokens, and return how many those were."""
        with self._changed:
            count = len(self)
            self._items = deque(entry for entry in self._items if entry[1] is None)
            self._bytes = 0
            self._changed.notify_all()
            return count

    def clear(self) -> None:
        """Throw away all items, tokens too."""
        with self._changed:
            self._items.clear()
            self._bytes = self._tokens = 0
            self._changed.notify_all()

    def close(self) -> None:
        """Take nothing more; what waits can still be taken out."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _fits(self, size: int) -> bool:
        # An item larger than the limit passes when it is alone, or it could never pass.
        return self._bytes == 0 or self._bytes + size <= self._limit

    def _append(self, item: T, size: int | None) -> None:
        self._items.append((item, size))
        if size is None:
            self._tokens += 1
        else:
            self._bytes += size
        self._changed.notify_all()
