"""Alignment of two submaps: all relative poses that their contents allow inside a prior.

References:
    Blanco et al. 2008, section IV-A (the transition model looks at every place that may match).
    Olson, Real-time correlative scan matching, ICRA 2009 (a search over all rotations comes first).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_service.core.config import Config
from hmt_service.core.correlation import Raster
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    adjoint,
    apart,
    certain,
    confined,
    identity,
    inverse,
    isotropic_covariance,
    planar_pose,
    skew,
    transform_points,
    yaw_of,
)
from hmt_service.core.local_map import Sweep
from hmt_service.core.submap import Visit

# A prior this tight leaves one basin of attraction: registration finds it without a search.
_SINGLE_BASIN_M = 0.25
_SINGLE_BASIN_RAD = 0.05
# How far a guess may be off; the prior of its registration, next to nothing.
_BASIN_M, _BASIN_RAD = 1.0, 0.3
_NEAR_INFORMATION = isotropic_covariance(sigma_rad=1.0 / _BASIN_RAD, sigma_m=1.0 / _BASIN_M)
# A guess is looked at from above, then with so few points, and dropped if that explains less than
# these shares of the overlap that is asked for.
_FEW_POINTS, _FROM_ABOVE, _AT_A_GLANCE = 200, 0.75, 0.85
# So many points or a few more are searched for: the floor of a garage alone is ten times as many.
_SEARCHED_POINTS = 5_000
# Searches are so much wider than asked for: the next hypothesis asks for almost the same.
_MARGIN_M, _MARGIN_RAD = 1.0, 0.05
SEPARATION_M, SEPARATION_RAD = 0.6, 0.15
"""Poses of one submap in another that are no farther apart are one mode."""
_SEPARATION_SIGMA = 4.0
_PEAK_SHARE = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """One way to lay a visit's submap over another."""

    target_from_visit: GaussianPose
    """Relative pose of the frames, with the covariance of the registration and of how far both
    submaps are bent."""
    width: FloatArray
    """Covariance of the registration alone, shape (6, 6): width of the peak of the likelihood."""
    overlap: float
    """Share of the visit's points that the target explains there, in [0, 1]."""


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """Where the middle of a visit may be, and how it may be turned."""

    mean: Pose
    """Pose of the visit in the middle of it, `target_from_visit`."""
    centre: FloatArray
    """Middle of the visit there, shape (3,), m."""
    reach_m: float
    """Radius of the circle around it."""
    reach_rad: float
    """Largest turn about the vertical to either side, up to pi."""

    def holds(self, other: _Region) -> bool:
        """Return whether all of another region is in this one."""
        turn = abs(yaw_of(inverse(self.mean) @ other.mean))
        apart_m = float(np.linalg.norm(self.centre[:2] - other.centre[:2]))
        has_turns = self.reach_rad >= np.pi or turn + other.reach_rad <= self.reach_rad
        return bool(has_turns and apart_m + other.reach_m <= self.reach_m)

    def wider(self) -> _Region:
        """Return this region with a margin."""
        reach_rad = min(np.pi, self.reach_rad + _MARGIN_RAD)
        return _Region(self.mean, self.centre, self.reach_m + _MARGIN_M, reach_rad)


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    region: _Region
    guesses: list[Pose]


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """What has been found out about one visit."""

    visit: Visit
    few: Sweep
    """Some of its points: enough to drop most guesses."""
    searches: dict[Visit, list[_Search]]
    """Correlations with each target."""
    refined: dict[tuple[Visit, bytes], Mode | None]
    """What became of each guess for each target."""


