"""Rigid transforms in SE(3) as 4x4 matrices, and Gaussians over them.

A transform `a_from_b` maps points of frame b into frame a; names compose so that the inner ones
cancel: `a_from_c = a_from_b @ b_from_c`. Tangent vectors are `[rotation, translation]` (GTSAM's
order), angles in rad and lengths in m; perturbations act on the right: `pose @ exp(xi)`.

References:
    Blanco et al. 2008, Eq. (10) (product of Gaussians), Eq. (15) (composition).
    Barfoot, State Estimation for Robotics, 2017, sections 7.1 and 7.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.errors import InvalidInput

FloatArray = npt.NDArray[np.float64]
Pose = npt.NDArray[np.float64]
"""A rigid transform, shape (4, 4)."""

PLANAR_AXES = np.array([2, 3, 4])
"""Tangent components that a planar robot can move along: yaw, x, y."""
_OFF_PLANE_AXES = np.array([0, 1, 5])
_SMALL_ANGLE_RAD = 1e-7
ANY_HEADING_RAD = np.pi / np.sqrt(3.0)
"""Standard deviation of a heading that may be anything."""


def identity() -> Pose:
    """Return the transform that changes nothing, shape (4, 4)."""
    return np.eye(4)


def planar_pose(x_m: float, y_m: float, yaw_rad: float) -> Pose:
    """Return the planar transform with this translation (m) and heading (rad), shape (4, 4)."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    pose = np.eye(4)
    pose[0, :2] = c, -s
    pose[1, :2] = s, c
    pose[:2, 3] = x_m, y_m
    return pose


def yaw_of(pose: Pose) -> float:
    """Return the heading about z, rad in (-pi, pi]."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def project_planar(pose: Pose) -> Pose:
    """Return the planar transform with the same x, y and heading as `pose`."""
    return planar_pose(float(pose[0, 3]), float(pose[1, 3]), yaw_of(pose))


def inverse(pose: Pose) -> Pose:
    """Return `b_from_a` of `a_from_b`."""
    rotation = pose[:3, :3]
    result = np.eye(4)
    result[:3, :3] = rotation.T
    result[:3, 3] = -rotation.T @ pose[:3, 3]
    return result


def transform_points(a_from_b: Pose, points_in_b: npt.NDArray[np.floating]) -> FloatArray:
    """Return the points, shape (N, 3), expressed in frame a."""
    return np.asarray(points_in_b @ a_from_b[:3, :3].T + a_from_b[:3, 3], dtype=np.float64)


def skew(v: FloatArray) -> FloatArray:
    """Return the cross-product matrices of vectors, shape (..., 3) -> (..., 3, 3)."""
    result = np.zeros((*v.shape[:-1], 3, 3))
    result[..., 0, 1], result[..., 0, 2] = -v[..., 2], v[..., 1]
    result[..., 1, 0], result[..., 1, 2] = v[..., 2], -v[..., 0]
    result[..., 2, 0], result[..., 2, 1] = -v[..., 1], v[..., 0]
    return result


def exp(xi: FloatArray) -> FloatArray:
    """Return the transforms of tangent vectors, shape (..., 6) -> (..., 4, 4)."""
    xi = np.asarray(xi, dtype=np.float64)
    phi, rho = xi[..., :3], xi[..., 3:]
    angle = np.linalg.norm(phi, axis=-1)[..., None, None]
    safe = np.where(angle < _SMALL_ANGLE_RAD, 1.0, angle)
    is_small = angle < _SMALL_ANGLE_RAD
    a = np.where(is_small, 1.0, np.sin(safe) / safe)
    b = np.where(is_small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    c = np.where(is_small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    k = skew(phi)
    kk = k @ k
    result = np.zeros((*xi.shape[:-1], 4, 4))
    result[..., :3, :3] = np.eye(3) + a * k + b * kk
    result[..., :3, 3] = ((np.eye(3) + b * k + c * kk) @ rho[..., None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def log(pose: FloatArray) -> FloatArray:
    """Return the tangent vectors of transforms, shape (..., 4, 4) -> (..., 6); angles below pi."""
    quaternion = quaternion_of(pose)
    vector, scalar = quaternion[..., :3], quaternion[..., 3:]
    half_sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    is_small = half_sine < _SMALL_ANGLE_RAD
    angle = 2.0 * np.arctan2(half_sine, scalar)
    phi = vector * np.where(is_small, 2.0, angle / np.where(is_small, 1.0, half_sine))
    is_small, safe = is_small[..., None], np.where(is_small, 1.0, angle)[..., None]
    b = np.where(is_small, 1.0 / 12.0, (1.0 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    k = skew(phi)
    inverse_jacobian = np.eye(3) - 0.5 * k + b * (k @ k)
    rho = (inverse_jacobian @ pose[..., :3, 3, None])[..., 0]
    return np.concatenate([phi, rho], axis=-1)


def apart(first: Pose, second: Pose) -> tuple[float, float]:
    """Return how far two poses are from each other, m and rad: lengths of the parts of the log."""
    xi = log(inverse(first) @ second)
    return float(np.linalg.norm(xi[3:])), float(np.linalg.norm(xi[:3]))


def quaternion_of(pose: FloatArray) -> FloatArray:
    """Return rotations as unit quaternions `[x, y, z, w]`, w >= 0: (..., 4, 4) -> (..., 4)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(pose[..., :3, :3], (-2, -1), (0, 1))
    trace = xx + yy + zz
    # Shepperd's method: of four equal formulae, take the one that divides by the largest component.
    formulae = np.empty((*trace.shape, 4, 4))
    formulae[..., 0, 0] = 1.0 - trace + 2.0 * xx
    formulae[..., 1, 1] = 1.0 - trace + 2.0 * yy
    formulae[..., 2, 2] = 1.0 - trace + 2.0 * zz
    formulae[..., 3, 3] = 1.0 + trace
    formulae[..., 0, 1] = formulae[..., 1, 0] = yx + xy
    formulae[..., 0, 2] = formulae[..., 2, 0] = zx + xz
    formulae[..., 0, 3] = formulae[..., 3, 0] = zy - yz
    formulae[..., 1, 2] = formulae[..., 2, 1] = zy + yz
    formulae[..., 1, 3] = formulae[..., 3, 1] = xz - zx
    formulae[..., 2, 3] = formulae[..., 3, 2] = yx - xy
    largest = np.argmax(np.diagonal(formulae, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(formulae, largest[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] >= 0.0, q, -q))


def pose_of(quaternion: FloatArray, translation_m: FloatArray) -> Pose:
    """Return the transform of a quaternion `[x, y, z, w]` (normalised here) and a translation (m).

    Raises:
        InvalidInput: If the quaternion has no direction or a number is not finite.
    """
    norm = float(np.linalg.norm(quaternion))
    if not np.isfinite(norm) or norm < 1e-9 or not np.all(np.isfinite(translation_m)):
        raise InvalidInput(f"pose with quaternion {quaternion} and translation {translation_m} m")
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / norm
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = translation_m
    return pose


def adjoint(pose: Pose) -> FloatArray:
    """Return the 6x6 matrix that carries tangent vectors of frame b into frame a."""
    result = np.zeros((6, 6))
    rotation = pose[:3, :3]
    result[:3, :3] = rotation
    result[3:, 3:] = rotation
    result[3:, :3] = skew(pose[:3, 3]) @ rotation
    return result


def symmetric(matrix: FloatArray) -> FloatArray:
    """Return the symmetric part: rounding must not make a covariance asymmetric."""
    return 0.5 * (matrix + matrix.T)


def isotropic_covariance(*, sigma_rad: float, sigma_m: float) -> FloatArray:
    """Return the covariance with these deviations about and along every axis, shape (6, 6)."""
    return np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)


