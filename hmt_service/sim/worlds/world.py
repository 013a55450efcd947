"""A simulated world: what a sensor can see there, and where the robot drives.

The world frame has z pointing up; x points east, y north. Lengths in m.

References:
    own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One world drawn from a family."""

    name: str
    """Family and the seed that it was drawn from."""
    vertices: npt.NDArray[np.float32]
    """Corners of the mesh in the world frame, shape (V, 3), m."""
    triangles: npt.NDArray[np.uint32]
    """Rows of `vertices` that span each triangle, shape (T, 3)."""
    route_m: FloatArray
    """Waypoints on the ground, shape (W, 3), m; straight lines between them are free."""
