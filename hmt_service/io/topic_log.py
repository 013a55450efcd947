"""Logs of many topics, read as they stream: memory does not grow with them.

Which topics are scans and odometry is known by their schemas, and of several the one with most
messages is read, `foxglove.PoseInFrame` only where there is no other odometry. The first usable
scan names its frame, and scans in others are left out.

Where the sensor sits on the body is in the scans themselves (foxglove), or in `tf_static`, or the
caller says it (ROS). Without it the frame of the scans is the body's, and odometry of another body
is left out: nobody can say how that moves the sensor.

References:
    own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

from hmt_service.core.geometry import Pose
from hmt_service.core.ordering import ReorderWindow
from hmt_service.core.types import Reading
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io import foxglove, ros_messages
from hmt_service.io.decoding import Decoded, Defect, names_of_body
from hmt_service.io.malformed import Malformed, Tally
from hmt_service.io.ros_frames import StaticFrames
from hmt_service.io.ros_messages import SCAN_TYPES, TRANSFORMS, Frames, RosType, Serialization

PROTOBUF = "protobuf"
"""Encoding of the messages of foxglove; those of ROS are `Serialization`."""
ENCODINGS = frozenset({PROTOBUF, *Serialization})
"""Encodings that can be read."""
_SCANS = foxglove.SCAN_SCHEMAS | SCAN_TYPES
_BEST_ODOMETRY = frozenset({"foxglove.Odometry", RosType.ODOMETRY})
_ODOMETRY = foxglove.ODOMETRY_SCHEMAS | _BEST_ODOMETRY
_BODIES = ("base_link", "base_footprint")
"""Bodies to look for where no odometry names one."""
_STATIC_FRAMES = "tf_static"

_REORDER_S = 1.0
"""How much earlier than the latest stamp a reading may be: a slow driver's delay."""


class Topic(NamedTuple):
    """One stream of messages of one kind."""

    name: str
    """Any text."""
    schema: str
    """Full name of the messages."""
    encoding: str
    """How they are serialised, one of `ENCODINGS`."""


class TopicFile(Protocol):
    """A file, or a folder of them, that holds messages."""

    @property
    def path(self) -> Path:
        """Where it is."""

    def topics(self) -> Counter[Topic]:
        """Return how many messages every topic has.

        Raises:
            InvalidLog: If it cannot be opened.
        """

    def messages(self, topics: Collection[Topic], tally: Tally) -> Iterator[tuple[Topic, bytes]]:
        """Yield every message of these topics that can be read, about in the order of time.

        Args:
            topics: Which ones.
            tally: Counts what cannot be read.

        Raises:
            InvalidLog: If it cannot be opened.
        """


@dataclass(frozen=True, slots=True)
class _Rules:
    """What messages are held to."""

    min_range_m: float
    max_range_m: float
    frames: Frames

    def decode(self, topic: Topic, payload: bytes) -> Decoded | Defect:
        if topic.encoding == PROTOBUF:
            return foxglove.decode(
                topic.schema,
                payload,
                min_range_m=self.min_range_m,
                max_range_m=self.max_range_m,
                body_frames=self.frames.body,
            )
        return ros_messages.decode(
            RosType(topic.schema),
            payload,
            Serialization(topic.encoding),
            min_range_m=self.min_range_m,
            max_range_m=self.max_range_m,
            frames=self.frames,
        )


class _Readings(Iterable[Reading]):
    """The readings of a file; every iteration reads it again."""

    def __init__(self, file: TopicFile, topics: Collection[Topic], rules: _Rules) -> None:
        self._file = file
        self._topics = topics
        self._rules = rules
        self.malformed: tuple[Malformed, ...] = ()

    def __iter__(self) -> Iterator[Reading]:
        """Yield the readings in the order of time; at equal stamps odometry comes first."""
        tally, window = Tally(), ReorderWindow(_REORDER_S)
        numbers: Counter[Topic] = Counter()
        for topic, payload in self._file.messages(self._topics, tally):
            numbers[topic] += 1
            decoded = self._rules.decode(topic, payload)
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
class TopicLog:
    """What a log of many topics holds, without holding it."""

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


