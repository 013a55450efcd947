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

from array import array
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from hmt_service.core.geometry import Pose
from hmt_service.core.ordering import ReorderWindow
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io import foxglove, ros_messages
from hmt_service.io.decoding import NANOSECONDS, Decoded, Defect, names_of_body
from hmt_service.io.malformed import Malformed, Tally
from hmt_service.io.ros_frames import StaticFrames
from hmt_service.io.ros_messages import SCAN_TYPES, TRANSFORMS, Frames, RosType, Serialization
from hmt_service.io.streams import Arrival, Mounting, Note, Says, Stream, Use

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

REORDER_S = 1.0
"""How much earlier than the latest stamp a reading may be: a slow driver's delay."""


class Topic(NamedTuple):
    """One stream of messages of one kind."""

    name: str
    """Any text."""
    schema: str
    """Full name of the messages."""
    encoding: str
    """How they are serialised, one of `ENCODINGS`."""


class Recorded(NamedTuple):
    """One message."""

    topic: Topic
    """What it is of."""
    payload: bytes
    """It, serialised."""
    time_ns: int
    """When it was recorded."""


class TopicFile(Protocol):
    """A file, or a folder of them, that holds messages."""

    @property
    def path(self) -> Path:
        """Where it is."""

    @property
    def form(self) -> str:
        """Name of its format."""

    def topics(self) -> Counter[Topic]:
        """Return how many messages every topic has.

        Raises:
            InvalidLog: If it cannot be opened.
        """

    def messages(self, topics: Collection[Topic], tally: Tally) -> Iterator[Recorded]:
        """Yield every message of these topics that can be read, about in the order of time.

        Args:
            topics: Which ones.
            tally: Counts what cannot be read.

        Raises:
            InvalidLog: If it cannot be opened.
        """

    def times(self) -> Iterator[tuple[Topic, int]]:
        """Yield topic and time of recording, ns, of every message, in any order.

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

    def __init__(
        self, file: TopicFile, scans: Topic, odometry: Topic | None, rules: _Rules
    ) -> None:
        self._file = file
        self._scans = scans
        self._topics = [topic for topic in (scans, odometry) if topic is not None]
        self._rules = rules
        self.malformed: tuple[Malformed, ...] = ()

    def arrivals(self, tally: Tally) -> Iterator[Arrival]:
        """Yield the readings as they stand in the file, and count what is none."""
        numbers: Counter[Topic] = Counter()
        for topic, payload, time_ns in self._file.messages(self._topics, tally):
            numbers[topic] += 1
            place = f"{topic.name}, message {numbers[topic]}"
            decoded = self._rules.decode(topic, payload)
            if isinstance(decoded, Defect):
                tally.add((topic.name, decoded), place, decoded)
            else:
                yield Arrival(topic.name, place, decoded.reading, time_ns / NANOSECONDS)

    def sample(self, *, every: int) -> Iterator[Scan]:
        """Yield the usable scans among every so many messages."""
        messages = self._file.messages([self._scans], Tally())
        for topic, payload, _ in islice(messages, None, None, every):
            decoded = self._rules.decode(topic, payload)
            if isinstance(decoded, Decoded) and isinstance(decoded.reading, Scan):
                yield decoded.reading

    def __iter__(self) -> Iterator[Reading]:
        """Yield the readings in the order of time; at equal stamps odometry comes first."""
        tally, window = Tally(), ReorderWindow(REORDER_S)
        for arrival in self.arrivals(tally):
            released = window.push(arrival.reading)
            if released is None:
                defect = Defect.TIME_BACKWARDS
                tally.add((arrival.stream, defect), arrival.place, defect)
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
    mounting: Mounting
    """Which frames are read, and who says where the sensor sits."""
    notes: tuple[Note, ...] = ()
    """Empty: nothing is assumed that `mounting` does not say."""
    reorder_s: float = REORDER_S
    """How much earlier than one before it a reading may be."""

    @property
    def malformed(self) -> tuple[Malformed, ...]:
        """What the last complete iteration has left out; nothing before the first."""
        return self.readings.malformed

    def arrivals(self, tally: Tally) -> Iterator[Arrival]:
        """Yield the readings as they stand in the file, and count what is none."""
        return self.readings.arrivals(tally)

    def sample(self, most: int) -> Iterator[Scan]:
        """Yield at most so many usable scans, evenly spread over the log."""
        return self.readings.sample(every=-(-self.scans // most))


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
    scan, odometry = _chosen(counts)
    any_frame = _Rules(min_range_m, max_range_m, Frames())
    frame = _first_frame(file, scan, any_frame)
    if scan is None or frame is None:
        raise _nothing_usable(file, scan, any_frame)
    if scan.encoding != PROTOBUF:
        frames, says = _ros_frames(file, counts, frame, odometry, any_frame, body_from_sensor)
    elif body_from_sensor is None:
        frames, says = Frames(body=names_of_body(frame)), Says.EVERY_SCAN
    else:
        raise InvalidInput(f"{file.path}: every {scan.schema} says where its sensor sits")
    return TopicLog(
        readings=_Readings(file, scan, odometry, _Rules(min_range_m, max_range_m, frames)),
        scans=counts[scan],
        odometry=counts[odometry] if odometry else 0,
        unread=tuple(
            f"{topic.name} ({count} messages)"
            for topic, count in sorted(counts.items())
            if topic.schema in _SCANS | _ODOMETRY and topic not in (scan, odometry)
        ),
        mounting=Mounting(frame, _first_frame(file, odometry, any_frame), says),
    )


def streams_of(file: TopicFile) -> tuple[Stream, ...]:
    """Return all topics of a file, by name, and what they are read for.

    Raises:
        InvalidLog: If it cannot be opened.
    """
    counts = file.topics()
    times_s: defaultdict[Topic, array[float]] = defaultdict(lambda: array("d"))
    for topic, time_ns in file.times():
        times_s[topic].append(time_ns / NANOSECONDS)
    known = Counter({topic: count for topic, count in counts.items() if _is_known(topic)})
    return tuple(
        Stream(
            topic.name,
            topic.schema,
            topic.encoding,
            *_use(topic, known),
            counts[topic],
            np.array(times_s[topic]),
        )
        for topic in sorted(counts)
    )


def _use(topic: Topic, counts: Counter[Topic]) -> tuple[Use, str]:
    """Return what one of these topics is read for, and why."""
    scan, odometry = _chosen(counts)
    if topic == scan:
        return Use.SCANS, _reason(topic, counts, _SCANS)
    if topic == odometry:
        return Use.ODOMETRY, _reason(topic, counts, _ODOMETRY)
    if not _is_known(topic):
        is_wanted = topic.schema in _SCANS | _ODOMETRY
        return Use.NOTHING, f"encoding {topic.encoding} is not read" if is_wanted else ""
    if scan is not None and topic.schema in _SCANS:
        return Use.NOTHING, f"no more messages than {scan.name}"
    if odometry is not None and topic.schema in _ODOMETRY:
        is_better = odometry.schema in _BEST_ODOMETRY and topic.schema not in _BEST_ODOMETRY
        reason = "is odometry" if is_better else "has no fewer messages"
        return Use.NOTHING, f"{odometry.name} {reason}"
    if _is_static(topic):
        return Use.FRAMES, "where the sensor may sit"
    return Use.NOTHING, ""


def _reason(topic: Topic, counts: Counter[Topic], schemas: Collection[str]) -> str:
    """Return why a topic was chosen among those of some schemas."""
    of_kind = [each for each in counts if each.schema in schemas]
    if len(of_kind) == 1:
        return "no other"
    has_most = all(counts[topic] >= counts[each] for each in of_kind)
    return "most messages" if has_most else "says which body it is of"


def _chosen(counts: Counter[Topic]) -> tuple[Topic | None, Topic | None]:
    """Return the topics of scans and odometry that are read."""
    odometry = _busiest(counts, _BEST_ODOMETRY) or _busiest(counts, _ODOMETRY)
    return _busiest(counts, _SCANS), odometry


def _is_static(topic: Topic) -> bool:
    return topic.schema == TRANSFORMS and topic.name.rpartition("/")[2] == _STATIC_FRAMES


def _is_known(topic: Topic) -> bool:
    """Return whether its messages are encoded as they are by who defined them."""
    is_foxglove = topic.schema.startswith("foxglove.")
    return topic.encoding in ENCODINGS and is_foxglove == (topic.encoding == PROTOBUF)


def _busiest(counts: Counter[Topic], schemas: Collection[str]) -> Topic | None:
    """Return the topic with most messages, of several the first by name."""
    topics = sorted(topic for topic in counts if topic.schema in schemas)
    return max(topics, key=lambda topic: counts[topic], default=None)


def _first_frame(file: TopicFile, topic: Topic | None, rules: _Rules) -> str | None:
    """Return the frame that the first usable message of a topic names; None if none does."""
    if topic is None:
        return None
    for _, payload, _ in file.messages([topic], Tally()):
        decoded = rules.decode(topic, payload)
        if isinstance(decoded, Decoded) and decoded.frame is not None:
            return decoded.frame
    return None


def _nothing_usable(file: TopicFile, scans: Topic | None, rules: _Rules) -> InvalidLog:
    """Return an error that says what was there instead of a scan."""
    tally, seen = Tally(), 0
    for topic, payload, _ in file.messages([] if scans is None else [scans], tally):
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
) -> tuple[Frames, Says]:
    """Return where the sensor of a ROS log sits on which body, and who says it."""
    if body_from_sensor is not None:
        return Frames({scan_frame}, None, body_from_sensor), Says.CALLER
    tree = StaticFrames()
    static = [topic for topic in counts if _is_static(topic)]
    for topic, payload, _ in file.messages(static, Tally()):
        tree.learn(payload, Serialization(topic.encoding))
    named = _first_frame(file, odometry, rules)
    for body in _BODIES if named is None else (named,):
        if (pose := tree.pose(body, scan_frame)) is not None:
            says = Says.SAME_FRAME if body == scan_frame else Says.STATIC_FRAMES
            return Frames({scan_frame}, names_of_body(body), pose), says
    return Frames({scan_frame}, names_of_body(scan_frame)), Says.NOBODY
