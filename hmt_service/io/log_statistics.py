"""What the readings of a log are like: numbers that tell a sensor, its clock and its mounting.

Memory does not grow with the scans, but for a few numbers of each.

References: own.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import OdometryReading, Scan
from hmt_service.io.streams import Arrival

_LEAST_GAP_S = 0.5
_USUAL_PERIODS = 5.0
"""A gap is longer than both: half a second, and so many usual periods."""
_STEP_DEG = 0.05
"""Resolution of the directions that are counted."""
_LIDAR_STEP_DEG = 2.0
"""Columns of a LiDAR are nearer to each other than this."""
_ALIKE_M = 1e-3
"""Ranges nearer to each other than this are one number."""
_CLEAR_SHARE = 0.95
_NOISE_SHARE = 1e-4
"""A direction with a smaller share of all returns is none of the sensor's own."""
_PATH_STEP_S = 1.0
_GROUND_BAND_M = (4.0, 25.0)
"""How far from the sensor the ground is looked for."""
_LAYER_M = 0.25
_Counts = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Timing:
    """The stamps of one stream."""

    first_s: float | None
    """The earliest one; None if there is none."""
    last_s: float | None
    """The latest one."""
    rate_hz: float | None
    """Messages per second; None if all have one stamp."""
    gaps: int
    """Pauses of over half a second and five times the usual period."""
    longest_gap_s: float
    """The longest of them; 0 if there is none."""
    longest_gap_at_s: float | None
    """Stamp before it."""
    backwards: int
    """How often a stamp is earlier than the one before it in the log."""
    most_backwards_s: float
    """By how much at most."""
    repeated: int
    """How often it is the same."""


@dataclass(frozen=True, slots=True)
class Ground:
    """The level layers of what a LiDAR sees around it."""

    below_m: float
    """Height of the widest one below the sensor; negative, or 0 if there is none."""
    below_share: float
    """Share of all places that it is seen at."""
    above_m: float
    """Height of the widest one above the sensor."""
    above_share: float
    """Share of all places that it is seen at."""


@dataclass(frozen=True, slots=True)
class ScanStatistics:
    """What the scans of a log are like."""

    scans: int
    """How many were usable."""
    timing: Timing
    """Their stamps."""
    points_p50: int
    """Returns per scan, the median."""
    empty: int
    """Scans without a return."""
    constant: int
    """Scans whose returns all have one range."""
    frozen: int
    """Scans that are the one before once more."""
    with_point_times: int
    """Scans whose points have times of their own."""
    range_p50_m: float
    """Half of the returns of the median scan are nearer."""
    range_max_m: float
    """The farthest return."""
    at_range_max_share: float
    """Share of all returns that are as far as that, to the mm."""
    beams: int | None
    """Beams of a planar laser; None of a LiDAR, or where no two are told apart."""
    rows: int | None
    """Rows of a LiDAR; None of a planar laser, or where they cannot be told apart."""
    width_deg: float
    """Field of view across, as the body sees it."""
    lowest_deg: float
    """Lowest direction of it."""
    highest_deg: float
    """Highest direction of it."""
    sensor_in_body_m: tuple[float, float, float]
    """Where the sensor is on the body."""
    ground: Ground | None
    """Level layers; None of a planar laser."""
    late_s: float | None
    """How much later than their stamps scans were recorded, the median; None where nothing says."""


@dataclass(frozen=True, slots=True)
class OdometryStatistics:
    """What the odometry of a log is like."""

    readings: int
    """How many were usable."""
    timing: Timing
    """Their stamps."""
    path_m: float
    """Length of the path, from one second to the next: stamps may be a little out of order."""
    jump_m: float
    """The largest step from one reading to the next."""
    jump_s: float
    """How long that took."""
    jump_at_s: float | None
    """Stamp before it; None if there is no step."""
    late_s: float | None
    """How much later than their stamps readings were recorded, the median; None as above."""


def timing_of(stamps_s: Sequence[float] | FloatArray) -> Timing:
    """Return what the stamps of a stream say, in the order of the log, shape (N,)."""
    written = np.asarray(stamps_s, dtype=np.float64)
    if not len(written):
        return Timing(None, None, None, 0, 0.0, None, 0, 0.0, 0)
    steps = np.diff(written)
    in_time = np.sort(written)
    periods = np.diff(in_time)
    usual_s = float(np.median(periods[periods > 0.0])) if (periods > 0.0).any() else 0.0
    is_gap = periods > max(_LEAST_GAP_S, _USUAL_PERIODS * usual_s)
    longest = int(periods.argmax()) if is_gap.any() else None
    span_s = float(in_time[-1] - in_time[0])
    return Timing(
        first_s=float(in_time[0]),
        last_s=float(in_time[-1]),
        rate_hz=(len(written) - 1) / span_s if span_s > 0.0 else None,
        gaps=int(is_gap.sum()),
        longest_gap_s=0.0 if longest is None else float(periods[longest]),
        longest_gap_at_s=None if longest is None else float(in_time[longest]),
        backwards=int((steps < 0.0).sum()),
        most_backwards_s=float(max(0.0, -steps.min(initial=0.0))),
        repeated=int((steps == 0.0).sum()),
    )


