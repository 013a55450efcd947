"""The one place that knows Open3D: rays and distances in a triangle mesh.

Importing it takes seconds, so only what simulates may do so.

References:
    own; Open3D's `t.geometry.RaycastingScene` (Embree).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.errors import Unavailable
from hmt_service.sim.worlds.world import World

try:
    import open3d as o3d
except (ImportError, OSError) as error:
    raise Unavailable(
        f"simulated worlds need Open3D, which does not load: {error} "
        "(its system libraries on Debian are libusb-1.0-0, libgl1, libgomp1, libx11-6)"
    ) from error


@dataclass(frozen=True, slots=True, eq=False)
class Fans:
    """Rays in fans: those of a fan start at one point and spread over a half-plane.

    A column of a LiDAR is a fan; a single ray is a fan with one elevation of zero.
    """

    origins_m: FloatArray
    """Where each fan starts in the world frame, shape (M, 3)."""
    forward: FloatArray
    """Unit vector of elevation zero in the world frame, shape (M, 3)."""
    up: FloatArray
    """Unit vector of elevation 90 degrees in the world frame, shape (M, 3)."""
    elevations_rad: FloatArray
    """Elevations that every fan has a ray at, shape (R,)."""


class RayCaster:
    """A world that can be asked what lies in a direction, and how near anything is."""

    def __init__(self, world: World) -> None:
        """Build the search structure over the mesh of `world`."""
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(world.vertices), o3d.core.Tensor.from_numpy(world.triangles)
        )

    def ranges(self, fans: Fans) -> npt.NDArray[np.float32]:
        """Return how far the first surface is along each ray, shape (M, R), m; infinite: none."""
        rays = _rays(fans)
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
        return np.asarray(hits["t_hit"].numpy())

    def sees(self, viewer_m: FloatArray, points_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Return whether there is nothing between a viewer, shape (3,), and points, (N, 3) m."""
        ways = points_m - viewer_m
        distances = np.linalg.norm(ways, axis=1)
        forward = ways / np.maximum(distances, _SAME_POINT_M)[:, None]
        fans = Fans(
            np.broadcast_to(viewer_m, ways.shape), forward, np.zeros_like(forward), np.zeros(1)
        )
        return np.asarray(self.ranges(fans)[:, 0] >= distances)

    def clearances(self, points_m: FloatArray) -> FloatArray:
        """Return how far the nearest surface is from each point.

        Args:
            points_m: Points in the world frame, shape (N, 3), m.

        Returns:
            Distances, shape (N,), m.
        """
        points = o3d.core.Tensor.from_numpy(points_m.astype(np.float32))
        return np.asarray(self._scene.compute_distance(points).numpy(), dtype=np.float64)


def _rays(fans: Fans) -> npt.NDArray[np.float32]:
    """Return the rays as Open3D wants them, origin and direction: shape (M, R, 6)."""
    rows = len(fans.elevations_rad)
    parts = np.hstack([fans.origins_m, fans.forward, fans.up]).astype(np.float32)
    # One product writes all rays at once; to fill them in part by part costs as much as the rays.
    mix = np.zeros((3, 3, rows, 2, 3), dtype=np.float32)
    axes = np.arange(3)
    mix[0, axes, :, 0, axes] = 1.0
    mix[1, axes, :, 1, axes] = np.cos(fans.elevations_rad)
    mix[2, axes, :, 1, axes] = np.sin(fans.elevations_rad)
    return (parts @ mix.reshape(9, rows * 6)).reshape(-1, rows, 6)


_SAME_POINT_M = 1e-9
