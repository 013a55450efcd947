"""What wheels are wrong about for good: tyres wear, an axle is not as wide as it is said to be.

Such errors are the same in every step. Taken for noise, which cancels, they make a robot surer of
a blind stretch than it may be; known, they make the stretch as straight as it was.

References:
    Borenstein and Feng, Measurement and correction of systematic odometry errors in mobile robots,
    T-RA 1996 (which errors there are).
    Censi et al., Simultaneous calibration of odometry and sensor parameters, T-RO 2013.
"""

from __future__ import annotations

import numpy as np

from hmt_service.core.config import MotionConfig
from hmt_service.core.geometry import PLANAR_AXES, FloatArray, Pose, exp, inverse, log

# Of the noise that is configured, the part that is not the same in every step.
_WHITE = 0.3
# A step this far off, in squared standard deviations of three axes, has slipped: 99.9 %.
_GATE = 16.3
_LEAST_M, _LEAST_RAD = 0.05, 0.05


def sigmas_of(
    noise: MotionConfig,
    turned_rad: float,
    travelled_m: float,
    *,
    floor_rad: float = 0.0,
    floor_m: float = 0.0,
) -> tuple[float, float]:
    """Return the standard deviations of a step that wheels tell, rad and m.

    Args:
        noise: What is known of the wheels.
        turned_rad: By how much the robot turned, not negative.
        travelled_m: How far it went.
        floor_rad: What is wrong with every step.
        floor_m: The same of its length.
    """
    sigma_rad = (
        floor_rad
        + noise.sigma_rotation_share * turned_rad
        + noise.sigma_rotation_rad_per_m * travelled_m
    )
    return sigma_rad, floor_m + noise.sigma_translation_share * travelled_m


class WheelCalibration:
    """Estimates scale, turn scale and drift of wheel odometry from registered steps."""

    def __init__(self, noise: MotionConfig) -> None:
        """Start from wheels that are said to be right, as well as the noise says.

        Args:
            noise: What is known of the wheels.
        """
        self._noise = noise
        self._mean = np.zeros(3)
        self._covariance = np.diag(
            [
                noise.sigma_translation_share**2,
                noise.sigma_rotation_share**2,
                noise.sigma_rotation_rad_per_m**2,
            ]
        )

    @property
    def errors(self) -> FloatArray:
        """Share by which ways are longer and turns wider than told, and the drift, rad/m."""
        return self._mean.copy()

    def corrected(self, told: Pose) -> Pose:
        """Return the motion that wheels mean when they tell one, shape (4, 4)."""
        xi = log(told)
        scale, turn, drift = self._mean
        xi[2] += turn * xi[2] + drift * float(np.linalg.norm(xi[3:]))
        xi[3:] *= 1.0 + scale
        return exp(xi)

    def learn(self, told: Pose, registered: Pose, covariance: FloatArray) -> None:
        """Take a step that scans were registered over.

        Args:
            told: Motion as the wheels told it, shape (4, 4).
            registered: The same by registration.
            covariance: Of that, by the scans alone, shape (6, 6).
        """
        xi = log(told)
        length, turned = float(np.linalg.norm(xi[3:])), float(xi[2])
        if length < _LEAST_M and abs(turned) < _LEAST_RAD:
            return
        gap = log(inverse(self.corrected(told)) @ registered)[PLANAR_AXES]
        jacobian = np.zeros((3, 3))
        jacobian[0] = [0.0, turned, length]
        jacobian[1:, 0] = xi[3:5]
        sigma_rad, sigma_m = sigmas_of(self._noise, abs(turned), length)
        white = np.array([sigma_rad, sigma_m, sigma_m])
        seen = covariance[np.ix_(PLANAR_AXES, PLANAR_AXES)] + np.diag((_WHITE * white) ** 2)
        innovation = jacobian @ self._covariance @ jacobian.T + seen
        if gap @ np.linalg.solve(innovation, gap) > _GATE:
            return
        gain = self._covariance @ jacobian.T @ np.linalg.inv(innovation)
        self._mean = self._mean + gain @ gap
        self._covariance = self._covariance - gain @ jacobian @ self._covariance