class ScanCollector:
    """Takes scans one by one."""

    def __init__(self, *, every: int) -> None:
        """Begin with none; directions and layers are those of every so many scans."""
        self._every = every
        self.stamps_s = array("d")
        self._late_s = array("d")
        self._points = array("q")
        self._ranges_p50_m = array("d")
        self._before: FloatArray | None = None
        self._constant = self._frozen = self._with_point_times = 0
        self._range_max_m, self._at_range_max = 0.0, 0
        self._sensor_in_body = np.zeros(3)
        self._azimuths = np.zeros(round(360.0 / _STEP_DEG), dtype=np.int64)
        self._elevations = np.zeros(round(180.0 / _STEP_DEG) + 1, dtype=np.int64)
        self._steps_rad = array("d")
        self._layers = _Layers()

    def take(self, arrival: Arrival, scan: Scan) -> None:
        """Look at one more scan."""
        number = len(self.stamps_s)
        self.stamps_s.append(scan.stamp_s)
        if arrival.recorded_s is not None:
            self._late_s.append(arrival.recorded_s - scan.stamp_s)
        points, before = scan.points_in_body, self._before
        self._before = points
        self._points.append(len(points))
        self._sensor_in_body = scan.sensor_in_body
        if not len(points):
            return
        self._with_point_times += scan.point_times is not None
        self._frozen += before is not None and np.array_equal(before, points)
        rays = points - scan.sensor_in_body
        ranges = np.linalg.norm(rays, axis=1)
        self._constant += len(ranges) > 1 and bool(np.ptp(ranges) < _ALIKE_M)
        self._ranges_p50_m.append(float(np.median(ranges)))
        farthest_m = float(ranges.max())
        if farthest_m > self._range_max_m + _ALIKE_M:
            self._range_max_m, self._at_range_max = farthest_m, 0
        self._at_range_max += int((ranges > self._range_max_m - _ALIKE_M).sum())
        if number % self._every == 0:
            self._look(rays)

    def _look(self, rays: FloatArray) -> None:
        bearings = np.arctan2(rays[:, 1], rays[:, 0])
        turned = np.floor(np.degrees(bearings) / _STEP_DEG).astype(np.int64)
        self._azimuths += np.bincount(turned % len(self._azimuths), minlength=len(self._azimuths))
        levels = np.degrees(np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])))
        bins = np.rint((levels + 90.0) / _STEP_DEG).astype(np.int64)
        self._elevations += np.bincount(bins, minlength=len(self._elevations))
        steps = np.diff(np.sort(bearings))
        if (steps > 0.0).any():
            self._steps_rad.append(float(np.median(steps[steps > 0.0])))
        self._layers.learn(rays)

    def result(self, *, is_planar: bool) -> ScanStatistics:
        """Return what the scans are like, of a planar laser or not."""
        points = np.array(self._points)
        step_deg = float(np.degrees(np.median(self._steps_rad))) if self._steps_rad else 0.0
        width_deg = _width_deg(self._azimuths, step_deg if is_planar else _LIDAR_STEP_DEG)
        beams = None
        if is_planar and step_deg > 0.0:
            beams = round(width_deg / step_deg) + (width_deg < 360.0)
        is_seen = self._elevations > _NOISE_SHARE * self._elevations.sum()
        seen_deg = np.flatnonzero(is_seen) * _STEP_DEG - 90.0
        x, y, z = self._sensor_in_body.tolist()
        return ScanStatistics(
            scans=len(points),
            timing=timing_of(self.stamps_s),
            points_p50=int(np.median(points)) if len(points) else 0,
            empty=int((points == 0).sum()),
            constant=self._constant,
            frozen=self._frozen,
            with_point_times=self._with_point_times,
            range_p50_m=float(np.median(self._ranges_p50_m)) if self._ranges_p50_m else 0.0,
            range_max_m=self._range_max_m,
            at_range_max_share=self._at_range_max / max(1, int(points.sum())),
            beams=beams,
            rows=None if is_planar else _rows(self._elevations),
            width_deg=width_deg,
            lowest_deg=float(seen_deg[0]) if len(seen_deg) else 0.0,
            highest_deg=float(seen_deg[-1]) if len(seen_deg) else 0.0,
            sensor_in_body_m=(x, y, z),
            ground=None if is_planar else self._layers.result(),
            late_s=float(np.median(self._late_s)) if self._late_s else None,
        )


