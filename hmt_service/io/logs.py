"""One way to read a recorded log, whatever its format.

References: own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from hmt_service.core.geometry import Pose
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.carmen import carmen_streams, read_carmen
from hmt_service.io.malformed import Malformed, Tally
from hmt_service.io.mcap_file import McapFile
from hmt_service.io.ros_bag import RosBag
from hmt_service.io.scan_files import SUFFIXES
from hmt_service.io.scan_folder import ScanFolder, is_scan_folder
from hmt_service.io.streams import Arrival, Mounting, Note, Stream
from hmt_service.io.topic_log import TopicFile, read_topics, streams_of


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

    @property
    def notes(self) -> tuple[Note, ...]:
        """What is assumed because the log does not say it."""

    @property
    def mounting(self) -> Mounting:
        """Which frames are read, and who says where the sensor sits."""

    @property
    def reorder_s(self) -> float:
        """How much earlier than one before it a reading may be, s, and still be read."""

    def arrivals(self, tally: Tally) -> Iterator[Arrival]:
        """Yield the readings as they stand in the log, and count what is none."""

    def sample(self, most: int) -> Iterator[Scan]:
        """Yield at most so many usable scans, evenly spread over the log."""


class Source(Protocol):
    """A log whose format is known, not yet read."""

    @property
    def form(self) -> str:
        """Name of the format."""

    def streams(self) -> tuple[Stream, ...]:
        """Return everything that it holds, by name.

        Raises:
            InvalidLog: If it cannot be opened.
        """

    def read(
        self, *, min_range_m: float, max_range_m: float, body_from_sensor: Pose | None = None
    ) -> Log:
        """Open it for reading, as `read_log` does."""


@dataclass(frozen=True, slots=True)
class _Carmen:
    path: Path
    form: str = "CARMEN"

    def streams(self) -> tuple[Stream, ...]:
        return carmen_streams(self.path)

    def read(
        self, *, min_range_m: float, max_range_m: float, body_from_sensor: Pose | None = None
    ) -> Log:
        if body_from_sensor is not None:
            raise InvalidInput(f"{self.path}: CARMEN logs say where the laser sits")
        return read_carmen(self.path, min_range_m=min_range_m, max_range_m=max_range_m)


@dataclass(frozen=True, slots=True)
class _OfTopics:
    file: TopicFile

    @property
    def form(self) -> str:
        return self.file.form

    def streams(self) -> tuple[Stream, ...]:
        return streams_of(self.file)

    def read(
        self, *, min_range_m: float, max_range_m: float, body_from_sensor: Pose | None = None
    ) -> Log:
        return read_topics(
            self.file,
            min_range_m=min_range_m,
            max_range_m=max_range_m,
            body_from_sensor=body_from_sensor,
        )


_COMPRESSIONS = {".gz", ".bz2"}
_CARMEN = (".clf", ".log")
_OF_TOPICS: dict[str, Callable[[Path], TopicFile]] = {
    ".mcap": McapFile,
    ".bag": RosBag,
    ".db3": RosBag,
}
_BAG_DESCRIPTION = "metadata.yaml"


def open_log(path: Path, *, scan_rate_hz: float | None = None) -> Source:
    """Find out the format of a log: that of its name, `.gz` and `.bz2` may follow.

    Args:
        path: The log; a folder is a bag of ROS 2, or holds scans.
        scan_rate_hz: Scans per second of a folder of scans without stamps; None for 10.

    Raises:
        InvalidLog: If the format is unknown, or a folder of scans is none.
        InvalidInput: If a rate is given, and the log says its stamps.
    """
    is_bag = (path / _BAG_DESCRIPTION).is_file()
    if path.is_dir() and not is_bag and is_scan_folder(path):
        return ScanFolder(path, scan_rate_hz=scan_rate_hz)
    if scan_rate_hz is not None:
        raise InvalidInput(f"{path} is no folder of scans: leave out --scan-rate")
    if path.is_dir():
        if not is_bag:
            raise _no_log_in(path)
        return _OfTopics(RosBag(path))
    suffixes = [s for s in map(str.lower, path.suffixes) if s not in _COMPRESSIONS]
    suffix = suffixes[-1] if suffixes else ""
    if suffix in _CARMEN:
        return _Carmen(path)
    if suffix in SUFFIXES:
        raise InvalidLog(f"{path} is one scan, which makes no map: name the folder of all of them")
    if suffix not in _OF_TOPICS:
        known = ", ".join([*_CARMEN, *_OF_TOPICS])
        raise InvalidLog(
            f"{path}: unknown format '{suffix}'; readers exist for {known}, folders of ROS 2, and "
            f"folders of scans ({', '.join(sorted(SUFFIXES))})"
        )
    return _OfTopics(_OF_TOPICS[suffix](path))


def read_log(
    path: Path,
    *,
    min_range_m: float,
    max_range_m: float,
    body_from_sensor: Pose | None = None,
    scan_rate_hz: float | None = None,
) -> Log:
    """Read a recorded log, whatever its format.

    Args:
        path: The log, see `open_log`.
        min_range_m: Returns nearer than this are left out of the scans.
        max_range_m: Returns farther than this are left out of the scans.
        body_from_sensor: Pose of the sensor on the body, shape (4, 4), for logs of ROS and folders
            of scans; None for what the log says.
        scan_rate_hz: Scans per second of a folder of scans without stamps; None for 10.

    Raises:
        InvalidLog: If the format is unknown, the log cannot be opened or holds no usable scan.
        InvalidInput: If a pose or a rate is given, and the log has its own.
    """
    return open_log(path, scan_rate_hz=scan_rate_hz).read(
        min_range_m=min_range_m, max_range_m=max_range_m, body_from_sensor=body_from_sensor
    )


def _no_log_in(folder: Path) -> InvalidLog:
    """Return an error that says what a folder would need, and which file of it may be meant."""
    ends = (*_CARMEN, *_OF_TOPICS)
    logs = [p.name for p in sorted(folder.iterdir()) if p.suffix.lower() in ends]
    advice = f"; name the log itself, such as {folder / logs[0]}" if logs else ""
    return InvalidLog(
        f"{folder} holds neither {_BAG_DESCRIPTION} of a ROS 2 bag nor scans "
        f"({', '.join(sorted(SUFFIXES))}){advice}"
    )
