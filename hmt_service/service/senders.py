"""What arrived of each sender, by the numbers that it gives its readings.

The network drops nothing while a connection lasts; what is sent between two connections goes
nowhere, and nobody else knows of it.

References:
    own.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

from hmt_service.service.codec import decode_origin
from hmt_service.service.keys import Input
from hmt_service.service.reports import SenderCounts

_MOST = 100
"""Senders whose counts are kept, those heard of last."""


class Senders:
    """Owner of the counts; may be used from any thread."""

    def __init__(self) -> None:
        self._counts: OrderedDict[tuple[int, Input], SenderCounts] = OrderedDict()
        self._lock = threading.Lock()

    def note(self, name: Input, attachment: bytes) -> None:
        """Count a sample, if its sender says who it is; whatever else is attached is no error."""
        origin = decode_origin(attachment)
        if origin is None:
            return
        sender, number = origin
        with self._lock:
            before = self._counts.pop((sender, name), SenderCounts(sender, name, 0, 0))
            received = before.received + 1
            sent = max(number + 1, before.received + before.lost)
            self._counts[sender, name] = SenderCounts(
                sender, name, received, max(0, sent - received)
            )
            if len(self._counts) > _MOST:
                self._counts.popitem(last=False)

    def counts(self) -> tuple[SenderCounts, ...]:
        """Return what arrived of whom, the sender heard of last at the end."""
        with self._lock:
            return tuple(self._counts.values())
