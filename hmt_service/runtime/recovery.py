"""What is kept of a session so that a process which takes the place of a dead one can go on.

References:
    own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hmt_service.core.types import Keyframe
from hmt_service.runtime.messages import Mapped, RunReport

_JOURNAL_BYTES = 64_000_000
"""Trackings that are kept beside the map file: an hour of a laser, minutes of a LiDAR."""


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBefore:
    """What the odometry has done so far, and all that the next scan is compared with."""

    memory: Mapping[str, Any] | None = None
    """What it remembered after the last reading; None before the first."""
    window: tuple[Keyframe, ...] = ()
    """Its latest keyframes, at least those of its window."""
    processed: int = 0
    """Readings processed."""
    busy_s: float = 0.0
    """Time spent on them, s of the wall clock."""


@dataclass(frozen=True, slots=True, eq=False)
class Interrupted:
    """A session that an engine goes on with."""

    first_keyframe: int
    """Keyframes that the map had when the session began."""
    known_scans: int
    """Scans that the map had in the end, of all sessions."""
    journal: tuple[bytes, ...]
    """The latest of these as `Tracked` messages, in order."""
    wakes_up: bool
    """Whether the robot may be anywhere from the next keyframe on."""


@dataclass(frozen=True, slots=True, eq=False)
class MappedBefore:
    """What the topology has done so far."""

    report: RunReport
    """What it has cost."""
    interrupted: Interrupted | None
    """The session that it goes on with; None to begin one."""


@dataclass(slots=True)
class Session:
    """What the topology has done since the odometry began, as far as it is not in the map file."""

    first_keyframe: int | None = None
    """Keyframes that the map had when the session began; None as long as it has not."""
    known_scans: int = 0
    """Scans in the map, of all sessions."""
    report: RunReport = field(default_factory=lambda: RunReport(0, 0.0, 0.0))
    """What the daemon has cost so far."""
    stored_scans: int = 0
    """How many of them are in the map file at least."""
    wakes_up: bool = False
    """Whether the robot may be anywhere from the next keyframe on."""
    _journal: deque[bytes] = field(default_factory=deque)
    _journal_bytes: int = 0

    def note(self, told: bytes | None, mapped: Mapped) -> None:
        """Keep a scan until it is in the map file, unless too much waits for that.

        Args:
            told: What the topology was told; None if it spoke by itself.
            mapped: What it said.
        """
        self.report, self.wakes_up = mapped.report, mapped.wakes_up
        known_scans, stored_scans = mapped.known_scans, mapped.stored_scans
        if told is not None and known_scans > self.known_scans:
            self._journal.append(told)
            self._journal_bytes += len(told)
        self.known_scans, self.stored_scans = known_scans, stored_scans
        while self._journal and (
            len(self._journal) > known_scans - stored_scans or self._journal_bytes > _JOURNAL_BYTES
        ):
            self._journal_bytes -= len(self._journal.popleft())

    @property
    def can_go_on(self) -> bool:
        """Whether another engine can; not if too much was neither stored nor kept."""
        return len(self._journal) >= self.known_scans - self.stored_scans

    @property
    def interrupted(self) -> Interrupted | None:
        """What another engine needs to go on; None if it is to begin."""
        if self.first_keyframe is None:
            return None
        known, journal = self.known_scans, tuple(self._journal)
        return Interrupted(self.first_keyframe, known, journal, self.wakes_up)
