"""What every benchmark is given and returns.

References: own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from benchmarks.metric import Metric


@dataclass(frozen=True, slots=True)
class Report:
    """What a benchmark has measured, and what it has not."""

    metrics: tuple[Metric, ...]
    """The numbers; their keys begin with what was measured on."""
    skipped: tuple[str, ...] = ()
    """One sentence for everything left out."""


@dataclass(frozen=True, slots=True)
class Run:
    """How a benchmark is to run."""

    is_quick: bool
    """Whether to measure on less."""
    say: Callable[[str], None]
    """Shows a person what is being done."""
