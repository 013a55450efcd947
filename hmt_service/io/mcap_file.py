"""MCAP files: the messages of foxglove and ROS in them, by time, as far as they can be read.

A file without an index, as a crash leaves it, is read from its beginning; a damaged chunk costs
what is in it.

References:
    https://mcap.dev/spec.
"""

from __future__ import annotations

import heapq
import struct
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary

from hmt_service.errors import InvalidLog
from hmt_service.io.malformed import Tally
from hmt_service.io.ros_messages import type_name
from hmt_service.io.topic_log import Recorded, Topic

_OPCODE_AND_LENGTH_BYTES = 9
# What the library and its decompressors raise on bytes that are no MCAP.
_DAMAGE = (
    McapError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
    struct.error,
    zstandard.ZstdError,
)


class McapFile:
    """One MCAP file, opened anew by every method."""

    form = "MCAP"
    """Name of the format."""

    def __init__(self, path: Path) -> None:
        """Remember where the file is."""
        self.path = path

    def topics(self) -> Counter[Topic]:
        """Return how many messages every topic has.

        Raises:
            InvalidLog: If the file cannot be opened.
        """
        with self._open() as file:
            summary = _summary(file)
        if summary is None or summary.statistics is None:
            return Counter(message.topic for message in self._messages(None, Tally()))
        table = _Table(summary)
        counts: Counter[Topic] = Counter()
        for channel, count in summary.statistics.channel_message_counts.items():
            if (topic := table.topic(channel)) is not None:
                counts[topic] += count
        return counts

    def messages(self, topics: Collection[Topic], tally: Tally) -> Iterator[Recorded]:
        """Yield every message of these topics that can be read.

        Raises:
            InvalidLog: If the file cannot be opened.
        """
        return self._messages(frozenset(topics), tally)

    def times(self) -> Iterator[tuple[Topic, int]]:
        """Yield topic and time of recording of every message, from the indexes where there are any.

        Raises:
            InvalidLog: If the file cannot be opened.
        """
        with self._open() as file:
            summary = _summary(file)
            chunks = summary.chunk_indexes if summary else []
            if summary is None or not (chunks and all(c.message_index_offsets for c in chunks)):
                yield from ((topic, time_ns) for topic, _, time_ns in self._messages(None, Tally()))
                return
            table = _Table(summary)
            for channel, time_ns in _indexed(file, chunks):
                if (topic := table.topic(channel)) is not None:
                    yield topic, time_ns

    def _messages(self, topics: Collection[Topic] | None, tally: Tally) -> Iterator[Recorded]:
        with self._open() as file:
            summary = _summary(file)
            table = _Table(summary)
            records = (
                _by_time(file, _chunks_with(topics, summary, table), tally)
                if summary is not None and summary.chunk_indexes
                else _as_written(file, self.path.stat().st_size, tally)
            )
            for record in records:
                if not isinstance(record, Message):
                    table.learn(record)
                    continue
                topic = table.topic(record.channel_id)
                if topic is not None and (topics is None or topic in topics):
                    yield Recorded(topic, record.data, record.log_time)

    def _open(self) -> BinaryIO:
        try:
            return self.path.open("rb")
        except OSError as error:
            raise InvalidLog(f"cannot read {self.path}: {error.strerror}") from error


class _Table:
    """Which topic a channel belongs to."""

    def __init__(self, summary: Summary | None) -> None:
        self._schemas: dict[int, Schema] = dict(summary.schemas) if summary else {}
        self._channels: dict[int, Channel] = dict(summary.channels) if summary else {}

    def learn(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record

    def topic(self, channel_id: int) -> Topic | None:
        """Return the topic of a channel, None when it or its schema is unknown."""
        channel = self._channels.get(channel_id)
        schema = self._schemas.get(channel.schema_id) if channel else None
        if channel is None or (schema is None and channel.schema_id):
            return None
        # Number 0 is no schema.
        kind = type_name(schema.name) if schema else ""
        return Topic(channel.topic, kind, channel.message_encoding)


def _summary(file: BinaryIO) -> Summary | None:
    """Return what the end of the file says of the rest; None when it says nothing."""
    try:
        return SeekingReader(file).get_summary()
    except _DAMAGE:
        return None


def _chunks_with(
    topics: Collection[Topic] | None, summary: Summary, table: _Table
) -> Iterable[ChunkIndex]:
    """Return the chunks that may hold messages of these topics; None for any."""
    if topics is None:
        return summary.chunk_indexes
    # A channel that the summary does not know may be one of them.
    others = {c for c in summary.channels if table.topic(c) not in topics}
    return [
        chunk
        for chunk in summary.chunk_indexes
        # A file need not say what is in its chunks.
        if not chunk.message_index_offsets or not chunk.message_index_offsets.keys() <= others
    ]


def _indexed(file: BinaryIO, chunks: Iterable[ChunkIndex]) -> Iterator[tuple[int, int]]:
    """Yield channel and log time of what the message indexes tell, up to where one is damaged."""
    for chunk in chunks:
        for offset in chunk.message_index_offsets.values():
            try:
                file.seek(offset + _OPCODE_AND_LENGTH_BYTES)
                index = MessageIndex.read(ReadDataStream(file))
            except _DAMAGE:
                break
            yield from ((index.channel_id, time_ns) for time_ns, _ in index.records)


def _by_time(file: BinaryIO, chunks: Iterable[ChunkIndex], tally: Tally) -> Iterator[McapRecord]:
    """Yield what indexed chunks hold, messages by log time; a chunk is read when its time comes."""
    waiting: list[tuple[int, int, int, Message]] = []
    for index in sorted(chunks, key=lambda c: (c.message_start_time, c.chunk_start_offset)):
        while waiting and waiting[0][0] < index.message_start_time:
            yield heapq.heappop(waiting)[-1]
        start = index.chunk_start_offset
        try:
            file.seek(start + _OPCODE_AND_LENGTH_BYTES)
            records = breakup_chunk(Chunk.read(ReadDataStream(file)), validate_crc=True)
        except _DAMAGE as error:
            _count(tally, f"chunk at byte {start}", "damaged", error)
            continue
        for number, record in enumerate(records):
            if isinstance(record, Message):
                heapq.heappush(waiting, (record.log_time, start, number, record))
            else:
                yield record
    while waiting:
        yield heapq.heappop(waiting)[-1]


def _as_written(file: BinaryIO, size: int, tally: Tally) -> Iterator[McapRecord]:
    """Yield what a file holds in its own order, up to where it cannot be read."""
    file.seek(0)
    records = StreamReader(file, emit_chunks=True, record_size_limit=size).records
    while True:
        start = file.tell()
        try:
            record = next(records, None)
        except _DAMAGE as error:
            _count(tally, f"byte {start}", "the file ends or cannot be read from here on", error)
            return
        if record is None:
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inside = breakup_chunk(record, validate_crc=True)
        except _DAMAGE as error:
            _count(tally, f"chunk at byte {start}", "damaged", error)
            continue
        yield from inside


def _count(tally: Tally, place: str, what: str, error: Exception) -> None:
    # Some have no message.
    cause = str(error) or type(error).__name__
    tally.add((what, type(error).__name__), place, f"{what}: {cause}")
