"""The one place that knows Open3D: rays and distances in a triangle mesh.

Importing it takes seconds, so only what simulates may do so.

References:
    own; Open3D's `t.geometry.RaycastingScene` (Embree).
"""

from __future__ import annotations

import numpy as np

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


class RayCaster:
    """A world that can be asked what lies in a direction, and how near anything is."""

    def __init__(self, world: World) -> None:
        """Build the search structure over the mesh of `world`."""
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(world.vertices), o3d.core.Tensor.from_numpy(world.triangles)
        )

    def ranges(self, origin_m: FloatArray, directions: FloatArray) -> FloatArray:
        """Return how far the first surface is along each ray.

        Args:
            origin_m: Common start of the rays in the world frame, shape (3,), m.
            directions: Unit vectors in the world frame, shape (N, 3).

        Returns:
            Distances, shape (N,), m; infinite where there is nothing.
        """
        rays = np.hstack([np.broadcast_to(origin_m, directions.shape), directions])
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays.astype(np.float32)))
        return np.asarray(hits["t_hit"].numpy(), dtype=np.float64)

    def clearances(self, points_m: FloatArray) -> FloatArray:
        """Return how far the nearest surface is from each point.

        Args:
            points_m: Points in the world frame, shape (N, 3), m.

        Returns:
            Distances, shape (N,), m.
        """
        points = o3d.core.Tensor.from_numpy(points_m.astype(np.float32))
        return np.asarray(self._scene.compute_distance(points).numpy(), dtype=np.float64)
