"""Observation model p(z | x, submap): a scan against a submap, and the background density.

References:
    Thrun, Burgard, Fox, Probabilistic Robotics, 2005, section 6.3 (beam mixture).
    Cummins and Newman, FAB-MAP, IJRR 2008 (the alternative to a match is learned, not uniform).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_service.core.config import ObservationConfig, SensorConfig
from hmt_service.core.geometry import FloatArray, Pose, inverse, transform_points
from hmt_service.core.local_map import SeenPoints
from hmt_service.core.types import Keyframe

_BIN_M = 0.25
# If this share of the beams is into known space, they say as much as all would.
_COVERED = 0.5


class BackgroundDensity:
    """p0(z): the learned density of one range when nothing is known of the place."""

    def __init__(self, max_range_m: float) -> None:
        """Start uniform, worth one reading per bin.

        Args:
            max_range_m: Longest range of the sensor.
        """
        self._counts = np.ones(int(np.ceil(max_range_m / _BIN_M)))

    def learn(self, ranges: FloatArray) -> None:
        """Count ranges, shape (N,), m."""
        np.add.at(self._counts, self._bins(ranges), 1.0)

    def density(self, ranges: FloatArray) -> FloatArray:
        """Return p0 at each range, shape (N,), 1/m."""
        return np.asarray(self._counts[self._bins(ranges)] / (self._counts.sum() * _BIN_M))

    def _bins(self, ranges: FloatArray) -> np.ndarray:
        return np.clip((ranges / _BIN_M).astype(np.int64), 0, len(self._counts) - 1)


@dataclass(frozen=True, slots=True)
class Look:
    """What one keyframe says for a place."""

    log_ratio: float
    """log p(z | x, submap) - log p0(z)."""
    covered: float
    """How much could be said: the rest of what was seen there is not known of the place."""


class ObservationModel:
    """Likelihood ratio of scans: a known place against the background."""

    def __init__(self, config: ObservationConfig, sensor: SensorConfig) -> None:
        """Build the model.

        Args:
            config: Settings of this stage.
            sensor: What the range sensor can see.
        """
        self._config = config
        self._is_planar = sensor.is_planar
        self._columns = int(np.ceil(2.0 * np.pi / config.angular_resolution_rad))
        self._rows = 1 if sensor.is_planar else int(np.ceil(np.pi / config.angular_resolution_rad))
        self.background = BackgroundDensity(sensor.max_range_m)

    def learn(self, keyframe: Keyframe) -> None:
        """Let the background density see one keyframe."""
        self.background.learn(_ranges(keyframe.points_in_body - keyframe.sensor_in_body))

    def log_ratio(self, keyframe: Keyframe, submap: SeenPoints, submap_from_body: Pose) -> float:
        """Return log p(z | x, submap) - log p0(z) of one keyframe; see `look`."""
        return self.look(keyframe, submap, submap_from_body).log_ratio

    def look(self, keyframe: Keyframe, submap: SeenPoints, submap_from_body: Pose) -> Look:
        """Return what one keyframe says for a place, tempered for correlated beams.

        Beams into space that the submap does not know say nothing: there, both follow p0. The
        others say what all would, if they are many: how much of a place was seen through a door is
        no difference between two rooms.

        Args:
            keyframe: The observation.
            submap: What is known to be there.
            submap_from_body: Pose of the keyframe in the submap's frame.
        """
        rays = keyframe.points_in_body - keyframe.sensor_in_body
        if not len(rays):
            return Look(0.0, 1.0)
        ranges = _ranges(rays)
        predicted = transform_points(inverse(submap_from_body), submap.points)
        predicted -= keyframe.sensor_in_body
        directions = submap.directions @ submap_from_body[:3, :3]
        expected = self._expectations(predicted, directions, rays)
        is_known = np.isfinite(expected[1])
        if not np.any(is_known):
            return Look(0.0, 0.0)
        density = self._hit_density(ranges[is_known], expected[:, is_known])
        hit = self._config.hit_weight
        ratio = np.log(hit * density / self.background.density(ranges[is_known]) + (1.0 - hit))
        covered = min(1.0, float(np.mean(is_known)) / _COVERED)
        beams = min(len(rays), self._config.independent_beams)
        return Look(float(ratio.mean() * covered * beams), covered)

    def _hit_density(self, ranges: FloatArray, expected: FloatArray) -> FloatArray:
        """Return the density of each range, shape (N,), 1/m: the mean over its expectations."""
        sigma = self._config.hit_sigma_m
        is_there = np.isfinite(expected)
        residual = np.where(is_there, expected - ranges, 0.0) / sigma
        densities = np.exp(-0.5 * residual**2) / (np.sqrt(2.0 * np.pi) * sigma)
        return np.asarray((densities * is_there).sum(axis=0) / is_there.sum(axis=0))

    def _expectations(
        self, predicted: FloatArray, directions: FloatArray, rays: FloatArray
    ) -> FloatArray:
        """Return three expected ranges per beam, shape (3, N), inf where the submap has nothing.

        They are those of the beam's own cell (the second) and of its two neighbours: on a wall seen
        at a grazing angle one cell spans metres of range, and any of them may be the one to come.
        Where the first surface is one whose other side was seen, nobody knows how thick it is.
        """
        cells, ranges = self._cells(predicted), _ranges(predicted)
        grid = np.full(self._rows * self._columns, np.inf)
        np.minimum.at(grid, cells, ranges)
        is_behind = np.einsum("ni,ni->n", directions, predicted) > 0.0
        behind = np.full(len(grid), np.inf)
        np.minimum.at(behind, cells[is_behind], ranges[is_behind])
        grid[behind <= grid] = np.inf
        row, column = np.divmod(self._cells(rays), self._columns)
        return np.stack(
            [grid[row * self._columns + (column + step) % self._columns] for step in (-1, 0, 1)]
        )

    def _cells(self, rays: FloatArray) -> np.ndarray:
        azimuth = np.arctan2(rays[:, 1], rays[:, 0]) + np.pi
        column = np.minimum(
            (azimuth / (2.0 * np.pi) * self._columns).astype(int), self._columns - 1
        )
        if self._is_planar:
            return np.asarray(column)
        elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])) + 0.5 * np.pi
        row = np.minimum((elevation / np.pi * self._rows).astype(int), self._rows - 1)
        return np.asarray(row * self._columns + column)


def _ranges(rays: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(rays, axis=1))
