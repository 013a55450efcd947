"""The one place that knows Open3D: rays and distances in a triangle mesh.

Importing it takes seconds, so only what simulates may do so.

References:
    own; Open3D's `t.geometry.RaycastingScene` (Embree).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

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


_SAME_POINT_M = 1e-9
_LEAST_TILE_M = 64.0
# A robot at a corner goes to and fro between so many.
_TILES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Fans:
    """The rays of S sweeps of C fans each: a fan starts at one point and spreads over a half-plane.

    A column of a LiDAR is a fan; a single ray is a fan of one elevation, zero. Where all fans of a
    sweep start together, P is 1, else P is C.
    """

    origins_m: FloatArray
    """Where the fans start in the world frame, shape (S, P, 3)."""
    up: FloatArray
    """Unit vectors of elevation 90 degrees in the world frame, shape (S, P, 3)."""
    forward: FloatArray
    """Unit vectors of elevation zero in the world frame, shape (S, C, 3)."""
    elevations_rad: FloatArray
    """Elevations that every fan has a ray at, shape (R,)."""

    def take(self, sweeps: npt.NDArray[np.intp]) -> Fans:
        """Return some of the sweeps."""
        origins_m, up, forward = (each[sweeps] for each in (self.origins_m, self.up, self.forward))
        return Fans(origins_m, up, forward, self.elevations_rad)


class RayCaster:
    """A world that can be asked what lies in a direction, and how near anything is.

    Of a large world only the surroundings of where it is asked are held ready.
    """

    def __init__(
        self, world: World, reach_m: float = math.inf, *, whole_triangles: int = 200_000
    ) -> None:
        """Take the mesh of a world.

        Args:
            world: The world.
            reach_m: Surfaces farther away are of no interest, > 0.
            whole_triangles: A mesh of no more triangles is held ready as a whole.
        """
        self._reach_m = reach_m
        self._mesh = _Mesh(world)
        is_whole = math.isinf(reach_m) or len(world.triangles) <= whole_triangles
        self._tile_m = math.inf if is_whole else max(_LEAST_TILE_M, 2.0 * reach_m)
        self._tile = lru_cache(_TILES)(self._build)

    def ranges(self, fans: Fans) -> npt.NDArray[np.float32]:
        """Return how far the first surface is along each ray, shape (S, C, R), m.

        Infinite where there is none within reach.
        """
        tiles = list(self._tiles(fans.origins_m))
        ranges = tiles[0][0].ranges(fans)
        for tile, is_on in tiles[1:]:
            sweeps = np.flatnonzero(is_on.any(axis=1))
            cast = tile.ranges(fans.take(sweeps))
            ranges[sweeps] = np.where(is_on[sweeps, :, None], cast, ranges[sweeps])
        ranges[ranges > self._reach_m] = np.inf
        return ranges

    def sees(self, viewer_m: FloatArray, points_m: FloatArray) -> npt.NDArray[np.bool_]:
        """Return whether nothing is between a viewer and points within reach, shape (N,).

        Args:
            viewer_m: Where to look from, shape (3,), m.
            points_m: Where to look at, shape (N, 3), m.
        """
        ways = points_m - viewer_m
        distances = np.linalg.norm(ways, axis=1)
        forward = ways / np.maximum(distances, _SAME_POINT_M)[:, None]
        fans = Fans(viewer_m[None, None], np.zeros((1, 1, 3)), forward[None], np.zeros(1))
        return np.asarray(self.ranges(fans)[0, :, 0] >= distances)

    def clearances(self, points_m: FloatArray) -> FloatArray:
        """Return how far the nearest surface is from each point.

        Args:
            points_m: Points in the world frame, shape (N, 3), m.

        Returns:
            Distances, shape (N,), m; infinite where there is none within reach.
        """
        distances = np.empty(len(points_m))
        for tile, rows in self._tiles(points_m):
            distances[rows] = tile.distances(points_m[rows])
        distances[distances > self._reach_m] = math.inf
        return distances

    def _tiles(self, points_m: FloatArray) -> Iterator[tuple[_Tile, npt.NDArray[np.bool_]]]:
        """Yield each tile that points, shape (..., 3), lie on, and which these are, shape (...)."""
        if math.isinf(self._tile_m):
            yield self._tile(0, 0), np.ones(points_m.shape[:-1], dtype=np.bool_)
            return
        cells = np.floor(points_m[..., :2] / self._tile_m).astype(np.int64)
        for x, y in np.unique(cells.reshape(-1, 2), axis=0).tolist():
            yield self._tile(x, y), np.all(cells == (x, y), axis=-1)

    def _build(self, x: int, y: int) -> _Tile:
        """Return a tile with all that is within reach of any point on it."""
        if math.isinf(self._tile_m):
            return _Tile(self._mesh.vertices, self._mesh.triangles)
        corner = self._tile_m * np.array([x, y])
        return _Tile(
            *self._mesh.within(corner - self._reach_m, corner + self._tile_m + self._reach_m)
        )


class _Mesh:
    """The mesh of a world, which can be cut."""

    def __init__(self, world: World) -> None:
        self.vertices = world.vertices
        self.triangles = world.triangles

    def within(
        self, low_m: FloatArray, high_m: FloatArray
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
        """Return vertices and triangles of all that may reach into a rectangle, from above."""
        low, high = self._bounds
        near = np.flatnonzero((high[0] >= low_m[0]) & (low[0] <= high_m[0]))
        near = near[(high[1, near] >= low_m[1]) & (low[1, near] <= high_m[1])]
        # Corners are repeated rather than renumbered: that would take longer than all the rest.
        corners = self.vertices[self.triangles[near].ravel()]
        return corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)

    @cached_property
    def _bounds(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Least and greatest x and y of each triangle, shape (2, T) each."""
        level = np.ascontiguousarray(self.vertices[:, :2].T)
        corners = [level[:, self.triangles[:, corner]] for corner in range(3)]
        return np.minimum.reduce(corners), np.maximum.reduce(corners)


class _Tile:
    """A piece of a mesh in Open3D's search structure."""

    def __init__(
        self, vertices: npt.NDArray[np.float32], triangles: npt.NDArray[np.uint32]
    ) -> None:
        self._scene = o3d.t.geometry.RaycastingScene()
        if len(triangles):
            self._scene.add_triangles(
                o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(triangles)
            )

    def ranges(self, fans: Fans) -> npt.NDArray[np.float32]:
        """Return how far the first surface is along each ray, shape (S, C, R), m."""
        hits = self._scene.cast_rays(o3d.core.Tensor.from_numpy(_rays(fans)))
        return np.asarray(hits["t_hit"].numpy())

    def distances(self, points_m: FloatArray) -> npt.NDArray[np.float32]:
        """Return how far the nearest surface is from each point, shape (N,), m."""
        points = o3d.core.Tensor.from_numpy(points_m.astype(np.float32))
        return np.asarray(self._scene.compute_distance(points).numpy())


def _rays(fans: Fans) -> npt.NDArray[np.float32]:
    """Return the rays as Open3D wants them, origin and direction: shape (S, C, R, 6)."""
    elevations = fans.elevations_rad.astype(np.float32)
    level, rise = np.cos(elevations), np.sin(elevations)
    forward, up = fans.forward.astype(np.float32), fans.up.astype(np.float32)
    rays = np.empty((*forward.shape[:2], len(elevations), 6), dtype=np.float32)
    for axis in range(3):
        rays[..., axis] = fans.origins_m[..., axis, None]
        np.add(forward[..., axis, None] * level, up[..., axis, None] * rise, rays[..., 3 + axis])
    return rays
