"""Registration of points into a local map: KISS-ICP's parts, and the information of a match.

References:
    Vizzo et al., KISS-ICP, RA-L 2023, sections III-C to III-E (voxel map, robust ICP).
    Censi, An accurate closed-form estimate of ICP's covariance, ICRA 2007 (information).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from kiss_icp.pybind import kiss_icp_pybind
from scipy.spatial import KDTree

from hmt_service.core.geometry import (
    PLANAR_AXES,
    FloatArray,
    Pose,
    project_planar,
    symmetric,
    transform_points,
)
from hmt_service.core.types import Points

_MAX_ITERATIONS = 100
_CONVERGENCE = 1e-4
_NORMAL_NEIGHBOURS = 8
# A neighbourhood thicker than this share of its width has no surface to speak of.
_MAX_FLATNESS = 0.25
_UNBOUNDED_M = 1e9
# A direction opposed by less than this share of what opposes the best-known one is degenerate.
_DEGENERATE_SHARE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """How a cloud fits a map at some pose."""

    information: FloatArray
    """Point-to-plane information for unit residual variance (m^2), tangent order, shape (6, 6)."""
    inlier_share: float
    """Share of the cloud within the inlier distance of the map, in [0, 1]."""


def voxel_downsample(points: FloatArray | Points, voxel_m: float) -> FloatArray:
    """Return one original point per occupied voxel, shape (M, 3), M <= N."""
    vectors = kiss_icp_pybind._Vector3dVector(np.asarray(points, dtype=np.float64))
    return np.asarray(kiss_icp_pybind._voxel_down_sample(vectors, voxel_m))


class RegistrationMap:
    """Points to register against: a voxel map for ICP and a KD-tree for the information."""

    def __init__(
        self, points: FloatArray | Points, *, voxel_m: float, points_per_voxel: int, is_planar: bool
    ) -> None:
        """Index the points.

        Args:
            points: Points in the map's frame, shape (N, 3), m, N >= 1.
            voxel_m: Edge of a voxel.
            points_per_voxel: Most points kept in one.
            is_planar: Whether all poses are planar and surfaces vertical.
        """
        self._voxels = kiss_icp_pybind._VoxelHashMap(voxel_m, _UNBOUNDED_M, points_per_voxel)
        self._voxels._add_points(
            kiss_icp_pybind._Vector3dVector(np.asarray(points, dtype=np.float64))
        )
        self._is_planar = is_planar
        self._registration = kiss_icp_pybind._Registration(_MAX_ITERATIONS, _CONVERGENCE, 1)
        # The voxel map's own order depends on hashing only, which is the same in every run.
        self._tree = KDTree(np.asarray(self._voxels._point_cloud()))

    def register(
        self, points: FloatArray, guess: Pose, *, max_correspondence_m: float, kernel_m: float
    ) -> Pose | None:
        """Return the pose of the cloud in the map by robust point-to-point ICP.

        Args:
            points: Cloud, shape (N, 3), m.
            guess: Where to start, shape (4, 4).
            max_correspondence_m: Farthest pair that counts.
            kernel_m: Scale of the robust kernel.

        Returns:
            The pose, planar for a planar map; None when the iteration left the numbers.
        """
        pose = self._registration._align_points_to_map(
            points=kiss_icp_pybind._Vector3dVector(points),
            voxel_map=self._voxels,
            initial_guess=guess,
            max_correspondance_distance=max_correspondence_m,
            kernel=kernel_m,
        )
        if not np.all(np.isfinite(pose)):
            return None
        return project_planar(pose) if self._is_planar else np.asarray(pose)

    def match(self, points: FloatArray, map_from_points: Pose, *, inlier_m: float) -> Match:
        """Return what the fit at a pose says about that pose.

        The information is that of point-to-plane residuals against the surface around each matched
        point: unlike ICP's own point-to-point one it vanishes along a corridor, as it should.
        """
        moved = transform_points(map_from_points, points)
        neighbours = min(_NORMAL_NEIGHBOURS, self._tree.n)
        found = self._tree.query(moved, k=neighbours)
        distances, indices = (np.asarray(each).reshape(-1, neighbours) for each in found)
        is_inlier = distances[:, 0] <= inlier_m
        share = float(np.mean(is_inlier)) if len(moved) else 0.0
        normals, is_surface = self._normals(indices[is_inlier])
        normals_in_points = normals @ map_from_points[:3, :3]
        sources = points[is_inlier]
        rows = np.hstack([np.cross(sources, normals_in_points), normals_in_points])[is_surface]
        information = _without_degenerate_directions(symmetric(rows.T @ rows))
        return Match(information, share)

    def _normals(self, indices: np.ndarray) -> tuple[FloatArray, np.ndarray]:
        """Return unit normals, shape (N, 3), and whether there is a surface, shape (N,)."""
        if not len(indices):
            return np.zeros((0, 3)), np.zeros(0, dtype=bool)
        neighbourhoods = np.asarray(self._tree.data)[indices]
        if self._is_planar:
            neighbourhoods = neighbourhoods[..., :2]
        centred = neighbourhoods - neighbourhoods.mean(axis=1, keepdims=True)
        scatter = np.einsum("nki,nkj->nij", centred, centred)
        values, vectors = np.linalg.eigh(scatter)
        normals = np.zeros((len(indices), 3))
        normals[:, : vectors.shape[1]] = vectors[..., 0]
        is_surface = (values[:, 0] <= _MAX_FLATNESS**2 * values[:, 1]) & (values[:, 1] > 0.0)
        return normals, is_surface


def _without_degenerate_directions(information: FloatArray) -> FloatArray:
    """Return the information without that of translations which almost no surface opposes.

    Along a corridor only clutter and bad normals oppose a translation; what they say is not noise
    of zero mean, and to average it would make the robot slip with great confidence.
    """
    values, vectors = np.linalg.eigh(information[3:, 3:])
    seen = vectors[:, values >= _DEGENERATE_SHARE * values[-1]]
    keep = np.eye(6)
    keep[3:, 3:] = seen @ seen.T
    return symmetric(keep @ information @ keep)


def covariance_of(information: FloatArray, *, sigma_m: float, is_planar: bool) -> FloatArray:
    """Return the covariance of a match, wide where the match says nothing.

    Args:
        information: Information for unit residual variance, shape (6, 6).
        sigma_m: Standard deviation of one residual.
        is_planar: Whether only yaw, x and y are estimated.

    Returns:
        Covariance, shape (6, 6); 10 m and 10 rad standard deviation along unseen directions.
    """
    weak = np.eye(6) * 1e-2
    result = np.zeros((6, 6))
    axes = PLANAR_AXES if is_planar else np.arange(6)
    block = np.ix_(axes, axes)
    result[block] = np.linalg.inv(information[block] / sigma_m**2 + weak[block])
    return symmetric(result)
