"""The local map that scans are registered in, and the registration itself.

References:
    Vizzo et al., KISS-ICP, RA-L 2023 (a short local map, and few parameters, suffice).
    Dellenbach et al., CT-ICP, ICRA 2022 (pose and motion of a sweep are estimated together).
    Censi, An accurate closed-form estimate of ICP's covariance, ICRA 2007 (information).
    Zhang et al., On degeneracy of optimization-based state estimation, ICRA 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    PLANAR_AXES,
    FloatArray,
    GaussianPose,
    Pose,
    exp,
    identity,
    log,
    symmetric,
    transform_points,
)
from hmt_service.core.surfels import (
    build_surfels,
    carry_to_end,
    directions_of,
    gauss_newton,
    thin,
)

# Coarse cells are so many times as large, and what lies in them is so many times less flat.
_COARSE = 4
_COARSE_SIGMA = 7.0
# Robust kernels in standard deviations.
_KERNEL, _COARSE_KERNEL = 4.0, 3.0
_MAX_ITERATIONS = 30
_GLANCE_ITERATIONS = 8
# Beyond this last step, rad and m, the iteration has not converged; smaller ones are points that
# change surfels back and forth.
_MAX_LAST_STEP = 5e-3
# Of the points of a LiDAR, the coarse cells need one in so many only; of a plane's, so many.
_SPARSE, _SPARSE_POINTS = 4, 400
# Where the prediction explains less than half of the scan, and contradicts some of what the map
# knows, headings up to so far from it are tried. What is found must explain half, and half as much
# again as the prediction.
_SEARCH_RAD = np.linspace(-0.6, 0.6, 13)
_FOUND_SHARE, _CONTRADICTED, _BETTER = 0.5, 0.9, 1.5
# Normals are good to so many rad: a direction that is opposed by less than the square of it, as a
# share of what opposes the best-known one, may be opposed by nothing else.
# Those of lines are fitted to fewer points than those of planes.
_TILT = {3: 0.1, 6: 0.05}
# Standard deviation of a direction that a scan says nothing about, m and rad.
_UNSEEN = 10.0
# Largest squared distance of a prior that is believed: 95 % of all that are honest are nearer.
_GATE = {axes: 2.0 * float(gammaincinv(0.5 * axes, 0.95)) for axes in (3, 6)}


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Returns of one scan, each where it was in the body frame when it was taken."""

    points: FloatArray
    """Shape (N, 3), m."""
    lags: FloatArray
    """Share of the sweep's motion that was still to come then, shape (N,); 0 at its end."""
    views: FloatArray
    """Vector from each to where it was seen from, of any length, shape (N, 3)."""

    @property
    def is_instant(self) -> bool:
        """Whether all was taken at once."""
        return not np.any(self.lags)

    def at_end(self, motion: FloatArray) -> FloatArray:
        """Return the points in the body frame at the end of the sweep, shape (N, 3), m.

        Args:
            motion: Motion of the body during the sweep as a tangent vector, shape (6,).
        """
        if self.is_instant:
            return self.points
        points = np.empty_like(self.points)
        carry_to_end(self.points, self.lags, motion, points)
        return points

    def thinned(self, cell_m: float, most: int) -> Sweep:
        """Return the first point in each cell, and no more than so many, evenly chosen."""
        chosen = thin(self.points, cell_m)
        if len(chosen) > most:
            chosen = chosen[np.linspace(0, len(chosen) - 1, most).astype(np.int64)]
        return Sweep(self.points[chosen], self.lags[chosen], self.views[chosen])

    def every(self, step: int) -> Sweep:
        """Return every so many-th point."""
        return Sweep(
            *(np.ascontiguousarray(a[::step]) for a in (self.points, self.lags, self.views))
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Where a scan fits into a local map."""

    pose: Pose
    """`map_from_body` at the end of the sweep, fused with the prior, shape (4, 4)."""
    covariance: FloatArray
    """Of that, shape (6, 6); degenerate directions are as certain as the prior."""
    scan_share: FloatArray
    """The part of the covariance that is the scan's noise, not the prior's, shape (6, 6)."""
    motion: FloatArray
    """Motion during the sweep as a tangent vector, shape (6,)."""
    information: FloatArray
    """What the scan alone says of the pose, degenerate directions left out, shape (6, 6)."""
    degenerate: FloatArray
    """Unit tangent vectors that the scan says next to nothing about, shape (K, 6)."""
    prior_weight: float
    """Share of the prior's information that was believed, in (0, 1]; below 1 it contradicts."""
    known_share: float
    """Share of the points that lie where the map knows a surface, in [0, 1]."""
    inlier_share: float
    """Share of the points that fit, in [0, 1]."""
    is_converged: bool
    """Whether the iteration came to rest."""

    @property
    def own_covariance(self) -> FloatArray:
        """Covariance of the pose by the scan alone, shape (6, 6), wide where it says nothing."""
        together: FloatArray = self.information + np.eye(6) / _UNSEEN**2
        return symmetric(np.linalg.inv(together).astype(np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints:
    """Points of one keyframe, with the side that each was seen from."""

    points: FloatArray
    """In the body frame, shape (N, 3), m."""
    directions: FloatArray
    """Unit vectors, shape (N, 3)."""

    @classmethod
    def of(
        cls, points: FloatArray, sensor_in_body: FloatArray, *, cell_m: float, is_planar: bool
    ) -> SeenPoints:
        """Return points as a sensor sees them."""
        cells_m = (cell_m, _COARSE * cell_m)
        return cls(points, directions_of(points, sensor_in_body, cells_m, is_planar=is_planar))

    @classmethod
    def of_keyframe(
        cls, points: FloatArray, sensor_in_body: FloatArray, config: Config
    ) -> SeenPoints:
        """Return what a keyframe adds to a local map."""
        cell_m, is_planar = config.odometry.voxel_size_m, config.sensor.is_planar
        kept = points_of_keyframe(points, config)
        return cls.of(kept, sensor_in_body, cell_m=cell_m, is_planar=is_planar)

    @classmethod
    def together(cls, poses: Sequence[Pose], parts: Sequence[SeenPoints]) -> SeenPoints:
        """Return what several have seen, each part carried by a pose, in one frame."""
        posed = list(zip(poses, parts, strict=True))
        return cls(
            np.concatenate([transform_points(pose, part.points) for pose, part in posed]),
            np.concatenate([part.directions @ pose[:3, :3].T for pose, part in posed]),
        )


def points_of_keyframe(points: FloatArray, config: Config) -> FloatArray:
    """Return which points a keyframe adds to a local map: of a LiDAR's, one per cell."""
    return points if config.sensor.is_planar else points[thin(points, config.odometry.voxel_size_m)]


class LocalMap:
    """Surfels of two sizes: coarse ones lead to where fine ones say more."""

    def __init__(
        self,
        seen: SeenPoints,
        *,
        cell_m: float,
        sigma_m: float,
        degenerate_m: float,
        is_planar: bool,
    ) -> None:
        """Build the surfels.

        Args:
            seen: Points in the map's frame, N >= 1.
            cell_m: Edge of a fine cell.
            sigma_m: Standard deviation of the distance of a return from its surface.
            degenerate_m: Where a scan leaves the pose less certain than this, it is degenerate.
            is_planar: Whether poses are planar and surfaces vertical.
        """
        self._is_planar = is_planar
        self._degenerate_m = degenerate_m
        self._fine, self._coarse = (
            build_surfels(
                seen.points,
                seen.directions,
                cell_m=times * cell_m,
                sigma_m=spread * sigma_m,
                is_planar=is_planar,
            )
            for times, spread in ((1, 1.0), (_COARSE, _COARSE_SIGMA))
        )

    @classmethod
    def of(cls, seen: SeenPoints, config: Config, *, sigma_m: float) -> LocalMap:
        """Return a map of some points, with cells as configured."""
        return cls(
            seen,
            cell_m=config.odometry.voxel_size_m,
            sigma_m=sigma_m,
            degenerate_m=config.covariance.degenerate_m,
            is_planar=config.sensor.is_planar,
        )

    def register(self, sweep: Sweep, prior: GaussianPose, motion: GaussianPose) -> Fit:
        """Return where the scan fits, fused with what was expected.

        Where the scan does not fit near the prior, headings farther from it are tried.

        Args:
            sweep: The scan, N >= 1.
            prior: `map_from_body` as predicted.
            motion: Motion during the sweep as predicted.
        """
        fit = self.fit(sweep, prior, motion, prior.mean)
        if fit.inlier_share >= min(_FOUND_SHARE, _CONTRADICTED * fit.known_share):
            return fit
        turns = np.zeros((len(_SEARCH_RAD), 6))
        turns[:, 2] = _SEARCH_RAD
        others = [self.fit(sweep, prior, motion, prior.mean @ turn) for turn in exp(turns)]
        best = max(others, key=lambda other: other.inlier_share)
        least = max(_FOUND_SHARE, _BETTER * fit.inlier_share)
        # Even one that has not come to rest: where something else explains so much more, what was
        # found near the prediction is wrong, and no registration is better than that one.
        return best if best.inlier_share >= least else fit

    def glance(self, sweep: Sweep, start: Pose, information: FloatArray) -> tuple[Pose, float]:
        """Return about where a scan fits near a pose, and the share of its points that do.

        A few steps of `fit`, for guesses most of which are wrong.

        Args:
            sweep: A scan taken at once, N >= 1.
            start: Where to start from.
            information: Of that, shape (6, 6).
        """
        pose, fitting, nothing = np.ascontiguousarray(start), 0, np.zeros((6, 6))
        for surfels, kernel in ((self._coarse, _COARSE_KERNEL), (self._fine, _KERNEL)):
            pose, _, _, _, _, fitting, _ = gauss_newton(
                surfels,
                sweep.points,
                sweep.lags,
                sweep.views,
                pose,
                start,
                information,
                np.inf,
                np.zeros(6),
                nothing,
                kernel**2,
                _GLANCE_ITERATIONS,
            )
        return pose, fitting / len(sweep.points)

    def fit(self, sweep: Sweep, prior: GaussianPose, motion: GaussianPose, start: Pose) -> Fit:
        """Return where the scan fits near a pose, as `register` does."""
        axes = PLANAR_AXES if self._is_planar else np.arange(6)
        block = np.ix_(axes, axes)
        prior_information = np.zeros((6, 6))
        prior_information[block] = np.linalg.inv(prior.covariance[block])
        motion_information = np.zeros((6, 6))
        if not sweep.is_instant:
            motion_information[:] = np.linalg.inv(motion.covariance)
        expected, expected_motion = np.ascontiguousarray(prior.mean), log(motion.mean)
        pose = np.ascontiguousarray(start)
        every = len(sweep.points) // _SPARSE_POINTS if self._is_planar else _SPARSE
        sparse = sweep.every(every) if every > 1 else sweep
        for surfels, cloud, kernel in (
            (self._coarse, sparse, _COARSE_KERNEL),
            (self._fine, sweep, _KERNEL),
        ):
            pose, moving, information, weight, matched, fitting, last_step = gauss_newton(
                surfels,
                np.ascontiguousarray(cloud.points),
                cloud.lags,
                cloud.views,
                pose,
                expected,
                prior_information,
                _GATE[len(axes)],
                expected_motion,
                motion_information,
                kernel**2,
                _MAX_ITERATIONS,
            )
        own = information[:6, :6]
        if not sweep.is_instant:
            # What the motion does not account for.
            own = own - information[:6, 6:] @ np.linalg.solve(
                information[6:, 6:], information[6:, :6]
            )
        known, degenerate = _known_directions(own, axes, 1.0 / self._degenerate_m**2)
        covariance = np.zeros((6, 6))
        together = known + weight * prior_information
        covariance[block] = symmetric(np.linalg.inv(together[block]))
        # With S = (I + P)^-1: S = S I S + S P S, what the scan and what the prior adds to it.
        scan_share = symmetric(covariance @ known @ covariance)
        return Fit(
            pose=pose,
            covariance=covariance,
            scan_share=scan_share,
            motion=moving,
            information=known,
            degenerate=degenerate,
            prior_weight=float(weight),
            known_share=matched / len(sweep.points),
            inlier_share=fitting / len(sweep.points),
            is_converged=bool(last_step <= _MAX_LAST_STEP),
        )


def _known_directions(
    information: FloatArray, axes: np.ndarray, least: float
) -> tuple[FloatArray, FloatArray]:
    """Return the information without that of degenerate directions, and these directions.

    Along a blank corridor only clutter and the noise of normals oppose a translation. What they say
    is better than nothing for the mean (to leave it to the prior alone made drifts up to twice as
    large in simulated worlds) until it adds up to what the prior forbids, but worth no certainty.

    Args:
        information: Tangent order, shape (6, 6).
        axes: Components that are estimated.
        least: Information below which a direction is degenerate, 1/m^2.
    """
    block = np.ix_(axes, axes)
    result = np.zeros((6, 6))
    is_turn = axes < 3
    diagonal = np.diag(information)[axes]
    if not np.all(np.isfinite(diagonal)) or diagonal[~is_turn].sum() <= 0.0:
        return result, np.eye(6)[axes]
    # A rotation counts by how far it moves the points: the lever that makes the units the same.
    lever_m = np.sqrt(max(diagonal[is_turn].mean() / diagonal[~is_turn].mean(), 1e-6))
    scale = np.where(is_turn, 1.0 / lever_m, 1.0)
    values, vectors = np.linalg.eigh(symmetric(information[block] * np.outer(scale, scale)))
    is_known = values >= max(least, _TILT[len(axes)] ** 2 * values[-1])
    kept = (vectors[:, is_known] * values[is_known]) @ vectors[:, is_known].T
    result[block] = symmetric(kept / np.outer(scale, scale))
    degenerate = np.zeros((int(np.sum(~is_known)), 6))
    degenerate[:, axes] = (vectors[:, ~is_known] * scale[:, None]).T
    degenerate /= np.linalg.norm(degenerate, axis=1, keepdims=True)
    return result, degenerate


def deskew(points: FloatArray, point_times: FloatArray, motion: Pose) -> FloatArray:
    """Return the points of a sweep in the body frame at its end, shape (N, 3), m.

    Args:
        points: Each in the body frame when it was taken, shape (N, 3), m.
        point_times: When that was, as a share of the sweep in [0, 1], shape (N,).
        motion: Motion of the body during the sweep, shape (4, 4).
    """
    return Sweep(points, 1.0 - point_times, -points).at_end(log(motion))


def compile_kernels(*, is_planar: bool) -> None:
    """Compile what registration needs, or load it: not while the first scan waits."""
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    sensor, wide = np.zeros(3), GaussianPose(identity(), np.eye(6))
    seen = SeenPoints.of(points, sensor, cell_m=1.0, is_planar=is_planar)
    local_map = LocalMap(seen, cell_m=1.0, sigma_m=0.1, degenerate_m=1.0, is_planar=is_planar)
    lags = np.zeros(50) if is_planar else np.linspace(1.0, 0.0, 50)
    sweep = Sweep(points, lags, sensor - points)
    local_map.register(sweep.thinned(0.1, 40), wide, wide)
    local_map.glance(sweep, identity(), np.eye(6))
