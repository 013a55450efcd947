"""One measured number, the baseline that it is compared with, and the verdict.

References: own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from hmt_service.errors import InvalidInput, NotFound


class Direction(StrEnum):
    """Which way a metric should move."""

    LOWER_IS_BETTER = "lower"
    HIGHER_IS_BETTER = "higher"


@dataclass(frozen=True, slots=True)
class Metric:
    """One measured number."""

    key: str
    """Name, unique in a run, parts separated by `/`."""
    value: float
    """The number."""
    unit: str
    """Its unit; `1` for ratios and counts."""
    direction: Direction
    """Which way it should move."""
    rel_tol: float | None
    """Largest worsening that the gate lets pass, as a share of the baseline; None: never gated."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            InvalidInput: If the value is not finite or the tolerance is no share.
        """
        if not math.isfinite(self.value):
            raise InvalidInput(f"metric {self.key} is {self.value}, not a finite number")
        if self.rel_tol is not None and not 0.0 <= self.rel_tol < math.inf:
            raise InvalidInput(f"metric {self.key}: tolerance {self.rel_tol} is not 0 or more")


@dataclass(frozen=True, slots=True)
class BaselineValue:
    """What a metric was when the baseline was taken."""

    value: float
    """The number."""
    unit: str
    """Its unit."""


Baseline = Mapping[str, BaselineValue]
"""Values by the key of their metric."""


class Verdict(StrEnum):
    """What the comparison of a metric with its baseline says."""

    WITHIN = "within tolerance"
    BETTER = "better"
    WORSE = "WORSE"
    OTHER_UNIT = "OTHER UNIT"
    """The baseline is in another unit: nothing can be said, and the gate does not guess."""
    NOT_GATED = "reported only"
    NOT_IN_BASELINE = "not in baseline"
    NOT_IN_RUN = "not in this run"


_FAILURES = frozenset({Verdict.WORSE, Verdict.OTHER_UNIT})
_COMPARED = _FAILURES | {Verdict.WITHIN, Verdict.BETTER}


@dataclass(frozen=True, slots=True)
class Comparison:
    """One metric beside its baseline; at least one of the two is there."""

    key: str
    """Name of the metric."""
    metric: Metric | None
    """What was measured, if it was."""
    baseline: BaselineValue | None
    """What it is compared with, if it is known."""
    verdict: Verdict
    """What that says."""

    @property
    def is_failure(self) -> bool:
        """Whether the gate fails because of it."""
        return self.verdict in _FAILURES

    @property
    def is_compared(self) -> bool:
        """Whether the gate could fail because of it."""
        return self.verdict in _COMPARED

    @property
    def change(self) -> float | None:
        """Difference as a share of the baseline; None where there is no such share."""
        if self.metric is None or self.baseline is None or not self.baseline.value:
            return None
        if self.verdict is Verdict.OTHER_UNIT:
            return None
        return (self.metric.value - self.baseline.value) / abs(self.baseline.value)


def compare(metrics: Sequence[Metric], baseline: Baseline) -> tuple[Comparison, ...]:
    """Return the verdicts on what was measured, in its order, and then on what was not.

    Args:
        metrics: What was measured; keys are unique.
        baseline: What to compare with.

    Raises:
        InvalidInput: If two metrics have the same key.
    """
    measured = {metric.key: metric for metric in metrics}
    if len(measured) < len(metrics):
        raise InvalidInput(f"{len(metrics)} metrics share {len(measured)} keys")
    here = [
        Comparison(key, metric, baseline.get(key), _verdict(metric, baseline.get(key)))
        for key, metric in measured.items()
    ]
    gone = [
        Comparison(key, None, value, Verdict.NOT_IN_RUN)
        for key, value in baseline.items()
        if key not in measured
    ]
    return (*here, *gone)


def _verdict(metric: Metric, baseline: BaselineValue | None) -> Verdict:
    if metric.rel_tol is None:
        return Verdict.NOT_GATED
    if baseline is None:
        return Verdict.NOT_IN_BASELINE
    if metric.unit != baseline.unit:
        return Verdict.OTHER_UNIT
    allowed = metric.rel_tol * abs(baseline.value)
    is_lower_better = metric.direction is Direction.LOWER_IS_BETTER
    sign = 1.0 if is_lower_better else -1.0
    # Compared with the limit itself: a difference of rounded numbers would miss it.
    if sign * metric.value > sign * baseline.value + allowed:
        return Verdict.WORSE
    if sign * metric.value < sign * baseline.value - allowed:
        return Verdict.BETTER
    return Verdict.WITHIN


def read_baseline(path: Path, mode: str) -> Baseline:
    """Return the values of one mode; none when the file or the mode does not exist.

    Args:
        path: File that `update_baseline` has written.
        mode: What kind of run they are of: a quick run has other values than a full one.

    Raises:
        InvalidInput: If the file is no baseline.
    """
    return {
        key: BaselineValue(value, unit) for key, (value, unit) in _read(path).get(mode, {}).items()
    }


def update_baseline(path: Path, mode: str, metrics: Sequence[Metric]) -> None:
    """Replace the values of the metrics measured, and keep all others.

    Args:
        path: File to write; made when it does not exist.
        mode: What kind of run they are of.
        metrics: What was measured.

    Raises:
        InvalidInput: If the file exists and is no baseline.
        NotFound: If the file cannot be written.
    """
    content = _read(path)
    values = content.setdefault(mode, {})
    values.update({metric.key: (metric.value, metric.unit) for metric in metrics})
    document = {
        name: {
            key: {"value": value, "unit": unit} for key, (value, unit) in sorted(entries.items())
        }
        for name, entries in sorted(content.items())
    }
    try:
        path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise NotFound(f"cannot write the baseline {path}: {error.strerror}") from error


def _read(path: Path) -> dict[str, dict[str, tuple[float, str]]]:
    try:
        text = path.read_text()
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InvalidInput(f"cannot read the baseline {path}: {error.strerror}") from error
    try:
        return {
            mode: {key: (float(one["value"]), str(one["unit"])) for key, one in entries.items()}
            for mode, entries in json.loads(text).items()
        }
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidInput(f"{path} is no baseline: {error!r}") from error
