"""Plausibility: whether what the sensor sees is what the settings were made for.

Returns are counted once per cell of space, so that neither the rows of a LiDAR nor how a preset
thins its clouds changes the quantiles: what is measured is the place, not the sensor's density.

References:
    own; the expectations of the presets are measured on recorded and simulated drives.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from enum import Enum, auto

import numpy as np

from hmt_service.core.config import Preset, SensorConfig, load_config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Event, EventKind, Keyframe, Scan

_FIRST_LOOK = 40
"""Keyframes before the first verdict: many a drive starts in a corner (measured: one in the open
looks like a building for 20). The next ones come at twice as many each, so that it is calm."""
_CELL_M = 1.0
_BIN_M = 0.1


class _Contradiction(Enum):
    TOO_NEAR = auto()
    TOO_FAR = auto()
    FLAT = auto()
    NOT_FLAT = auto()


@dataclass(frozen=True, slots=True)
class Seen:
    """Quantiles over what was looked at; upper edges of their bins."""

    median_range_m: float
    """Half of what is seen is nearer."""
    range_95_m: float
    """95 % is nearer."""
    height_95_m: float
    """95 % is within this distance of one plane through the sensor."""

    def __str__(self) -> str:
        """Return the numbers as a sentence."""
        return (
            f"half of what it sees is nearer than {self.median_range_m:.1f} m, 95 % nearer than "
            f"{self.range_95_m:.1f} m, and 95 % within {self.height_95_m:.1f} m of one plane "
            "through the sensor"
        )


@dataclass(frozen=True, slots=True)
class Fit:
    """Which preset is for what a sensor sees, and why."""

    preset: Preset
    """The preset."""
    has_doubt: bool
    """Whether what is seen contradicts even this preset, the least wrong one."""
    scans: int
    """How many scans with returns this was measured in."""
    seen: Seen
    """What they see."""

    def __str__(self) -> str:
        """Return the choice and its numbers as a sentence."""
        verdict = "least wrong, though no preset fits" if self.has_doubt else "fits"
        return f"preset {self.preset} {verdict}: in {self.scans} scans, {self.seen}"


def fitting_preset(scans: Iterable[Scan]) -> Fit | None:
    """Return the preset that fits what a sensor sees best, by the expectations of the presets.

    Args:
        scans: Some of a drive, from all of it.

    Returns:
        The choice; None if there is no return in any of them.
    """
    sensors = {preset: load_config(preset).sensor for preset in Preset}
    nearest_m = min(sensor.min_range_m for sensor in sensors.values())
    farthest_m = max(sensor.max_range_m for sensor in sensors.values())
    view = _View(farthest_m)
    looked_at = 0
    for scan in scans:
        rays = scan.points_in_body - scan.sensor_in_body
        ranges = np.linalg.norm(rays, axis=1)
        looked_at += view.learn(rays[(ranges >= nearest_m) & (ranges <= farthest_m)])
    if not looked_at:
        return None
    seen = view.seen()
    wrong = {preset: _contradictions(seen, sensor) for preset, sensor in sensors.items()}
    # What is no plane must not be mapped as one, and nothing else as it.
    possible = [
        preset
        for preset in Preset
        if not {_Contradiction.FLAT, _Contradiction.NOT_FLAT} & set(wrong[preset])
    ]
    best = max(possible, key=lambda preset: _margin_m(seen, sensors[preset]))
    return Fit(best, bool(wrong[best]), looked_at, seen)


class Plausibility:
    """Compares ranges and heights with the expectations of the settings."""

    def __init__(self, sensor: SensorConfig) -> None:
        """Start without an opinion.

        Args:
            sensor: What is expected.
        """
        self._sensor = sensor
        self._view = _View(sensor.max_range_m)
        self._keyframes = 0
        self._next_look = _FIRST_LOOK
        self._said: tuple[Preset, ...] | None = None
        self._doubt: Event | None = None

    @property
    def doubt(self) -> Event | None:
        """What speaks against the settings; None while nothing does."""
        return self._doubt

    def check(self, keyframe: Keyframe) -> tuple[Event, ...]:
        """Look at one more keyframe, and return an event when the verdict has changed."""
        if not self._view.learn(keyframe.points_in_body - keyframe.sensor_in_body):
            return ()
        self._keyframes += 1
        if self._keyframes < self._next_look:
            return ()
        self._next_look *= 2
        return self._judge(keyframe.stamp_s)

    def _judge(self, stamp_s: float) -> tuple[Event, ...]:
        seen = self._view.seen()
        found = _contradictions(seen, self._sensor)
        verdict = _fitting(seen) if found else None
        if verdict == self._said:
            return ()
        self._said = verdict
        numbers = {"keyframes": self._keyframes, **asdict(seen), **_expected(self._sensor)}
        what = f"in {self._keyframes} keyframes, {seen}"
        name = _name(self._sensor)
        if verdict is None:
            self._doubt = None
            message = f"{name} fits after all: {what}"
            return (Event(EventKind.PRESET_CONFIRMED, stamp_s, message, numbers),)
        expectations = " and ".join(_expectation(each, self._sensor) for each in found)
        advice = f"{' or '.join(verdict)} would fit better" if verdict else "no preset fits"
        message = f"{name} expects {expectations}; {what}: {advice}"
        self._doubt = Event(EventKind.PRESET_DOUBTED, stamp_s, message, numbers)
        return (self._doubt,)


class _View:
    """What was seen so far, every cell of space once per look."""

    def __init__(self, max_range_m: float) -> None:
        self._ranges = _Histogram(max_range_m)
        self._heights = _Histogram(max_range_m)

    def learn(self, rays: FloatArray) -> bool:
        """Look at the returns of one scan, shape (N, 3); return whether there were any."""
        once = _one_per_cell(rays)
        if not len(once):
            return False
        self._ranges.learn(np.linalg.norm(once, axis=1))
        self._heights.learn(_heights(once))
        return True

    def seen(self) -> Seen:
        return Seen(
            self._ranges.quantile(0.5), self._ranges.quantile(0.95), self._heights.quantile(0.95)
        )


class _Histogram:
    """Counts of distances, in bins of fixed width."""

    def __init__(self, max_m: float) -> None:
        self._counts = np.zeros(int(np.ceil(max_m / _BIN_M)), dtype=np.int64)

    def learn(self, distances: FloatArray) -> None:
        bins = np.minimum((distances / _BIN_M).astype(np.int64), len(self._counts) - 1)
        self._counts += np.bincount(bins, minlength=len(self._counts))

    def quantile(self, share: float) -> float:
        """Return the upper edge of the bin that so large a share of all is below or in."""
        below = np.cumsum(self._counts)
        return float(np.searchsorted(below, share * below[-1]) + 1) * _BIN_M


def _one_per_cell(rays: FloatArray) -> FloatArray:
    """Return the first point in every cell of space, shape (M, 3), M <= N."""
    # Cells are centred at the sensor: its own plane must not be a border between them.
    cells = np.rint(rays / _CELL_M).astype(np.int64)
    _, first = np.unique(cells @ _CELL_NUMBER, return_index=True)
    return np.asarray(rays[np.sort(first)])


def _heights(rays: FloatArray) -> FloatArray:
    """Return the distances from the plane through the sensor that is nearest to all rays."""
    ranges = np.linalg.norm(rays, axis=1, keepdims=True)
    directions = np.divide(rays, ranges, out=np.zeros_like(rays), where=ranges > 0.0)
    _, axes = np.linalg.eigh(directions.T @ directions)
    return np.asarray(np.abs(rays @ axes[:, 0]))


def _margin_m(seen: Seen, sensor: SensorConfig) -> float:
    """Return how far the median range is from what would contradict; negative if it does."""
    return min(
        seen.median_range_m - sensor.min_median_range_m,
        sensor.max_median_range_m - seen.median_range_m,
    )


def _contradictions(seen: Seen, sensor: SensorConfig) -> tuple[_Contradiction, ...]:
    is_flat = seen.height_95_m <= sensor.flat_height_m
    holds = {
        _Contradiction.TOO_NEAR: seen.median_range_m < sensor.min_median_range_m,
        _Contradiction.TOO_FAR: seen.median_range_m > sensor.max_median_range_m,
        _Contradiction.FLAT: is_flat and not sensor.is_planar,
        _Contradiction.NOT_FLAT: sensor.is_planar and not is_flat,
    }
    return tuple(contradiction for contradiction, is_so in holds.items() if is_so)


def _expectation(contradiction: _Contradiction, sensor: SensorConfig) -> str:
    match contradiction:
        case _Contradiction.FLAT:
            return f"heights of more than {sensor.flat_height_m:g} m"
        case _Contradiction.NOT_FLAT:
            return f"one plane, give or take {sensor.flat_height_m:g} m"
        case _Contradiction.TOO_NEAR:
            return f"a median range of at least {sensor.min_median_range_m:g} m"
        case _Contradiction.TOO_FAR:
            return f"a median range of at most {sensor.max_median_range_m:g} m"


def _fitting(seen: Seen) -> tuple[Preset, ...]:
    return tuple(p for p in Preset if not _contradictions(seen, load_config(p).sensor))


def _name(sensor: SensorConfig) -> str:
    """Return the preset that these expectations are of, if they are of one."""
    expected = _expected(sensor)
    for preset in Preset:
        of_preset = load_config(preset).sensor
        if of_preset.is_planar == sensor.is_planar and _expected(of_preset) == expected:
            return f"preset {preset}"
    return "the configuration"


def _expected(sensor: SensorConfig) -> Mapping[str, float]:
    return {
        "min_median_range_m": sensor.min_median_range_m,
        "max_median_range_m": sensor.max_median_range_m,
        "flat_height_m": sensor.flat_height_m,
    }


_CELL_NUMBER = np.array([1, 1 << 21, 1 << 42])
"""Makes one number of a cell: no two within a million cells of the sensor share one."""
