"""Reader for CARMEN logs: planar laser scans and wheel odometry, one message per line.

    FLASER n r1..rn LASER ROBOT TIME
    ROBOTLASER1 CONFIG n r1..rn m e1..em LASER ROBOT tv rv forward side turn TIME
    RAWLASER1 CONFIG n r1..rn m e1..em TIME
    ODOM ROBOT tv rv acceleration TIME

LASER and ROBOT are poses `x y theta` in the odometry's frame, CONFIG is `type start_angle
field_of_view resolution max_range accuracy remission_mode`, e are remissions and TIME is `ipc_time
host logger_time`. The stamp is the ipc time. Raw scans count only in a log without other scans;
other messages are left out.

References:
    Montemerlo, Roy and Thrun, CARMEN robot navigation toolkit (log format of `logger`).
"""

from __future__ import annotations

import bz2
import gzip
import math
import re
import zlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice, pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np

from hmt_service.core.geometry import (
    FloatArray,
    Pose,
    identity,
    inverse,
    planar_pose,
    transform_points,
)
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidLog
from hmt_service.io.malformed import Malformed, Tally
from hmt_service.io.streams import IN_EVERY_SCAN, Arrival, Mounting, Note, Stream, Use

_WORDS_IN_CONFIG = 7
_WORDS_IN_TIME = 3
_WORDS_BETWEEN_POSES_AND_TIME = 5
_RAW_SCAN = b"RAWLASER1"
_KINDS = {
    b"FLASER": "scan, pose",
    b"ODOM": "pose",
    b"RAWLASER1": "scan",
    b"ROBOTLASER1": "scan, pose",
}
_TAG = re.compile(rb"[A-Z][A-Z0-9_]*")
_GZIP_MAGIC = b"\x1f\x8b"
_BZIP2_MAGIC = b"BZh"


