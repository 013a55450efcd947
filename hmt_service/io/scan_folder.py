"""Folders of scans, one file each: sequences of the KITTI benchmark, PCD, PLY.

    FOLDER/velodyne/000000.bin ...   or the files in FOLDER itself, or in its one folder of scans
    FOLDER/times.txt                 or timestamps.txt, there or beside the files: a stamp per scan

A stamp is a number of seconds, or of ms, us or ns where it is too large for that, or a date and
time. Where no such file is, the names of the scans are their stamps if all of them are such
numbers since an epoch; elsewhere the scans are assumed to be as far apart as the caller says. There
is no odometry; the frame of the scans is the body's unless the caller says where the sensor sits.

References:
    Geiger et al., Are we ready for autonomous driving?, CVPR 2012.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from hmt_service.core.geometry import Pose, identity
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.decoding import NANOSECONDS, Defect, DefectError, Returns, cloud_scan
from hmt_service.io.malformed import Malformed, Tally
from hmt_service.io.scan_files import SUFFIXES, read_scan_file
from hmt_service.io.streams import Arrival, Mounting, Note, Says, Stream, Use

_STAMP_FILES = ("times.txt", "timestamps.txt")
_NESTED = Path("velodyne_points", "data")
"""Where the raw recordings of KITTI have their scans."""
_TRUTH = "poses.txt"
_USUAL_RATE_HZ = 10.0
_EPOCH_S = 1e8
"""Smaller numbers are no stamps since an epoch; larger ones by 1e3 each are ms, us and ns."""
_NAME = re.compile(r"(?:.*[^0-9.])?(\d+(?:\.\d+)?)")
_SPLIT_NAME = re.compile(r"(?:.*[^0-9])?(\d{9,10})_(\d{9})")


class ScanFolder:
    """One folder of scans."""

    def __init__(self, path: Path, *, scan_rate_hz: float | None = None) -> None:
        """Find the scans and their stamps.

        Args:
            path: The folder.
            scan_rate_hz: Scans per second, for those without stamps; None for 10.

        Raises:
            InvalidLog: If there are none, in more than one folder, or more or fewer than stamps.
            InvalidInput: If a rate is given, and the scans have stamps.
        """
        self.path = path
        folder, files, self._others = _find(path)
        self._suffix = files[0].suffix.lower()
        self._pattern = f"{folder.relative_to(path) / '*'}{self._suffix}"
        stamps_s, self._stamped_by = _stamps(folder, path, files)
        self.notes: tuple[Note, ...] = ()
        if stamps_s is None:
            rate_hz = scan_rate_hz or _USUAL_RATE_HZ
            stamps_s = [number / rate_hz for number in range(len(files))]
            self._stamped_by = f"{rate_hz:g} scans per second"
            if scan_rate_hz is None:
                self.notes = (
                    Note(
                        f"no scan has a stamp: {rate_hz:g} scans per second are assumed",
                        f"say --scan-rate, or put {_STAMP_FILES[0]}, a stamp per line, beside them",
                    ),
                )
        elif scan_rate_hz is not None:
            raise InvalidInput(
                f"{path}: scans are stamped by {self._stamped_by}: leave out --scan-rate"
            )
        self._written = list(zip(stamps_s, files, strict=True))

    @property
    def form(self) -> str:
        """Name of the format."""
        is_kitti = self._suffix == ".bin" and self._stamped_by in _STAMP_FILES
        return "sequence of KITTI" if is_kitti else f"folder of {self._suffix[1:].upper()} files"

    def streams(self) -> tuple[Stream, ...]:
        """Return the files of scans, those of other formats, and what they are read for."""
        times_s = np.array([stamp_s for stamp_s, _ in self._written])
        used = Stream(
            self._pattern,
            "scan",
            self._suffix[1:],
            Use.SCANS,
            f"stamped by {self._stamped_by}",
            len(times_s),
            times_s,
        )
        others = (
            Stream(f"*{suffix}", "scan", suffix[1:], Use.NOTHING, f"fewer than {self._pattern}", n)
            for suffix, n in sorted(self._others.items())
        )
        if not (self.path / _TRUTH).is_file():
            return (used, *others)
        truth = Stream(_TRUTH, "poses", "text", Use.NOTHING, "true poses are no odometry", 1)
        return (used, *others, truth)

    def read(
        self, *, min_range_m: float, max_range_m: float, body_from_sensor: Pose | None = None
    ) -> FolderLog:
        """Open the scans, and read as far as the first usable one.

        Args:
            min_range_m: Returns nearer than this are left out of the scans.
            max_range_m: Returns farther than this are left out of the scans.
            body_from_sensor: Pose of the sensor on the body, shape (4, 4); None for the identity.

        Raises:
            InvalidLog: If no scan is usable.
        """
        log = FolderLog(
            written=tuple(self._written),
            returns=Returns(min_range_m, max_range_m),
            body_from_sensor=identity() if body_from_sensor is None else body_from_sensor,
            unread=tuple(f"{n} files *{suffix}" for suffix, n in sorted(self._others.items())),
            notes=self.notes,
            mounting=Mounting(None, None, Says.NOBODY if body_from_sensor is None else Says.CALLER),
        )
        tally = Tally()
        if next(log.arrivals(tally), None) is None:
            first = tally.result()[0]
            raise InvalidLog(
                f"{self.path}: no usable scan in {len(self._written)} files {self._pattern}; "
                f"{first.place}: {first.reason}"
            )
        return log


@dataclass(slots=True, eq=False)
class FolderLog:
    """What a folder of scans holds, without holding it."""

    written: Sequence[tuple[float, Path]]
    """Stamps, s, and files, in the order of their names."""
    returns: Returns
    """Which points are returns."""
    body_from_sensor: Pose
    """Pose of the sensor, shape (4, 4)."""
    unread: tuple[str, ...]
    """Scans in other formats, with their number."""
    notes: tuple[Note, ...]
    """What is assumed, because nothing says it."""
    mounting: Mounting
    """Who says where the sensor sits: files name no frames."""
    malformed: tuple[Malformed, ...] = ()
    """What the last complete iteration has left out; nothing before the first."""
    odometry: int = 0
    """There is none."""
    reorder_s: float = math.inf
    """All readings are sorted."""

    @property
    def scans(self) -> int:
        """Number of files that should be scans."""
        return len(self.written)

    @property
    def readings(self) -> Iterable[Reading]:
        """The usable scans in the order of time; every iteration reads them again."""
        return _InTime(self)

    def arrivals(self, tally: Tally) -> Iterator[Arrival]:
        """Yield the scans in the order of their names, and count the files that hold none."""
        return self.read(self.written, tally)

    def sample(self, most: int) -> Iterator[Scan]:
        """Yield at most so many usable scans, evenly spread over the folder."""
        for arrival in self.read(self.written[:: -(-self.scans // most)], Tally()):
            if isinstance(arrival.reading, Scan):
                yield arrival.reading

    def read(self, files: Iterable[tuple[float, Path]], tally: Tally) -> Iterator[Arrival]:
        """Yield the scans in these files, with their stamps, and count the files that hold none."""
        for stamp_s, path in files:
            try:
                scan = self._scan(stamp_s, path)
            except DefectError as error:
                tally.add((path.suffix, error.defect), path.name, error.defect)
            except InvalidLog as error:
                tally.add((path.suffix, "unreadable"), path.name, str(error))
            else:
                yield Arrival(path.parent.name, path.name, scan)

    def _scan(self, stamp_s: float, path: Path) -> Scan:
        points, times = read_scan_file(path)
        if not len(points):
            raise DefectError(Defect.EMPTY)
        return cloud_scan(stamp_s, points, times, self.returns, self.body_from_sensor)[0]


class _InTime(Iterable[Reading]):
    """The readings of a folder."""

    def __init__(self, log: FolderLog) -> None:
        self._log = log

    def __iter__(self) -> Iterator[Reading]:
        """Yield the usable scans in the order of time."""
        tally = Tally()
        # Names of equal stamps stay in their order.
        in_time = sorted(self._log.written, key=lambda stamped: stamped[0])
        for arrival in self._log.read(in_time, tally):
            yield arrival.reading
        self._log.malformed = tally.result()


def is_scan_folder(path: Path) -> bool:
    """Return whether a folder holds scans, or a folder of them."""
    return bool(_folders_of_scans(path))


def _find(path: Path) -> tuple[Path, list[Path], Counter[str]]:
    """Return where the scans are, those of the most frequent format by name, and the others."""
    folders = _folders_of_scans(path)
    if not folders:
        raise InvalidLog(f"{path}: no scan in it ends with {', '.join(sorted(SUFFIXES))}")
    if len(folders) > 1:
        names = ", ".join(str(folder.relative_to(path)) for folder in folders)
        raise InvalidLog(f"{path}: scans in {len(folders)} folders ({names}): name one of them")
    files = _scans_in(folders[0])
    counts = Counter(file.suffix.lower() for file in files)
    suffix = max(sorted(counts), key=lambda suffix: counts[suffix])
    del counts[suffix]
    chosen = sorted((f for f in files if f.suffix.lower() == suffix), key=_natural)
    return folders[0], chosen, counts


def _folders_of_scans(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    try:
        if _scans_in(path):
            return [path]
        below = [folder for folder in sorted(path.iterdir()) if folder.is_dir()]
        return [folder for folder in [*below, path / _NESTED] if _scans_in(folder)]
    except OSError as error:
        raise InvalidLog(f"cannot read {error.filename}: {error.strerror}") from error


def _scans_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return [f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and f.is_file()]


def _natural(path: Path) -> tuple[tuple[str | int, ...], str]:
    """Return a key that sorts numbers in names by their value."""
    parts = re.split(r"(\d+)", path.stem)
    # Every other part is a number: the types agree place by place.
    return tuple(int(part) if number % 2 else part for number, part in enumerate(parts)), path.name


def _stamps(folder: Path, path: Path, files: Sequence[Path]) -> tuple[Sequence[float] | None, str]:
    """Return the stamps of the scans, s, and what says them; None if nothing does."""
    for where in dict.fromkeys((folder, path, folder.parent)):
        for name in _STAMP_FILES:
            if (where / name).is_file():
                return _stamps_in(where / name, files), name
    named = [_stamp_of_name(file.stem) for file in files]
    stamps_s = [stamp_s for stamp_s in named if stamp_s is not None]
    return (stamps_s, "their names") if len(stamps_s) == len(files) else (None, "")


def _stamps_in(path: Path, files: Sequence[Path]) -> Sequence[float]:
    """Return the stamps of the scans; where files are missing, their numbers name the lines.

    Raises:
        InvalidLog: If a line is no stamp, or it cannot be told which one is of which scan.
    """
    stamps_s = []
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidLog(f"cannot read {path}: {error}") from error
    for number, line in enumerate(text.split("\n"), 1):
        if line.strip():
            if (stamp_s := _stamp_in(line.strip())) is None:
                raise InvalidLog(f"{path}, line {number}: {line.strip()[:40]!r} is no stamp")
            stamps_s.append(stamp_s)
    if len(stamps_s) == len(files):
        return stamps_s
    lines = [int(file.stem) for file in files if file.stem.isdecimal()]
    if len(lines) == len(files) and max(lines) < len(stamps_s):
        return [stamps_s[line] for line in lines]
    raise InvalidLog(
        f"{path}: {len(stamps_s)} stamps for {len(files)} scans whose names do not tell which"
    )


def _stamp_in(line: str) -> float | None:
    for read in (_seconds, _since_epoch):
        with suppress(ValueError):
            return read(line)
    return None


def _since_epoch(text: str) -> float:
    """Return the seconds that a date and time is after the epoch, if nothing else is said in UTC.

    Raises:
        ValueError: If it is none.
    """
    time = datetime.fromisoformat(text)
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _stamp_of_name(stem: str) -> float | None:
    """Return the stamp that a name is; None where it is none, such as a number in a sequence."""
    if (split := _SPLIT_NAME.fullmatch(stem)) is not None:
        return int(split[1]) + int(split[2]) / NANOSECONDS
    if (found := _NAME.fullmatch(stem)) is None:
        return None
    stamp_s = _seconds(found[1])
    return stamp_s if stamp_s >= _EPOCH_S or "." in found[1] else None


def _seconds(text: str) -> float:
    """Return the number of seconds that a number of s, ms, us or ns is.

    Raises:
        ValueError: If it is no number, or not finite.
    """
    number = int(text) if text.isdecimal() else float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    for unit in (1, 10**3, 10**6, 10**9):
        if abs(number) < unit * _EPOCH_S * 1e3:
            return number / unit
    raise ValueError(text)
