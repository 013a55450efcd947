"""One way to read a recorded log, whatever its format.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

from hmt_service.core.types import Reading
from hmt_service.errors import InvalidLog
from hmt_service.io.carmen import read_carmen
from hmt_service.io.malformed import Malformed
from hmt_service.io.mcap_log import read_mcap


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


class _Reader(Protocol):
    def __call__(self, path: Path, *, min_range_m: float, max_range_m: float) -> Log: ...


_COMPRESSIONS = {".gz", ".bz2"}
_READERS: dict[str, _Reader] = {
    ".clf": read_carmen,
    ".log": read_carmen,
    ".mcap": read_mcap,
}


def read_log(path: Path, *, min_range_m: float, max_range_m: float) -> Log:
    """Read a recorded log, in the format that its name says; `.gz` and `.bz2` may follow.

    Args:
        path: The log.
        min_range_m: Returns nearer than this are left out of the scans.
        max_range_m: Returns farther than this are left out of the scans.

    Raises:
        InvalidLog: If the format is unknown, the file cannot be opened or holds no usable scan.
    """
    suffixes = [s for s in map(str.lower, path.suffixes) if s not in _COMPRESSIONS]
    suffix = suffixes[-1] if suffixes else ""
    reader = _READERS.get(suffix)
    if reader is None:
        known = ", ".join(_READERS)
        raise InvalidLog(f"{path}: unknown format '{suffix}'; readers exist for {known}")
    return reader(path, min_range_m=min_range_m, max_range_m=max_range_m)
