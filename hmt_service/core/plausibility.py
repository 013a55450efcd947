"""Plausibility: whether what the sensor sees is what the settings were made for.

Returns are counted once per cell of space, so that neither the rows of a LiDAR nor how a preset
thins its clouds changes the quantiles: what is measured is the place, not the sensor's density.

References:
    own; the expectations of the presets are measured on recorded and simulated drives.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum, auto

import numpy as np

from hmt_service.core.config import Preset, SensorConfig, load_config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Event, EventKind, Keyframe

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
class _Seen:
    """Quantiles over all keyframes so far; upper edges of their bins."""

    keyframes: int
    median_range_m: float
    range_95_m: float
    height_95_m: float

    def __str__(self) -> str:
        return (
            f"in {self.keyframes} keyframes, half of what it sees is nearer than "
            f"{self.median_range_m:.1f} m, 95 % nearer than {self.range_95_m:.1f} m, and 95 % "
            f"within {self.height_95_m:.1f} m of one plane through the sensor"
        )


class Plausibility:
    """Compares ranges and heights with the expectations of the settings."""

    def __init__(self, sensor: SensorConfig) -> None:
        """Start without an opinion.

        Args:
            sensor: What is expected.
        """
        self._sensor = sensor
        self._ranges = _Histogram(sensor.max_range_m)
        self._heights = _Histogram(sensor.max_range_m)
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
        rays = _one_per_cell(keyframe.points_in_body - keyframe.sensor_in_body)
        if not len(rays):
            return ()
        self._ranges.learn(np.linalg.norm(rays, axis=1))
        self._heights.learn(_heights(rays))
        self._keyframes += 1
        if self._keyframes < self._next_look:
            return ()
        self._next_look *= 2
        return self._judge(keyframe.stamp_s)

    def _judge(self, stamp_s: float) -> tuple[Event, ...]:
        seen = _Seen(
            self._keyframes,
            self._ranges.quantile(0.5),
            self._ranges.quantile(0.95),
            self._heights.quantile(0.95),
        )
        found = _contradictions(seen, self._sensor)
        verdict = _fitting(seen) if found else None
        if verdict == self._said:
            return ()
        self._said = verdict
        numbers = {**asdict(seen), **_expected(self._sensor)}
        name = _name(self._sensor)
        if verdict is None:
            self._doubt = None
            message = f"{name} fits after all: {seen}"
            return (Event(EventKind.PRESET_CONFIRMED, stamp_s, message, numbers),)
        expectations = " and ".join(_expectation(each, self._sensor) for each in found)
        advice = f"{' or '.join(verdict)} would fit better" if verdict else "no preset fits"
        message = f"{name} expects {expectations}; {seen}: {advice}"
        self._doubt = Event(EventKind.PRESET_DOUBTED, stamp_s, message, numbers)
        return (self._doubt,)


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


def _contradictions(seen: _Seen, sensor: SensorConfig) -> tuple[_Contradiction, ...]:
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


def _fitting(seen: _Seen) -> tuple[Preset, ...]:
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
