"""What a reader leaves out of a log, and why.

References: own.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Malformed:
    """Something in a log that should hold a reading and does not."""

    place: str
    """Where it stands: a line, a message, a byte; of the first one when several are counted."""
    reason: str
    """What is wrong with it."""
    count: int = 1
    """How many of the same kind were left out for this reason."""


class Tally:
    """What was left out: things that are alike are counted together, so that memory stays flat."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._counts: Counter[tuple[str, str]] = Counter()
        self._first: dict[tuple[str, str], tuple[str, str]] = {}

    def add(self, kind: tuple[str, str], place: str, reason: str) -> None:
        """Count one thing; of one kind, the first's place and reason are kept."""
        self._counts[kind] += 1
        self._first.setdefault(kind, (place, reason))

    def result(self) -> tuple[Malformed, ...]:
        """Return what was counted, in the order in which the kinds appeared."""
        return tuple(Malformed(*self._first[kind], n) for kind, n in self._counts.items())
