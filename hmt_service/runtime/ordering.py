"""Readings in the order of their stamps, although they arrive a little out of order.

References:
    own.
"""

from __future__ import annotations

import heapq
import math

from hmt_service.core.types import OdometryReading, Reading


class ReorderWindow:
    """Holds readings back until none can arrive that belongs before them.

    The order is by stamp; of equal stamps odometry comes first, then the order of arrival. Stamps
    are the only clock, so that the order of the output depends on the input alone.
    """

    def __init__(self, window_s: float) -> None:
        """Hold readings for `window_s` of sensor time."""
        self._window_s = window_s
        self._heap: list[tuple[float, bool, int, Reading]] = []
        self._arrivals = 0
        self._newest_s = -math.inf
        self._released_s = -math.inf

    def __len__(self) -> int:
        """Return the number of readings held."""
        return len(self._heap)

    @property
    def released_s(self) -> float:
        """Stamp of the last reading released, s; -inf before the first."""
        return self._released_s

    def push(self, reading: Reading) -> tuple[Reading, ...] | None:
        """Take one reading.

        Returns:
            The readings whose turn it is, in order; None when this one is older than a released
            one.
        """
        if reading.stamp_s < self._released_s:
            return None
        is_scan = not isinstance(reading, OdometryReading)
        heapq.heappush(self._heap, (reading.stamp_s, is_scan, self._arrivals, reading))
        self._arrivals += 1
        self._newest_s = max(self._newest_s, reading.stamp_s)
        return self._release(self._newest_s - self._window_s)

    def flush(self) -> tuple[Reading, ...]:
        """Return everything that is held, in order."""
        return self._release(math.inf)

    def _release(self, until_s: float) -> tuple[Reading, ...]:
        released = []
        # Strictly before: a reading with the stamp `until_s` may still arrive, and come first.
        while self._heap and self._heap[0][0] < until_s:
            released.append(heapq.heappop(self._heap)[-1])
        if released:
            self._released_s = released[-1].stamp_s
        return tuple(released)