def read_topics(
    file: TopicFile,
    *,
    min_range_m: float,
    max_range_m: float,
    body_from_sensor: Pose | None = None,
) -> TopicLog:
    """Open a log, and read as far as its first usable scan.

    Args:
        file: The log.
        min_range_m: Returns nearer than this are left out of the scans.
        max_range_m: Returns farther than this are left out of the scans.
        body_from_sensor: Pose of the sensor on the body, shape (4, 4); None for what the log says.

    Raises:
        InvalidLog: If the log cannot be opened or holds no usable scan.
        InvalidInput: If a pose is given, and the scans have one of their own.
    """
    counts = Counter({t: count for t, count in file.topics().items() if _is_known(t)})
    scan = _busiest(counts, _SCANS)
    odometry = _busiest(counts, _BEST_ODOMETRY) or _busiest(counts, _ODOMETRY)
    any_frame = _Rules(min_range_m, max_range_m, Frames())
    frame = _first_frame(file, scan, any_frame)
    if scan is None or frame is None:
        raise _nothing_usable(file, scan, any_frame)
    if scan.encoding != PROTOBUF:
        frames = _ros_frames(file, counts, frame, odometry, any_frame, body_from_sensor)
    elif body_from_sensor is None:
        frames = Frames(body=names_of_body(frame))
    else:
        raise InvalidInput(f"{file.path}: every {scan.schema} says where its sensor sits")
    topics = [topic for topic in (scan, odometry) if topic is not None]
    return TopicLog(
        readings=_Readings(file, topics, _Rules(min_range_m, max_range_m, frames)),
        scans=counts[scan],
        odometry=counts[odometry] if odometry else 0,
        unread=tuple(
            f"{topic.name} ({count} messages)"
            for topic, count in sorted(counts.items())
            if topic.schema in _SCANS | _ODOMETRY and topic not in topics
        ),
    )


def _is_known(topic: Topic) -> bool:
    """Return whether its messages are encoded as they are by who defined them."""
    return topic.schema.startswith("foxglove.") == (topic.encoding == PROTOBUF)


def _busiest(counts: Counter[Topic], schemas: Collection[str]) -> Topic | None:
    """Return the topic with most messages, of several the first by name."""
    topics = sorted(topic for topic in counts if topic.schema in schemas)
    return max(topics, key=lambda topic: counts[topic], default=None)


def _first_frame(file: TopicFile, topic: Topic | None, rules: _Rules) -> str | None:
    """Return the frame that the first usable message of a topic names; None if none does."""
    if topic is None:
        return None
    for _, payload in file.messages([topic], Tally()):
        decoded = rules.decode(topic, payload)
        if isinstance(decoded, Decoded) and decoded.frame is not None:
            return decoded.frame
    return None


def _nothing_usable(file: TopicFile, scans: Topic | None, rules: _Rules) -> InvalidLog:
    """Return an error that says what was there instead of a scan."""
    tally, seen = Tally(), 0
    for topic, payload in file.messages([] if scans is None else [scans], tally):
        seen += 1
        reason = str(rules.decode(topic, payload))
        tally.add((topic.name, reason), f"{topic.name}, message {seen}", reason)
    causes = "".join(f"; {m.place}: {m.reason}" for m in tally.result()[:1])
    wanted = " or ".join(sorted(_SCANS))
    return InvalidLog(f"{file.path}: no usable scan in {seen} messages of {wanted}{causes}")


def _ros_frames(
    file: TopicFile,
    counts: Counter[Topic],
    scan_frame: str,
    odometry: Topic | None,
    rules: _Rules,
    body_from_sensor: Pose | None,
) -> Frames:
    """Return where the sensor of a ROS log sits on which body."""
    if body_from_sensor is not None:
        return Frames({scan_frame}, None, body_from_sensor)
    static = [
        topic
        for topic in counts
        if topic.schema == TRANSFORMS and topic.name.rpartition("/")[2] == _STATIC_FRAMES
    ]
    tree = StaticFrames()
    for topic, payload in file.messages(static, Tally()):
        tree.learn(payload, Serialization(topic.encoding))
    named = _first_frame(file, odometry, rules)
    for body in _BODIES if named is None else (named,):
        if (pose := tree.pose(body, scan_frame)) is not None:
            return Frames({scan_frame}, names_of_body(body), pose)
    return Frames({scan_frame}, names_of_body(scan_frame))
