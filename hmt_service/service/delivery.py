"""Answers of the topology process on their way to who asked for them.

A large answer goes out in parts, from a thread of its own: a reply waits for the network, for up
to five seconds where a client reads nothing at all (Zenoh then closes its connection), and neither
the topology process nor other clients may wait with it, unless one reads so slowly that 64 MB wait:
then until its deadline.

References:
    own.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import zenoh

from hmt_service.errors import HmtError, Unavailable
from hmt_service.runtime.messages import Part, Result
from hmt_service.runtime.queues import SizedQueue
from hmt_service.service.questions import Question
from hmt_service.service.reports import Ack

_LOG = logging.getLogger(__name__)
_WAITING_BYTES = 64_000_000
"""What may wait for the network of one client; the topology process waits with the rest."""
_MOST = 4
"""Answers in several parts at once."""


class Deliveries:
    """Owner of the answers that are being sent, and of the bound on their number."""

    def __init__(self) -> None:
        self._slots = threading.Semaphore(_MOST)

    def begin(
        self, question: Question[Any], ack: Callable[[tuple[str, ...]], Ack]
    ) -> Callable[[Result], None]:
        """Return what takes the results of a question and passes them on.

        Args:
            question: Whom to answer.
            ack: Returns what is said of files that were saved.
        """
        return _Delivery(question, ack, self._slots).take


class _Delivery:
    """One answer."""

    def __init__(
        self,
        question: Question[Any],
        ack: Callable[[tuple[str, ...]], Ack],
        slots: threading.Semaphore,
    ) -> None:
        self._question = question
        self._ack = ack
        self._slots = slots
        self._parts: SizedQueue[Part | HmtError] = SizedQueue(_WAITING_BYTES)
        self._lock = threading.Lock()
        self._is_begun = False
        self._is_over = False

    def take(self, result: Result) -> None:
        """Pass a result on; waits while too much of the same answer waits already."""
        # The deadline may end an answer while its parts are still coming.
        with self._lock:
            if not (self._is_begun or self._is_over):
                self._begin(result)
        if self._is_begun and isinstance(result, Part):
            self._parts.put(result, len(result.wire.payload))
        elif self._is_begun and isinstance(result, HmtError):
            # Its time is over: nobody wants the rest, and who waits for room need not any more.
            self._parts.discard()
            self._parts.put_token(result)

    def _begin(self, result: Result) -> None:
        """Start to send parts, or be done at once."""
        match result:
            case Part() if result.count > 1 and self._slots.acquire(blocking=False):
                self._is_begun = True
                threading.Thread(target=self._send, name="delivery", daemon=True).start()
                return
            case Part() if result.count > 1:
                busy = f"{_MOST} large answers are being sent already"
                self._question.answer(Unavailable(busy))
            case Part():
                self._question.reply(result.wire)
            case tuple():
                self._question.answer(self._ack(result))
            case HmtError():
                self._question.answer(result)
        self._is_over = True

    def _send(self) -> None:
        try:
            while (item := self._parts.get()) is not None:
                if isinstance(item, HmtError):
                    self._question.answer(item)
                    return
                self._question.reply_part(item)
                if item.is_last:
                    return
        except zenoh.ZError as error:
            _LOG.info("an answer was not sent: %s", error)  # the session is closed
        finally:
            self._slots.release()
            self._parts.close()
            self._parts.discard()
