"""Readings in the order of their stamps, although they arrive a little out of order.

References:
    own.
"""

from __future__ import annotations

import heapq
import math

from hmt_service.core.types import OdometryReading, Reading

_JUMP_S = 60.0
"""A step of the stamps beyond this needs a second reading to be believed."""
_SILENCE_S = 2.0
"""Odometry that has been silent for so long is not waited for; what is so new is not known."""


class ReorderWindow:
    """Holds readings back until none can arrive that belongs before them.

    The order is by stamp; of equal stamps odometry comes first, then the order of arrival. Stamps
    are the only clock, so that the order of the output depends on the input alone.

    Who has sent in order for two seconds is believed to go on so: as long as scans do, and odometry
    too, a scan waits only for odometry as late as it is, and for none that has been silent for as
    long. At the beginning, and once one of them has not come in order, the window is for all.

    One wrong stamp far in the future must not make everything after it too old: a reading that
    jumps ahead is held until the next one says whether time has really gone on.
    """

    def __init__(self, window_s: float) -> None:
        """Hold readings for `window_s` of sensor time."""
        self._window_s = window_s
        self._jumped: Reading | None = None
        self._refuted = 0
        self._heap: list[tuple[float, bool, int, Reading]] = []
        self._arrivals = 0
        self._begun_s = math.inf
        self._newest_s = {"scan": -math.inf, "odometry": -math.inf}
        self._is_sorted = True
        self._released_s = -math.inf

    def __len__(self) -> int:
        """Return the number of readings held."""
        return len(self._heap) + (self._jumped is not None)

    @property
    def refuted(self) -> int:
        """Number of readings dropped so far because the next one had not jumped with them."""
        return self._refuted

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
        jumped, self._jumped = self._jumped, None
        if jumped is not None and abs(reading.stamp_s - jumped.stamp_s) <= _JUMP_S:
            return (*self._add(jumped), *self._add(reading))
        self._refuted += jumped is not None
        newest_s = max(self._newest_s.values())
        if newest_s < reading.stamp_s - _JUMP_S and math.isfinite(newest_s):
            self._jumped = reading
            return ()
        return self._add(reading)

    def flush(self) -> tuple[Reading, ...]:
        """Return everything that is held, in order, but for a jump that nothing confirms."""
        return self._release(before_s=math.inf)

    def finish(self) -> tuple[Reading, ...]:
        """Return everything that is held, in order."""
        jumped, self._jumped = self._jumped, None
        released = self._add(jumped) if jumped is not None else ()
        return (*released, *self.flush())

    def _add(self, reading: Reading) -> tuple[Reading, ...]:
        is_scan = not isinstance(reading, OdometryReading)
        heapq.heappush(self._heap, (reading.stamp_s, is_scan, self._arrivals, reading))
        self._arrivals += 1
        self._begun_s = min(self._begun_s, reading.stamp_s)
        kind = "scan" if is_scan else "odometry"
        self._is_sorted &= reading.stamp_s >= self._newest_s[kind]
        self._newest_s[kind] = max(self._newest_s[kind], reading.stamp_s)
        newest_s = max(self._newest_s.values())
        return self._release(before_s=newest_s - self._window_s, up_to_s=self._complete_s(newest_s))

    def _complete_s(self, newest_s: float) -> float:
        """Return up to which stamp all has come if both go on in order; -inf if that is unknown."""
        if not self._is_sorted or newest_s < self._begun_s + _SILENCE_S:
            return -math.inf
        scan_s, odometry_s = self._newest_s["scan"], self._newest_s["odometry"]
        return scan_s if odometry_s < newest_s - _SILENCE_S else min(scan_s, odometry_s)

    def _release(self, *, before_s: float, up_to_s: float = -math.inf) -> tuple[Reading, ...]:
        released = []
        # Strictly before: a reading with the stamp `before_s` may still arrive, and come first.
        while self._heap and (self._heap[0][0] < before_s or self._heap[0][0] <= up_to_s):
            released.append(heapq.heappop(self._heap)[-1])
        if released:
            self._released_s = released[-1].stamp_s
        return tuple(released)
