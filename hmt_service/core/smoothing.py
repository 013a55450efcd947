"""Smoothing: the poses of all keyframes of one hypothesis, from all that they see in common.

The online map is relative and as coarse as its areas. Once a topology is settled, each keyframe is
registered in those of other times that look at the same surfaces, and all poses are estimated
together, as a method with one graph of all keyframes would do.

References:
    Lu and Milios, Globally consistent range scan alignment, Autonomous Robots 4, 1997.
    Blanco et al. 2008, section V (local maps are fused once the topology is settled).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from scipy.spatial import KDTree

from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    certain,
    identity,
    inverse,
    isotropic_covariance,
    log,
    planar_covariance,
    transform_points,
)
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Hypothesis
from hmt_service.core.local_map import LocalMap, SeenPoints, Sweep
from hmt_service.core.submap import Visit
from hmt_service.core.surfels import thin
from hmt_service.core.types import Keyframe

# Keyframes look at the same when the middles of what they see are so near.
_NEAR_M = 4.0
# Each is tied to so many other times at most, and to a window of so many keyframes to either side.
_MOST_TIMES, _WINDOW = 3, 4
# Windows begin at every third keyframe: neighbours share one.
_STRIDE = 3
# What the consistent poses are off at most; a tie that says more is a wrong one.
_SIGMA_M, _SIGMA_RAD = 0.3, 0.1
_MOST_M, _MOST_RAD = 0.5, 0.15
_LEAST_SHARE = 0.5
# Windows are bent by so much.
_FLOOR_M, _FLOOR_RAD = 0.005, 0.002
# Squared distance in standard deviations from all the others together beyond which a tie is left.
_GATE = 100.0
# Standard deviation of a direction that a tie says nothing about.
_UNSEEN = 10.0


class Smoother:
    """Estimates the poses of all keyframes together."""

    def __init__(self, config: Config) -> None:
        """Build the stage.

        Args:
            config: Settings of all stages.
        """
        self._is_planar = config.sensor.is_planar
        self._odometry = config.odometry
        self._covariance = config.covariance

    def smooth(self, hypothesis: Hypothesis, visits: Mapping[int, Visit]) -> FloatArray:
        """Return `reference_from_keyframe` of every keyframe, shape (K, 4, 4).

        Args:
            hypothesis: Says which keyframes are near each other.
            visits: All visits.
        """
        keyframes = [keyframe for visit in visits.values() for keyframe in visit.keyframes]
        poses = hypothesis.keyframe_poses(visits)
        ties = self._ties(keyframes, poses)
        if not ties:
            return poses
        motions = [
            Factor(before, before + 1, keyframe.previous_from_body)
            for before, (_, keyframe) in enumerate(pairwise(keyframes))
        ]
        solved = self._solved(poses, motions, ties)
        agreed = [tie for tie in ties if _distance2(tie, solved) <= _GATE]
        return solved if len(agreed) == len(ties) else self._solved(solved, motions, agreed)

    def _solved(
        self, poses: FloatArray, motions: Sequence[Factor], ties: Sequence[Factor]
    ) -> FloatArray:
        graph = PoseGraph.of(poses, [*motions, *ties], is_planar=self._is_planar)
        return np.array([graph.pose(index) for index in range(len(poses))])

    def _ties(self, keyframes: Sequence[Keyframe], poses: FloatArray) -> list[Factor]:
        """Return what each keyframe says of its pose among those of other times."""
        seen = [self._seen(keyframe) for keyframe in keyframes]
        views = np.array(
            [
                transform_points(pose, each.points.mean(axis=0)[None])[0]
                for pose, each in zip(poses, seen, strict=True)
            ]
        )
        tree = KDTree(views)
        windows: dict[int, LocalMap] = {}
        ties = []
        for index, keyframe in enumerate(keyframes):
            sweep = self._sweep(seen[index], keyframe)
            for other in self._other_times(
                index, tree.query_ball_point(views[index], _NEAR_M), views
            ):
                if other not in windows:
                    windows[other] = self._window(other, seen, poses)
                tie = self._tie(windows[other], sweep, inverse(poses[other]) @ poses[index])
                if tie is not None:
                    ties.append(Factor(other, index, tie))
        return ties

    def _other_times(self, index: int, near: Sequence[int], views: FloatArray) -> list[int]:
        """Return the keyframe with the nearest view of each earlier time, the nearest first."""
        gap = self._odometry.window_keyframes
        earlier = np.sort([other for other in near if other < index - gap])
        if not len(earlier):
            return []
        times = np.split(earlier, np.flatnonzero(np.diff(earlier) > gap) + 1)
        nearest = []
        for time in times:
            distances = np.linalg.norm(views[time] - views[index], axis=1)
            best = int(np.argmin(distances))
            nearest.append((float(distances[best]), int(time[best]) // _STRIDE * _STRIDE))
        return [other for _, other in sorted(nearest)[:_MOST_TIMES]]

    def _tie(self, window: LocalMap, sweep: Sweep, expected: Pose) -> GaussianPose | None:
        near = self._confined(isotropic_covariance(sigma_rad=_SIGMA_RAD, sigma_m=_SIGMA_M))
        fit = window.fit(sweep, GaussianPose(expected, near), certain(identity()), expected)
        moved = log(inverse(expected) @ fit.pose)
        is_near = np.linalg.norm(moved[3:]) <= _MOST_M and np.linalg.norm(moved[:3]) <= _MOST_RAD
        if not (fit.is_converged and is_near and fit.inlier_share >= _LEAST_SHARE):
            return None
        floor = isotropic_covariance(sigma_rad=_FLOOR_RAD, sigma_m=_FLOOR_M)
        return GaussianPose(fit.pose, self._confined(fit.own_covariance(_UNSEEN) + floor))

    def _confined(self, covariance: FloatArray) -> FloatArray:
        return planar_covariance(covariance) if self._is_planar else covariance

    def _seen(self, keyframe: Keyframe) -> SeenPoints:
        cell_m = self._odometry.voxel_size_m
        points = np.ascontiguousarray(keyframe.points_in_body, dtype=np.float64)
        if not self._is_planar:
            points = points[thin(points, cell_m)]
        return SeenPoints.of(
            points, keyframe.sensor_in_body, cell_m=cell_m, is_planar=self._is_planar
        )

    def _sweep(self, seen: SeenPoints, keyframe: Keyframe) -> Sweep:
        points = seen.points
        sweep = Sweep(points, np.zeros(len(points)), keyframe.sensor_in_body - points)
        if self._is_planar:
            return sweep
        return sweep.thinned(self._odometry.voxel_size_m, self._odometry.max_points)

    def _window(self, middle: int, seen: Sequence[SeenPoints], poses: FloatArray) -> LocalMap:
        indices = range(max(0, middle - _WINDOW), min(len(poses), middle + _WINDOW + 1))
        relative = [inverse(poses[middle]) @ poses[index] for index in indices]
        return LocalMap(
            SeenPoints.together(relative, [seen[index] for index in indices]),
            cell_m=self._odometry.voxel_size_m,
            sigma_m=self._covariance.sigma_m,
            degenerate_m=self._covariance.degenerate_m,
            is_planar=self._is_planar,
        )


def _distance2(tie: Factor, poses: FloatArray) -> float:
    return tie.a_from_b.mahalanobis2(inverse(poses[tie.visit_a]) @ poses[tie.visit_b])