class OdometryCollector:
    """Takes odometry reading by reading."""

    def __init__(self) -> None:
        """Begin with none."""
        self.stamps_s = array("d")
        self._late_s = array("d")
        self._positions = array("d")

    def take(self, arrival: Arrival, reading: OdometryReading) -> None:
        """Look at one more reading."""
        self.stamps_s.append(reading.stamp_s)
        self._positions.extend(reading.odom_from_body[:3, 3])
        if arrival.recorded_s is not None:
            self._late_s.append(arrival.recorded_s - reading.stamp_s)

    def result(self) -> OdometryStatistics | None:
        """Return what the odometry is like; None if there was none."""
        if not self.stamps_s:
            return None
        stamps_s = np.array(self.stamps_s)
        order = np.argsort(stamps_s, kind="stable")
        positions = np.array(self._positions).reshape(-1, 3)[order]
        steps_m = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        farthest = int(steps_m.argmax()) if len(steps_m) else None
        times_s = stamps_s[order]
        return OdometryStatistics(
            readings=len(stamps_s),
            timing=timing_of(self.stamps_s),
            path_m=_path_m(times_s, positions),
            jump_m=0.0 if farthest is None else float(steps_m[farthest]),
            jump_s=0.0 if farthest is None else float(times_s[farthest + 1] - times_s[farthest]),
            jump_at_s=None if farthest is None else float(times_s[farthest]),
            late_s=float(np.median(self._late_s)) if self._late_s else None,
        )


def _path_m(times_s: FloatArray, positions: FloatArray) -> float:
    _, first = np.unique(np.floor(times_s / _PATH_STEP_S), return_index=True)
    at = np.append(first, len(times_s) - 1)
    return float(np.linalg.norm(np.diff(positions[at], axis=0), axis=1).sum())


def _width_deg(azimuths: _Counts, step_deg: float) -> float:
    """Return the least angle that holds all directions; 360 if none is left out for two steps."""
    seen = np.flatnonzero(azimuths)
    if not len(seen):
        return 0.0
    apart = np.diff(seen, append=seen[0] + len(azimuths)) * _STEP_DEG
    widest_deg = float(apart.max())
    return 360.0 if widest_deg <= 2.0 * step_deg + _STEP_DEG else 360.0 - widest_deg


def _rows(elevations: _Counts) -> int | None:
    """Return how many narrow rows hold nearly all directions; None if there are no such rows."""
    is_seen = elevations > _NOISE_SHARE * elevations.sum()
    edges = np.diff(is_seen.astype(np.int8), prepend=0, append=0)
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    if len(begins) < 2:
        return None
    is_clear = elevations[is_seen].sum() >= _CLEAR_SHARE * elevations.sum()
    is_narrow = 2 * is_seen.sum() <= ends[-1] - begins[0]
    return len(begins) if is_clear and is_narrow else None


class _Layers:
    """How many places around the sensor something is seen at, by height."""

    def __init__(self) -> None:
        self._places: dict[int, int] = {}
        self._all = 0

    def learn(self, rays: FloatArray) -> None:
        across = np.hypot(rays[:, 0], rays[:, 1])
        is_near = (across >= _GROUND_BAND_M[0]) & (across <= _GROUND_BAND_M[1])
        cells = np.column_stack(
            [np.floor(rays[is_near, :2]), np.floor(rays[is_near, 2] / _LAYER_M)]
        ).astype(np.int64)
        self._all += len(np.unique(cells[:, :2], axis=0))
        layers, counts = np.unique(np.unique(cells, axis=0)[:, 2], return_counts=True)
        for layer, count in zip(layers.tolist(), counts.tolist(), strict=True):
            self._places[layer] = self._places.get(layer, 0) + count

    def result(self) -> Ground:
        below = {layer: n for layer, n in self._places.items() if layer < 0}
        above = {layer: n for layer, n in self._places.items() if layer > 0}
        return Ground(*self._widest(below), *self._widest(above))

    def _widest(self, places: dict[int, int]) -> tuple[float, float]:
        """Return height, m, and share of the layer that is seen at most places."""
        if not places:
            return 0.0, 0.0
        layer = max(sorted(places), key=lambda layer: places[layer])
        return (layer + 0.5) * _LAYER_M, places[layer] / self._all
