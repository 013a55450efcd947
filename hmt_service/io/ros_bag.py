"""Bags of ROS: files of ROS 1, folders and files of ROS 2, as far as they can be read.

A bag that has no index, as a crash leaves it, is refused with what its own tools say of it.

References:
    https://wiki.ros.org/Bags/Format/2.0; https://github.com/ros2/rosbag2.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rosbags import rosbag1, rosbag2

from hmt_service.errors import InvalidLog
from hmt_service.io.malformed import Tally
from hmt_service.io.ros_messages import Serialization, type_name
from hmt_service.io.topic_log import Recorded, Topic

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


class RosBag:
    """One bag, opened anew by every method."""

    def __init__(self, path: Path) -> None:
        """Remember where the bag is."""
        self.path = path
        self._is_ros1 = path.suffix.lower() == ".bag" and not path.is_dir()
        self.form = f"bag of ROS {1 if self._is_ros1 else 2}"

    def topics(self) -> Counter[Topic]:
        """Return how many messages every topic has.

        Raises:
            InvalidLog: If the bag cannot be opened.
        """
        counts: Counter[Topic] = Counter()
        with self._open() as reader:
            for connection in reader.connections:
                counts[self._topic(connection)] += connection.msgcount
        return counts

    def messages(self, topics: Collection[Topic], tally: Tally) -> Iterator[Recorded]:
        """Yield every message of these topics, up to where the bag is damaged.

        Raises:
            InvalidLog: If the bag cannot be opened.
        """
        return self._messages(frozenset(topics), tally)

    def times(self) -> Iterator[tuple[Topic, int]]:
        """Yield topic and time of recording of every message.

        Raises:
            InvalidLog: If the bag cannot be opened.
        """
        for topic, _, time_ns in self._messages(None, Tally()):
            yield topic, time_ns

    def _messages(self, topics: Collection[Topic] | None, tally: Tally) -> Iterator[Recorded]:
        with self._open() as reader:
            wanted = [c for c in reader.connections if topics is None or self._topic(c) in topics]
            # To the library none would be all.
            if not wanted:
                return
            messages = reader.messages(connections=wanted)
            while True:
                try:
                    message = next(messages, None)
                # Damage makes the library raise what its decompressors and its SQLite raise.
                except Exception as error:  # noqa: BLE001 - counted, not hidden
                    cause = f"{type(error).__name__} {error}".strip()
                    what = "the bag cannot be read from here on"
                    tally.add((what, cause), str(self.path), f"{what}: {cause}")
                    return
                if message is None:
                    return
                connection, time_ns, payload = message
                yield Recorded(self._topic(connection), payload, time_ns)

    def _topic(self, connection: Connection) -> Topic:
        encoding = Serialization.ROS1 if self._is_ros1 else Serialization.CDR
        return Topic(connection.topic, type_name(connection.msgtype), encoding)

    @contextmanager
    def _open(self) -> Iterator[rosbag1.Reader | rosbag2.Reader]:
        try:
            reader = (rosbag1 if self._is_ros1 else rosbag2).Reader(self.path)
            reader.open()
        except Exception as error:
            raise InvalidLog(f"cannot read {self.path}: {error}") from error
        try:
            yield reader
        finally:
            reader.close()
