"""One way to read a recorded log, whatever its format.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

from hmt_service.core.types import Reading
from hmt_service.errors import InvalidLog
from hmt_service.io.carmen import MalformedLine, read_carmen


class Log(Protocol):
    """What every reader returns at least."""

    @property
    def readings(self) -> tuple[Reading, ...]:
        """Scans and odometry in the order of time."""

    @property
    def scans(self) -> int:
        """Number of scans among them."""

    @property
    def malformed(self) -> tuple[MalformedLine, ...]:
        """What was left out, and why."""


class _Reader(Protocol):
    def __call__(self, path: Path, *, min_range_m: float, max_range_m: float) -> Log: ...


_COMPRESSIONS = {".gz", ".bz2"}
_READERS: dict[str, _Reader] = {
    ".clf": read_carmen,
    ".log": read_carmen,
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
    suffixes = [suffix for suffix in path.suffixes if suffix not in _COMPRESSIONS]
    suffix = suffixes[-1] if suffixes else ""
    reader = _READERS.get(suffix)
    if reader is None:
        known = ", ".join(_READERS)
        raise InvalidLog(f"{path}: unknown format '{suffix}'; readers exist for {known}")
    return reader(path, min_range_m=min_range_m, max_range_m=max_range_m)
