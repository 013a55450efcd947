"""Ground that is not flat, level where buildings need it, and what stands on it.

References:
    own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.plan import Box, Mesh, placed

_WAVES = 4
_WAVE_LENGTHS_M = (260.0, 420.0)
_CELL_M = 2.5
_RASTER_M = 0.5
_BLEND_M = 40.0
"""From the edge of level ground to where the hills are as they would be without it."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """A rectangle on the ground that may be turned."""

    x: float
    """Of its middle, m."""
    y: float
    """Of its middle, m."""
    length: float
    """Along its own x axis, m."""
    width: float
    """Along its own y axis, m."""
    yaw_rad: float = 0.0
    """Of its x axis."""

    def from_world(self, points: FloatArray) -> FloatArray:
        """Return points, shape (..., 2), as seen from its middle."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.asarray((points - (self.x, self.y)) @ np.array([[cos, -sin], [sin, cos]]))

    def to_world(self, points: FloatArray) -> FloatArray:
        """Return points, shape (..., 2), that are seen from its middle."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]) + (self.x, self.y))


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """Hills made of waves."""

    amplitudes: FloatArray
    """Of each wave, shape (K,), m."""
    waves_rad_per_m: FloatArray
    """Direction and length of each wave, shape (K, 2)."""
    phases_rad: FloatArray
    """Shape (K,)."""
    level: Sequence[Footprint] = ()
    """Where the ground is level, farther apart than the blending."""

    @classmethod
    def drawn(
        cls, relief_m: float, level: Sequence[Footprint], rng: np.random.Generator
    ) -> Terrain:
        """Draw hills that rise and fall by at most `relief_m`."""
        angles, phases = rng.uniform(0.0, math.tau, (2, _WAVES))
        numbers = math.tau / rng.uniform(*_WAVE_LENGTHS_M, _WAVES)
        shares = rng.uniform(0.5, 1.0, _WAVES)
        waves = numbers[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        return cls(relief_m * shares / shares.sum(), waves, phases, level)

    def heights(self, points: FloatArray) -> FloatArray:
        """Return the height of the ground at points, shape (..., 2), m."""
        heights = self._hills(points)
        for place in self.level:
            half = np.array([place.length, place.width]) / 2
            beyond = np.maximum(np.abs(place.from_world(points)) - half, 0.0)
            nearness = np.clip(1.0 - np.linalg.norm(beyond, axis=-1) / _BLEND_M, 0.0, 1.0)
            share = nearness**2 * (3.0 - 2.0 * nearness)
            heights += share * (self._hills(np.array([place.x, place.y])) - heights)
        return heights

    def mesh(self, area: Box) -> Mesh:
        """Return the ground of an area."""
        xs = np.arange(area.x_min, area.x_max + _CELL_M, _CELL_M)
        ys = np.arange(area.y_min, area.y_max + _CELL_M, _CELL_M)
        points = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
        vertices = np.concatenate([points, self.heights(points)[..., None]], axis=-1)
        number = np.arange(len(xs) * len(ys)).reshape(len(xs), len(ys))
        a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
        triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
        return Mesh(vertices.reshape(-1, 3).astype(np.float32), triangles.astype(np.uint32))

    def _hills(self, points: FloatArray) -> FloatArray:
        """Return the height of the hills alone."""
        phases = points @ self.waves_rad_per_m.T + self.phases_rad
        return np.asarray(np.sin(phases) @ self.amplitudes)


class Site:
    """Ground, what stands on it, and where nothing stands yet."""

    def __init__(self, area: Box, terrain: Terrain) -> None:
        self.terrain = terrain
        self.area = area
        self.meshes = [terrain.mesh(area)]
        shape = (
            math.ceil((area.x_max - area.x_min) / _RASTER_M),
            math.ceil((area.y_max - area.y_min) / _RASTER_M),
        )
        self._is_taken = np.zeros(shape, dtype=bool)

    def take(self, place: Footprint) -> None:
        """Let nothing else stand here."""
        self._is_taken[self._cells(place)] = True

    def add(self, mesh: Mesh, place: Footprint) -> bool:
        """Let something stand here, its origin on the ground in the middle of its footprint.

        Returns:
            Whether there was room.
        """
        if self._is_taken[self._cells(place)].any():
            return False
        self.take(place)
        z = float(self.terrain.heights(np.array([place.x, place.y])))
        self.meshes.append(placed(mesh, place.x, place.y, z, place.yaw_rad))
        return True

    def somewhere(self, length: float, width: float, rng: np.random.Generator) -> Footprint:
        """Draw a place that lies inside the area, roughly along x or y."""
        reach = math.hypot(length, width) / 2 + _RASTER_M
        x = rng.uniform(self.area.x_min + reach, self.area.x_max - reach)
        y = rng.uniform(self.area.y_min + reach, self.area.y_max - reach)
        yaw = rng.integers(2) * math.pi / 2 + rng.normal(0.0, 0.07)
        return Footprint(x, y, length, width, yaw)

    def _cells(self, place: Footprint) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the cells under a footprint, which lies inside the area."""
        along, across = (
            size * np.linspace(-0.5, 0.5, 2 + math.ceil(size / (0.7 * _RASTER_M)))
            for size in (place.length, place.width)
        )
        cos, sin = math.cos(place.yaw_rad), math.sin(place.yaw_rad)
        x = np.add.outer(cos * along, place.x - self.area.x_min - sin * across)
        y = np.add.outer(sin * along, place.y - self.area.y_min + cos * across)
        return (x / _RASTER_M).astype(np.int64), (y / _RASTER_M).astype(np.int64)
