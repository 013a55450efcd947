"""Floor plans: upright boxes for walls and furniture, and the mesh that they make.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

WALL_M = 0.15
"""Thickness of a wall."""
CEILING_M = 2.5
"""Height of a storey."""
SLAB_M = 0.25
"""Thickness of a floor or ceiling."""


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box on the ground, all in m."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    height: float = CEILING_M
    base: float = 0.0
    """Height of its underside above the origin."""

    def overlaps(self, other: Box) -> bool:
        """Return whether the two share ground."""
        return (
            self.x_min < other.x_max
            and other.x_min < self.x_max
            and self.y_min < other.y_max
            and other.y_min < self.y_max
        )


def wall_along_x(x_min: float, x_max: float, y: float) -> Box:
    """Return a wall that runs along x, its middle at y."""
    half = WALL_M / 2
    return Box(x_min, y - half, x_max, y + half)


def wall_along_y(x: float, y_min: float, y_max: float) -> Box:
    """Return a wall that runs along y, its middle at x."""
    half = WALL_M / 2
    return Box(x - half, y_min - half, x + half, y_max + half)


def floor(area: Box, z: float = 0.0) -> Box:
    """Return a slab under an area, its upper side at z."""
    return Box(area.x_min, area.y_min, area.x_max, area.y_max, SLAB_M, z - SLAB_M)


def ceiling(area: Box, z: float = CEILING_M) -> Box:
    """Return a slab over an area, its underside at z."""
    return Box(area.x_min, area.y_min, area.x_max, area.y_max, SLAB_M, z)


# A unit box: bit 0 of a corner's number is x, bit 1 is y, bit 2 is z.
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)], dtype=np.float64)
_QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
_FACES = np.array([face for a, b, c, d in _QUADS for face in ((a, b, c), (a, c, d))])


def mesh_of(
    boxes: Sequence[Box],
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Return the vertices, shape (8 B, 3), and triangles, shape (12 B, 3), of B boxes."""
    low = np.array([(box.x_min, box.y_min, box.base) for box in boxes])
    high = np.array([(box.x_max, box.y_max, box.base + box.height) for box in boxes])
    vertices = low[:, None] + _CORNERS * (high - low)[:, None]
    triangles = _FACES + 8 * np.arange(len(boxes))[:, None, None]
    return vertices.reshape(-1, 3).astype(np.float32), triangles.reshape(-1, 3).astype(np.uint32)
