"""The way in: samples are queued at once, decoded in turn, checked, sorted by time, and handed on.

References:
    own.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from hmt_service.core.ordering import ReorderWindow
from hmt_service.core.types import Reading
from hmt_service.io.decoding import Decoded, Defect
from hmt_service.runtime.messages import Finish
from hmt_service.runtime.queues import SizedQueue
from hmt_service.service.keys import Input
from hmt_service.service.readings import ReadingDecoder, Refusal
from hmt_service.service.reports import InputCounts

_OVERHEAD_BYTES = 500
"""What a sample takes beside its payload: a flood of empty ones must not fill the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IntakeLimits:
    """What the way in can hold."""

    sample_bytes: int = 16_000_000
    """Largest sample; a larger one is refused before it is parsed. The clouds of a LiDAR of 128
    rows of 2,048 points come with 48 bytes per point."""
    queue_bytes: int = 256_000_000
    """Memory for samples that wait."""
    reorder_s: float = 0.25
    """How long readings wait for earlier ones, sensor time."""
    silence_s: float = 0.3
    """After this time without a sample, wall clock, readings wait no longer."""


@dataclass(frozen=True, slots=True)
class _Sample:
    name: Input
    payload: bytes
    encoding: str


class _Stop:
    """Marks the end of the queue."""


class Intake:
    """Owner of everything that has arrived and is not yet at the odometry."""

    def __init__(
        self,
        decoder: ReadingDecoder,
        limits: IntakeLimits,
        *,
        submit: Callable[[Reading], bool],
        finish: Callable[[Finish], bool],
    ) -> None:
        """Prepare; `start` starts.

        Args:
            decoder: Reads the samples, in the thread here.
            limits: What may wait here.
            submit: Takes the readings in order, and may block.
            finish: Takes the `Finish` behind the readings that came before it.
        """
        self._decoder = decoder
        self._limits = limits
        self._submit = submit
        self._finish = finish
        self._queue: SizedQueue[_Sample | Finish | _Stop] = SizedQueue(limits.queue_bytes)
        self._window = ReorderWindow(limits.reorder_s)
        self._thread = threading.Thread(target=self._pump, name="intake", daemon=True)
        self._lock = threading.Lock()
        self._may_go_on = threading.Event()
        self._is_closed = False
        self._is_stopped = False
        self._received = 0
        self._accepted = 0
        self._discarded = 0
        self._refused: Counter[Refusal | Defect] = Counter()
        self._dropped_beams: Counter[Defect] = Counter()

    def start(self) -> None:
        """Start to hand readings on."""
        self._thread.start()

    @property
    def is_broken(self) -> bool:
        """Whether the thread here has ended although nobody said `stop`."""
        return not self._thread.is_alive() and not self._is_stopped

    @property
    def last_stamp_s(self) -> float:
        """Stamp of the last reading handed on, s; -inf before the first."""
        return self._window.released_s

    def offer(self, name: Input | None, size: int, read: Callable[[], tuple[bytes, str]]) -> None:
        """Take a sample, or count why not, at once.

        Args:
            name: What it was sent as; None when that is unknown here.
            size: Size of its payload, bytes.
            read: Returns the payload and its encoding; not called when they are not wanted.
        """
        with self._lock:
            self._received += 1
            if name is None:
                self._refused[Refusal.UNKNOWN_KEY] += 1
            elif size > self._limits.sample_bytes:
                self._refused[Refusal.TOO_LARGE] += 1
            elif self._is_closed:
                self._refused[Refusal.STOPPING] += 1
            elif not self._queue.offer(_Sample(name, *read()), size + _OVERHEAD_BYTES):
                self._refused[Refusal.QUEUE_FULL] += 1

    def finish(self, finish: Finish) -> None:
        """Hand on what has arrived without waiting for earlier readings, and `finish` behind it."""
        self._queue.put_token(finish)

    def go_on(self) -> None:
        """Let what waits behind the last reading of a map go on."""
        self._may_go_on.set()

    def close(self) -> None:
        """Refuse every sample from now on; what has arrived is still handed on."""
        with self._lock:
            self._is_closed = True

    def stop(self) -> None:
        """End when all that has arrived is handed on."""
        self.close()
        self.go_on()
        with self._lock:
            self._is_stopped = True
            self._queue.put_token(_Stop())

    def discard(self) -> None:
        """Throw away what waits to be decoded."""
        with self._lock:
            self._discarded += self._queue.discard()

    def counts(self) -> InputCounts:
        """Return what became of everything that arrived."""
        with self._lock:
            # Taken at first, and dropped once the next reading had shown the stamp to be wrong.
            jumped = self._window.refuted
            refused = self._refused + Counter({Defect.TIME_JUMPED: jumped})
            accepted = self._accepted - jumped
            return InputCounts(
                received=self._received,
                accepted=accepted,
                refused={str(k): count for k, count in refused.items()},
                queued=self._received - accepted - refused.total() - self._discarded,
                queued_bytes=self._queue.size_bytes,
                discarded=self._discarded,
                reordering=len(self._window),
                dropped_beams={str(k): count for k, count in self._dropped_beams.items()},
            )

    def _pump(self) -> None:
        while True:
            item = self._queue.get(self._limits.silence_s)
            for reading in self._released_by(item):
                self._submit(reading)
            if isinstance(item, Finish):
                self._may_go_on.clear()
                self._finish(item)
                if item.is_last:
                    self._may_go_on.wait()
            elif isinstance(item, _Stop):
                return

    def _released_by(self, item: _Sample | Finish | _Stop | None) -> tuple[Reading, ...]:
        match item:
            case _Sample():
                return self._take(item)
            case None:
                return self._window.flush()
            case _:
                return self._window.finish()

    def _take(self, sample: _Sample) -> tuple[Reading, ...]:
        decoded = self._decoder.decode(sample.name, sample.payload, sample.encoding)
        if not isinstance(decoded, Decoded):
            with self._lock:
                self._refused[decoded] += 1
            return ()
        released = self._window.push(decoded.reading)
        with self._lock:
            if released is None:
                self._refused[Defect.TIME_BACKWARDS] += 1
                return ()
            self._accepted += 1
            self._dropped_beams.update(decoded.dropped_beams)
            return released
