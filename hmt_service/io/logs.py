"""One way to read a recorded log, whatever its format.

References: own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

from hmt_service.core.geometry import Pose
from hmt_service.core.types import Reading
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.carmen import read_carmen
from hmt_service.io.malformed import Malformed
from hmt_service.io.mcap_file import McapFile
from hmt_service.io.ros_bag import RosBag
from hmt_service.io.topic_log import TopicFile, read_topics


class Log(Protocol):
    """What every reader returns at least."""

    @property
    def readings(self) -> Iterable[Reading]:
        """Scans and odometry in the order of time; may be iterated again and again."""

    @property
    def scans(self) -> int:
        """Number of scans among them, with those that will turn out to be malformed."""

    @property
    def odometry(self) -> int:
        """Number of odometry readings among them, in the same way."""

    @property
    def malformed(self) -> tuple[Malformed, ...]:
        """What was left out, and why; complete after an iteration over the readings."""

    @property
    def unread(self) -> tuple[str, ...]:
        """What else in the log could have been read."""


_COMPRESSIONS = {".gz", ".bz2"}
_CARMEN = (".clf", ".log")
_OF_TOPICS: dict[str, Callable[[Path], TopicFile]] = {
    ".mcap": McapFile,
    ".bag": RosBag,
    ".db3": RosBag,
}


def read_log(
    path: Path,
    *,
    min_range_m: float,
    max_range_m: float,
    body_from_sensor: Pose | None = None,
) -> Log:
    """Read a recorded log, in the format that its name says; `.gz` and `.bz2` may follow.

    Args:
        path: The log; a folder is a bag of ROS 2.
        min_range_m: Returns nearer than this are left out of the scans.
        max_range_m: Returns farther than this are left out of the scans.
        body_from_sensor: Pose of the sensor on the body, shape (4, 4), for logs of ROS; None for
            what the log says.

    Raises:
        InvalidLog: If the format is unknown, the file cannot be opened or holds no usable scan.
        InvalidInput: If a pose is given, and the log is none of ROS.
    """
    suffixes = [s for s in map(str.lower, path.suffixes) if s not in _COMPRESSIONS]
    suffix = suffixes[-1] if suffixes else ""
    if suffix in _CARMEN and not path.is_dir():
        if body_from_sensor is not None:
            raise InvalidInput(f"{path}: CARMEN logs say where the laser sits")
        return read_carmen(path, min_range_m=min_range_m, max_range_m=max_range_m)
    opener = RosBag if path.is_dir() else _OF_TOPICS.get(suffix)
    if opener is None:
        known = ", ".join([*_CARMEN, *_OF_TOPICS])
        raise InvalidLog(
            f"{path}: unknown format '{suffix}'; readers exist for {known} and folders of ROS 2"
        )
    return read_topics(
        opener(path),
        min_range_m=min_range_m,
        max_range_m=max_range_m,
        body_from_sensor=body_from_sensor,
    )