@dataclass(frozen=True, slots=True, eq=False)
class CarmenLog:
    """What a CARMEN log holds."""

    readings: tuple[Reading, ...]
    """In the order of time; at equal stamps odometry comes before the scan."""
    scans: int
    """Number of scans among them."""
    odometry: int
    """Number of odometry readings among them, those that come with a scan included."""
    out_of_order: int
    """Number of scans that are older than the scan before them in the file."""
    malformed: tuple[Malformed, ...]
    """Lines that were left out, in the order of the file."""
    written: tuple[Arrival, ...]
    """The readings in the order of the file."""
    unread: tuple[str, ...] = ()
    """Empty: all readings are read."""
    notes: tuple[Note, ...] = ()
    """Empty: nothing is assumed."""
    reorder_s: float = math.inf
    """All readings are sorted."""
    mounting: Mounting = IN_EVERY_SCAN
    """Which frames there are: the format names none."""

    def arrivals(self, tally: Tally) -> Iterator[Arrival]:
        """Yield the readings in the order of the file, and count the lines that hold none."""
        for line in self.malformed:
            tally.add(("line", line.reason), line.place, line.reason)
        yield from self.written

    def sample(self, most: int) -> Iterator[Scan]:
        """Yield at most so many scans, evenly spread over the log."""
        scans = (reading for reading in self.readings if isinstance(reading, Scan))
        return islice(scans, None, None, -(-self.scans // most))


@dataclass(frozen=True, slots=True)
class _Limits:
    """Which ranges are returns."""

    min_range_m: float
    max_range_m: float


class _Malformed(Exception):
    """Reason why one line cannot be used."""


def read_carmen(path: Path, *, min_range_m: float, max_range_m: float) -> CarmenLog:
    """Read a CARMEN log: plain, gzip or bzip2, whatever its name.

    A line that cannot be used, or a compressed file that ends too early, costs the readings on
    it, never those around it.

    Args:
        path: The log.
        min_range_m: Returns nearer than this are left out of the scans.
        max_range_m: Returns farther than this are left out of the scans.

    Raises:
        InvalidLog: If the file cannot be opened or holds no usable scan.
    """
    limits = _Limits(min_range_m, max_range_m)
    written: list[Arrival] = []
    raw_scans: list[Arrival] = []
    malformed: list[Malformed] = []
    number = 0
    try:
        with _open(path) as file:
            for number, line in enumerate(_whole_lines(file), 1):
                try:
                    target = raw_scans if line.startswith(_RAW_SCAN) else written
                    target += _parse(line, f"line {number}", limits)
                except _Malformed as reason:
                    malformed.append(Malformed(f"line {number}", str(reason)))
    except _Malformed as reason:
        malformed.append(Malformed(f"line {number + 1}", str(reason)))
    except OSError as error:
        raise InvalidLog(f"cannot read {path}: {error.strerror}") from error

    # CARMEN's logger can write every scan twice, raw and with the robot's pose.
    if not any(isinstance(arrival.reading, Scan) for arrival in written):
        written += raw_scans
    readings = [arrival.reading for arrival in written]
    scan_stamps_s = [reading.stamp_s for reading in readings if isinstance(reading, Scan)]
    if not scan_stamps_s:
        first = f", the first: {malformed[0].reason}" if malformed else ""
        raise InvalidLog(
            f"{path}: no CARMEN scan in {number} lines ({len(malformed)} malformed{first})"
        )
    return CarmenLog(
        readings=tuple(sorted(readings, key=lambda r: (r.stamp_s, isinstance(r, Scan)))),
        scans=len(scan_stamps_s),
        odometry=len(readings) - len(scan_stamps_s),
        out_of_order=sum(later < earlier for earlier, later in pairwise(scan_stamps_s)),
        malformed=tuple(malformed),
        written=tuple(written),
    )


def carmen_streams(path: Path) -> tuple[Stream, ...]:
    """Return the kinds of messages in a CARMEN log, by name, and what they are read for.

    Raises:
        InvalidLog: If the file cannot be opened.
    """
    times_s: defaultdict[bytes, array[float]] = defaultdict(lambda: array("d"))
    counts: Counter[bytes] = Counter()
    try:
        with _open(path) as file:
            for line in _whole_lines(file):
                words = line.split()
                if not words or not _TAG.fullmatch(words[0]):
                    continue
                counts[words[0]] += 1
                # Whatever the message, its time is there.
                with suppress(_Malformed):
                    times_s[words[0]] += array("d", _Words(words[-_WORDS_IN_TIME:]).finite(1))
    except _Malformed:
        pass
    except OSError as error:
        raise InvalidLog(f"cannot read {path}: {error.strerror}") from error
    has_others = bool(counts.keys() & {b"FLASER", b"ROBOTLASER1"})
    return tuple(
        Stream(
            tag.decode(),
            _KINDS.get(tag, ""),
            "text",
            *_use(tag, has_others),
            count,
            np.array(times_s[tag]),
        )
        for tag, count in sorted(counts.items())
    )


def _use(tag: bytes, has_scans: bool) -> tuple[Use, str]:
    """Return what messages are read for, and why, where there are others with scans or not."""
    if tag == _RAW_SCAN:
        return (
            (Use.NOTHING, "there are other scans") if has_scans else (Use.SCANS, "no other scans")
        )
    if tag == b"ODOM":
        return Use.ODOMETRY, ""
    if tag in _PARSERS:
        return Use.SCANS_AND_ODOMETRY, ""
    return Use.NOTHING, ""


def _open(path: Path) -> BinaryIO | gzip.GzipFile | bz2.BZ2File:
    with path.open("rb") as file:
        magic = file.read(max(len(_GZIP_MAGIC), len(_BZIP2_MAGIC)))
    if magic.startswith(_GZIP_MAGIC):
        return gzip.open(path)
    if magic.startswith(_BZIP2_MAGIC):
        return bz2.open(path)
    return path.open("rb")


def _whole_lines(file: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the lines up to where the compressed stream breaks, then raise `_Malformed`."""
    try:
        yield from file
    except (EOFError, OSError, zlib.error) as error:
        raise _Malformed(f"compressed stream is damaged: {error}") from error


def _parse(line: bytes, place: str, limits: _Limits) -> Iterable[Arrival]:
    """Return the readings on one line, none if it holds another message.

    Raises:
        _Malformed: If it should hold a reading and does not.
    """
    tag, *words = line.split() or [b""]
    parser = _PARSERS.get(tag)
    readings = parser(_Words(words), limits) if parser else ()
    return [Arrival(tag.decode(), place, reading) for reading in readings]


class _Words:
    """The words of one line, taken from left to right."""

    def __init__(self, words: list[bytes]) -> None:
        self._words = words
        self._taken = 0

    def finite(self, count: int) -> list[float]:
        words = self._take(count)
        try:
            numbers = [float(word) for word in words]
        except ValueError as error:
            raise _Malformed(str(error)) from error
        if not all(map(math.isfinite, numbers)):
            raise _Malformed(f"not finite: {numbers}")
        return numbers

    def counted(self) -> FloatArray:
        """Take a count and as many numbers."""
        (count,) = self.finite(1)
        if count < 0 or not count.is_integer():
            raise _Malformed(f"{count} is no count")
        words = self._take(int(count))
        try:
            return np.array(words, dtype=np.float64)
        except ValueError as error:
            raise _Malformed(str(error)) from error

    def _take(self, count: int) -> list[bytes]:
        words = self._words[self._taken : self._taken + count]
        if len(words) < count:
            raise _Malformed(f"{len(words)} words left where {count} numbers should be")
        self._taken += count
        return words

    def ranges(self) -> FloatArray:
        """Take a count and as many ranges; an infinite one is a beam without return."""
        ranges = self.counted()
        if ranges.size < 2:
            raise _Malformed(f"{ranges.size} beams")
        if not (ranges >= 0.0).all():
            raise _Malformed(f"{int((~(ranges >= 0.0)).sum())} ranges negative or not a number")
        return ranges

    def pose(self) -> Pose:
        return planar_pose(*self.finite(3))

    def stamp_s(self) -> float:
        """Take the ipc time, which must be followed by exactly the host and the logger's time."""
        left = len(self._words) - self._taken
        if left != _WORDS_IN_TIME:
            raise _Malformed(f"{left} words left where time, host and time should be")
        return self.finite(1)[0]


def _odom(words: _Words, _: _Limits) -> tuple[Reading, ...]:
    odom_from_body = words.pose()
    words.finite(3)
    return (OdometryReading(words.stamp_s(), odom_from_body),)


def _flaser(words: _Words, limits: _Limits) -> tuple[Reading, ...]:
    ranges_m = words.ranges()
    odom_from_laser, odom_from_body = words.pose(), words.pose()
    stamp_s = words.stamp_s()
    body_from_laser = inverse(odom_from_body) @ odom_from_laser
    # 180 beams are those of a scanner with 181, without the last one.
    step_rad = math.pi / (180 if ranges_m.size == 180 else ranges_m.size - 1)
    directions = _directions(ranges_m.size, -math.pi / 2, step_rad)
    return (
        OdometryReading(stamp_s, odom_from_body),
        _scan(stamp_s, ranges_m, directions, body_from_laser, limits),
    )


def _robotlaser1(words: _Words, limits: _Limits) -> tuple[Reading, ...]:
    ranges_m, directions = _configured_sweep(words)
    odom_from_laser, odom_from_body = words.pose(), words.pose()
    words.finite(_WORDS_BETWEEN_POSES_AND_TIME)
    stamp_s = words.stamp_s()
    body_from_laser = inverse(odom_from_body) @ odom_from_laser
    return (
        OdometryReading(stamp_s, odom_from_body),
        _scan(stamp_s, ranges_m, directions, body_from_laser, limits),
    )


def _rawlaser1(words: _Words, limits: _Limits) -> tuple[Reading, ...]:
    ranges_m, directions = _configured_sweep(words)
    return (_scan(words.stamp_s(), ranges_m, directions, identity(), limits),)


_PARSERS: dict[bytes, Callable[[_Words, _Limits], tuple[Reading, ...]]] = {
    b"ODOM": _odom,
    b"FLASER": _flaser,
    b"ROBOTLASER1": _robotlaser1,
    _RAW_SCAN: _rawlaser1,
}


def _configured_sweep(words: _Words) -> tuple[FloatArray, FloatArray]:
    """Take CONFIG, ranges and remissions; return ranges (inf: no return) and directions."""
    _, start_rad, _, step_rad, sensor_max_m, _, _ = words.finite(_WORDS_IN_CONFIG)
    if step_rad <= 0.0:
        raise _Malformed(f"beams {step_rad} rad apart")
    ranges_m = words.ranges()
    words.counted()
    if sensor_max_m > 0.0:
        ranges_m[ranges_m >= sensor_max_m] = math.inf
    return ranges_m, _directions(ranges_m.size, start_rad, step_rad)


@lru_cache(maxsize=16)
def _directions(beams: int, start_rad: float, step_rad: float) -> FloatArray:
    """Return the unit vectors of the beams in the laser's frame, shape (beams, 3), read-only."""
    bearings_rad = start_rad + step_rad * np.arange(beams)
    directions = np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad), np.zeros(beams)])
    directions.flags.writeable = False
    return directions


def _scan(
    stamp_s: float,
    ranges_m: FloatArray,
    directions: FloatArray,
    body_from_laser: Pose,
    limits: _Limits,
) -> Scan:
    is_return = (ranges_m >= limits.min_range_m) & (ranges_m <= limits.max_range_m)
    points_in_laser = ranges_m[is_return, np.newaxis] * directions[is_return]
    return Scan(
        stamp_s=stamp_s,
        points_in_body=transform_points(body_from_laser, points_in_laser),
        sensor_in_body=body_from_laser[:3, 3].copy(),
    )
