"""MCAP logs of foxglove messages, read and written as they stream: memory does not grow with them.

A log holds any topics; which are scans and odometry is known by their schemas (`foxglove`), and of
several the one with most messages is read, `foxglove.Odometry` before `foxglove.PoseInFrame`. The
first usable scan says what the body is called in this log. Odometry of another body is left out: no
message says where the sensor sits on that one.

References:
    https://mcap.dev/spec; foxglove schemas.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

from hmt_service.core.ordering import ReorderWindow
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.foxglove import (
    BODY_FRAMES,
    ODOMETRY_SCHEMAS,
    SCAN_SCHEMAS,
    Decoded,
    Defect,
    decode,
    encode,
)
from hmt_service.io.malformed import Malformed, Tally
from hmt_service.io.mcap_file import McapFile, Topic

SCAN_TOPIC, ODOMETRY_TOPIC = "/scan", "/odometry"
"""Topics that `McapWriter` writes."""

_REORDER_S = 1.0
"""How much earlier than the latest stamp a reading may be: a slow driver's delay."""


@dataclass(frozen=True, slots=True)
class _Limits:
    """Which points are returns."""

    min_range_m: float
    max_range_m: float


class _Readings(Iterable[Reading]):
    """The readings of a file; every iteration reads it again."""

    def __init__(
        self, file: McapFile, topics: Collection[Topic], limits: _Limits, bodies: Collection[str]
    ) -> None:
        self._file = file
        self._topics = topics
        self._limits = limits
        self._bodies = bodies
        self.malformed: tuple[Malformed, ...] = ()

    def __iter__(self) -> Iterator[Reading]:
        """Yield the readings in the order of time; at equal stamps odometry comes first."""
        tally, window = Tally(), ReorderWindow(_REORDER_S)
        numbers: Counter[Topic] = Counter()
        for topic, payload in self._file.messages(tally):
            if topic not in self._topics:
                continue
            numbers[topic] += 1
            decoded = _decode(topic, payload, self._limits, self._bodies)
            released = window.push(decoded.reading) if isinstance(decoded, Decoded) else None
            if released is None:
                defect = decoded if isinstance(decoded, Defect) else Defect.TIME_BACKWARDS
                place = f"{topic.name}, message {numbers[topic]}"
                tally.add((topic.name, defect), place, defect)
            else:
                yield from released
        yield from window.finish()
        for _ in range(window.refuted):
            tally.add(("stamps", Defect.TIME_JUMPED), "stamps", Defect.TIME_JUMPED)
        self.malformed = tally.result()


@dataclass(frozen=True, slots=True, eq=False)
class McapLog:
    """What an MCAP log holds, without holding it."""

    readings: _Readings
    """In the order of time; at equal stamps odometry comes before the scan."""
    scans: int
    """Number of messages that should be scans."""
    odometry: int
    """Number of messages that should be odometry."""
    unread: tuple[str, ...]
    """Other topics of scans or odometry, with the number of their messages."""

    @property
    def malformed(self) -> tuple[Malformed, ...]:
        """What the last complete iteration has left out; nothing before the first."""
        return self.readings.malformed


def read_mcap(path: Path, *, min_range_m: float, max_range_m: float) -> McapLog:
    """Open an MCAP log, and read as far as its first usable scan.

    Args:
        path: The log.
        min_range_m: Returns nearer than this are left out of the scans.
        max_range_m: Returns farther than this are left out of the scans.

    Raises:
        InvalidLog: If the file cannot be opened or holds no usable scan.
    """
    file, limits = McapFile(path), _Limits(min_range_m, max_range_m)
    counts = file.topics()
    scan = _busiest(counts, SCAN_SCHEMAS)
    odometry = _busiest(counts, {"foxglove.Odometry"}) or _busiest(counts, ODOMETRY_SCHEMAS)
    topics = [topic for topic in (scan, odometry) if topic is not None]
    body = _name_of_body(file, scan, limits)
    return McapLog(
        readings=_Readings(file, topics, limits, BODY_FRAMES if body in BODY_FRAMES else {body}),
        scans=counts[scan] if scan else 0,
        odometry=counts[odometry] if odometry else 0,
        unread=tuple(
            f"{topic.name} ({count} messages)"
            for topic, count in sorted(counts.items())
            if topic.schema in SCAN_SCHEMAS | ODOMETRY_SCHEMAS and topic not in topics
        ),
    )


def _busiest(counts: Counter[Topic], schemas: Collection[str]) -> Topic | None:
    """Return the topic with most messages, of several the first by name."""
    topics = sorted(topic for topic in counts if topic.schema in schemas)
    return max(topics, key=lambda topic: counts[topic], default=None)


def _name_of_body(file: McapFile, scans: Topic | None, limits: _Limits) -> str:
    """Return what the first usable scan calls the body.

    Raises:
        InvalidLog: If there is none.
    """
    tally, seen = Tally(), 0
    for topic, payload in file.messages(tally):
        if topic != scans:
            continue
        seen += 1
        decoded = _decode(topic, payload, limits, None)
        if isinstance(decoded, Decoded) and decoded.body_frame is not None:
            return decoded.body_frame
        tally.add((topic.name, str(decoded)), f"{topic.name}, message {seen}", str(decoded))
    causes = "".join(f"; {m.place}: {m.reason}" for m in tally.result()[:1])
    wanted = " or ".join(sorted(SCAN_SCHEMAS))
    raise InvalidLog(f"{file.path}: no usable scan in {seen} messages of {wanted}{causes}")


def _decode(
    topic: Topic, payload: bytes, limits: _Limits, bodies: Collection[str] | None
) -> Decoded | Defect:
    return decode(
        topic.schema,
        payload,
        min_range_m=limits.min_range_m,
        max_range_m=limits.max_range_m,
        body_frames=bodies,
    )


class McapWriter:
    """Writes readings to an MCAP log that `read_mcap` and the viewers of this format read.

    Scans become `foxglove.PointCloud` of float32 relative to the sensor: coordinates come back
    within 6e-8 of themselves, 1e-6 m at 16 m. Stamps come back exactly to the ns. The same
    readings give the same bytes.
    """

    def __init__(self, file: BinaryIO) -> None:
        """Begin a log in an empty file; it stays the caller's."""
        # LZ4: noise hardly compresses. Measured on scans of 65,536 points (1 MB), 3.4 ms each and
        # 0.85 of the size; zstd as this library calls it 10.3 ms and 0.72. Larger chunks gain
        # nothing.
        self._writer = Writer(file, compression=CompressionType.LZ4)

    def write(self, reading: Reading) -> None:
        """Append a reading.

        Raises:
            InvalidInput: If its stamp is not finite, or before 0.
        """
        message = encode(reading, np.float32)
        stamp_ns = message.timestamp.ToNanoseconds()
        if stamp_ns < 0:
            raise InvalidInput(f"stamp {reading.stamp_s} s is before 0, where time begins in MCAP")
        topic = SCAN_TOPIC if isinstance(reading, Scan) else ODOMETRY_TOPIC
        self._writer.write_message(topic, message, log_time=stamp_ns, publish_time=stamp_ns)

    def finish(self) -> None:
        """Write what is left, and the index."""
        self._writer.finish()