class Aligner:
    """Finds the modes of the relative pose of two submaps."""

    def __init__(self, config: Config) -> None:
        """Build the aligner.

        Args:
            config: Settings of all stages.
        """
        self._config = config.alignment
        self._covariance = config.covariance
        self._is_planar = config.sensor.is_planar
        self._raster = Raster(
            step_rad=self._config.angle_step_rad,
            least=_FROM_ABOVE * self._config.min_overlap,
            peak_share=_PEAK_SHARE,
            separation_m=SEPARATION_M,
            separation_rad=SEPARATION_RAD,
            most=2 * self._config.max_modes,
        )
        self._known: _Known | None = None

    def modes(self, visit: Visit, target: Visit, prior: GaussianPose) -> tuple[Mode, ...]:
        """Return every pose inside the gate of the prior at which the submaps agree.

        Args:
            visit: What is to be placed.
            target: Where it may be.
            prior: Belief about `target_from_visit` before looking at the submaps.

        Returns:
            Distinct modes, the one with most overlap first; empty when nothing agrees.
        """
        if not _have_points(visit, target):
            return ()
        refined = []
        for guess in self._guesses(visit, target, prior):
            mode = self._refined(visit, target, guess)
            if mode is not None and self._is_in_gate(mode, prior):
                refined.append(mode)
        return self._distinct(refined)

    def refine(
        self, visit: Visit, target: Visit, guess: Pose, *, min_overlap: float
    ) -> Mode | None:
        """Return the mode whose basin a guess lies in, or None when the submaps disagree there.

        Args:
            visit: What is to be placed.
            target: Where it is.
            guess: Pose to start from, `target_from_visit`.
            min_overlap: Least share of the visit's points that the target must explain.
        """
        if not _have_points(visit, target):
            return None
        near = isotropic_covariance(sigma_rad=_BASIN_RAD, sigma_m=_BASIN_M)
        prior = GaussianPose(guess, confined(near, is_planar=self._is_planar))
        fit = target.local_map.fit(visit.sweep, prior, certain(identity()), guess)
        if not fit.is_converged or fit.inlier_share < min_overlap:
            return None
        moved = adjoint(inverse(fit.pose))
        width = fit.own_covariance + isotropic_covariance(
            sigma_rad=self._covariance.floor_submap_rad, sigma_m=self._covariance.floor_submap_m
        )
        covariance = width + visit.bend + moved @ target.bend @ moved.T
        return Mode(
            GaussianPose(fit.pose, confined(covariance, is_planar=self._is_planar)),
            confined(width, is_planar=self._is_planar),
            fit.inlier_share,
        )

    def _refined(self, visit: Visit, target: Visit, guess: Pose) -> Mode | None:
        """Return what `refine` does, for a guess that few points speak for, and only once."""
        known = self._known_of(visit)
        key = (target, guess.tobytes())
        if key not in known.refined:
            least = self._config.min_overlap
            pose, share = target.local_map.glance(known.few, guess, _NEAR_INFORMATION)
            is_likely = share >= _AT_A_GLANCE * least
            known.refined[key] = (
                self.refine(visit, target, pose, min_overlap=least) if is_likely else None
            )
        return known.refined[key]

    def _known_of(self, visit: Visit) -> _Known:
        """Return what has been found out about a visit; hypotheses ask the same again and again."""
        if self._known is None or self._known.visit is not visit:
            few = visit.sweep.every(max(len(visit.sweep.points) // _FEW_POINTS, 1))
            self._known = _Known(visit, few, {}, {})
        return self._known

    def _guesses(self, visit: Visit, target: Visit, prior: GaussianPose) -> list[Pose]:
        position = _position_covariance(prior, visit.centre)
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(position)[-1]))
        sigma_rad = float(np.sqrt(prior.covariance[2, 2]))
        if sigma_m < _SINGLE_BASIN_M and sigma_rad < _SINGLE_BASIN_RAD:
            return [prior.mean]
        gate = self._config.gate_sigma
        region = _Region(
            prior.mean,
            transform_points(prior.mean, visit.centre[None])[0],
            gate * sigma_m,
            min(np.pi, gate * sigma_rad),
        )
        searches = self._known_of(visit).searches.setdefault(target, [])
        for search in searches:
            if search.region.holds(region):
                return search.guesses
        wider = region.wider()
        searches.append(_Search(wider, self._correlate(visit, target, wider)))
        return searches[-1].guesses

    def _correlate(self, visit: Visit, target: Visit, region: _Region) -> list[Pose]:
        """Return the best poses on a raster, seen from above; height and tilt are the region's."""
        yaw = yaw_of(region.mean)
        upright = planar_pose(0.0, 0.0, -yaw)[:3, :3] @ region.mean[:3, :3]
        searched = slice(None, None, max(len(visit.points) // _SEARCHED_POINTS, 1))
        peaks = target.view.best_peaks(
            (visit.points[searched] - visit.centre) @ upright.T,
            visit.seen.directions[searched] @ upright.T,
            middle=region.centre[:2],
            yaw=yaw,
            reach_m=region.reach_m,
            reach_rad=region.reach_rad,
            raster=self._raster,
        )
        poses = []
        for peak in peaks:
            pose = region.mean.copy()
            pose[:3, :3] = planar_pose(0.0, 0.0, peak.yaw)[:3, :3] @ upright
            pose[:2, 3] = peak.position - (pose[:3, :3] @ visit.centre)[:2]
            poses.append(pose)
        return poses

    def _is_in_gate(self, mode: Mode, prior: GaussianPose) -> bool:
        return prior.disagreement2(mode.target_from_visit) <= self._config.gate_sigma**2 + 6.0

    def _distinct(self, modes: list[Mode]) -> tuple[Mode, ...]:
        """Return one mode per basin: a corridor of equally good poses is a single one."""
        kept: list[Mode] = []
        for mode in sorted(modes, key=lambda mode: -mode.overlap):
            pose = mode.target_from_visit
            if all(_are_apart(other.target_from_visit, pose) for other in kept):
                kept.append(mode)
        return tuple(kept[: self._config.max_modes])


def _have_points(visit: Visit, target: Visit) -> bool:
    return len(visit.points) > 0 and len(target.points) > 0


def _are_apart(first: GaussianPose, second: GaussianPose) -> bool:
    apart_m, apart_rad = apart(first.mean, second.mean)
    is_far = apart_m > SEPARATION_M or apart_rad > SEPARATION_RAD
    return is_far and first.disagreement2(second) > _SEPARATION_SIGMA**2


def _position_covariance(pose: GaussianPose, point: FloatArray) -> FloatArray:
    """Return the covariance of a point carried by an uncertain pose, shape (2, 2), m^2.

    To first order `d(T p) = R (rho - p x phi)`; only the horizontal part counts for the search.
    """
    jacobian = pose.mean[:3, :3] @ np.hstack([-skew(point), np.eye(3)])
    return np.asarray((jacobian @ pose.covariance @ jacobian.T)[:2, :2])