def planar_covariance(covariance: FloatArray, *, off_plane_sigma: float = 1e-4) -> FloatArray:
    """Return a covariance confined to the plane.

    Args:
        covariance: Tangent covariance, shape (6, 6).
        off_plane_sigma: Standard deviation of roll, pitch (rad) and z (m); small, not zero, so
            that the matrix stays invertible.
    """
    result = np.zeros((6, 6))
    result[np.ix_(PLANAR_AXES, PLANAR_AXES)] = covariance[np.ix_(PLANAR_AXES, PLANAR_AXES)]
    result[_OFF_PLANE_AXES, _OFF_PLANE_AXES] = off_plane_sigma**2
    return result


def confined(covariance: FloatArray, *, is_planar: bool) -> FloatArray:
    """Return a covariance as one of a robot: in the plane if it is planar, shape (6, 6)."""
    return planar_covariance(covariance) if is_planar else symmetric(covariance)


@dataclass(frozen=True, slots=True, eq=False)
class GaussianPose:
    """A Gaussian over the transform `a_from_b`: `mean @ exp(xi)`, xi ~ N(0, covariance)."""

    mean: Pose
    """Mean transform, shape (4, 4)."""
    covariance: FloatArray
    """Covariance of the right perturbation `[rotation (rad), translation (m)]`, shape (6, 6)."""

    def __matmul__(self, other: GaussianPose) -> GaussianPose:
        """Return `a_from_c` of independent `a_from_b` and `b_from_c`, to first order (Eq. 15)."""
        carry = adjoint(inverse(other.mean))
        covariance = carry @ self.covariance @ carry.T + other.covariance
        return GaussianPose(self.mean @ other.mean, symmetric(covariance))

    def inverse(self) -> GaussianPose:
        """Return `b_from_a`."""
        carry = adjoint(self.mean)
        return GaussianPose(inverse(self.mean), symmetric(carry @ self.covariance @ carry.T))

    def fuse(self, other: GaussianPose) -> GaussianPose:
        """Return the product of two independent Gaussians over the same transform, Eq. (10)."""
        own = np.linalg.inv(self.covariance)
        theirs = np.linalg.inv(other.covariance)
        covariance = symmetric(np.linalg.inv(own + theirs))
        step = covariance @ theirs @ log(inverse(self.mean) @ other.mean)
        return GaussianPose(self.mean @ exp(step), covariance)

    @property
    def sigma_rad(self) -> float:
        """Standard deviation of the rotation about its least known axis, rad."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:3, :3])[-1], 0.0)))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the translation along its least known axis, m."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[3:, 3:])[-1], 0.0)))

    def disagreement2(self, other: GaussianPose) -> float:
        """Return the squared Mahalanobis distance of two independent beliefs from each other."""
        together = GaussianPose(self.mean, self.covariance + other.covariance)
        return together.mahalanobis2(other.mean)

    def mahalanobis2(self, pose: Pose) -> float:
        """Return the squared Mahalanobis distance of `pose` from this Gaussian."""
        xi = log(inverse(self.mean) @ pose)
        return float(xi @ np.linalg.solve(self.covariance, xi))


def certain(pose: Pose) -> GaussianPose:
    """Return a pose that is known exactly (zero covariance)."""
    return GaussianPose(pose, np.zeros((6, 6)))
