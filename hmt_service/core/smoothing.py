"""Smoothing: the poses of all keyframes of one hypothesis, from all that they see in common.

The online map is relative and as coarse as its areas. Once a topology is settled, each keyframe is
registered in those of other times that look at the same surfaces, and all poses are estimated
together, as a method with one graph of all keyframes would do.

References:
    Lu and Milios, Globally consistent range scan alignment, Autonomous Robots 4, 1997.
    Blanco et al. 2008, section V (local maps are fused once the topology is settled).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from hmt_service.core.chunked import Chunked
from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    apart,
    certain,
    confined,
    identity,
    inverse,
    isotropic_covariance,
    transform_points,
)
from hmt_service.core.graph import Factor, optimised
from hmt_service.core.hypotheses import Hypothesis
from hmt_service.core.local_map import LocalMap, SeenPoints, Sweep, points_of_keyframe
from hmt_service.core.types import Keyframe
from hmt_service.core.visits import Visits

# Keyframes look at the same when the middles of what they see are so near.
_NEAR_M = 4.0
# Each is tied to so many other times at most, and to a window of so many keyframes to either side.
_MOST_TIMES, _WINDOW = 2, 4
# Windows begin at every third keyframe: neighbours share one.
_STRIDE = 3
# What the consistent poses are off at most; a tie that says more is a wrong one.
_SIGMA_M, _SIGMA_RAD = 0.3, 0.1
_MOST_M, _MOST_RAD = 0.5, 0.15
_LEAST_SHARE = 0.5
# Windows are bent by so much.
_FLOOR_M, _FLOOR_RAD = 0.005, 0.002
# Ties so far from where all together put their ends, in squared standard deviations, are left out.
_GATE = 100.0
# So many keyframes and windows are kept while ties are looked for.
_SEEN, _WINDOWS = 128, 64


class Smoother:
    """Estimates the poses of all keyframes together."""

    def __init__(self, config: Config) -> None:
        """Build the stage.

        Args:
            config: Settings of all stages.
        """
        self._config = config
        self._is_planar = config.sensor.is_planar
        # Keyframes that share a local map, or a window, have nothing new to say of each other.
        self._gap = max(config.odometry.window_keyframes, _WINDOW + _STRIDE)

    def smooth(self, hypothesis: Hypothesis, visits: Visits) -> FloatArray:
        """Return `reference_from_keyframe` of every keyframe, shape (K, 4, 4).

        Visits that were forgotten keep their places in their areas.

        Args:
            hypothesis: Says which keyframes are near each other.
            visits: All visits.
        """
        poses = hypothesis.keyframe_poses(visits.values())
        smoothed = self._smoothed(hypothesis, visits, poses)
        first_of = np.cumsum([0, *map(visits.keyframes, visits)])
        for visit in filter(visits.is_forgotten, visits):
            founder = first_of[hypothesis.topology.assignments[visit].area]
            moved = smoothed[founder] @ inverse(poses[founder])
            own = slice(first_of[visit], first_of[visit + 1])
            smoothed[own] = moved @ poses[own]
        return smoothed

    def _smoothed(self, hypothesis: Hypothesis, visits: Visits, poses: FloatArray) -> FloatArray:
        """Return the poses of all keyframes, those of visits that were kept estimated together."""
        kept = [visit for visit in visits if not visits.is_forgotten(visit)]
        sizes = [visits.keyframes(visit) for visit in kept]
        keyframes = Chunked(sizes, lambda number: visits[kept[number]].keyframes)
        indices = np.array([keyframe.index for keyframe in keyframes])
        ties = self._ties(keyframes, poses[indices])
        smoothed = poses.copy()
        if not ties:
            return smoothed
        firsts = np.concatenate([[0], np.cumsum(sizes[:-1])]).tolist()
        first_of = dict(zip(kept, firsts, strict=True))
        carried = {first_of[v] for v in kept if hypothesis.topology.assignments[v].is_carried}
        known = [*_motions(keyframes, carried), *_alignments(hypothesis, visits, first_of)]
        solved = poses[indices]
        for _ in range(2):
            solved = optimised(solved, _one_per_pair([*known, *ties]), is_planar=self._is_planar)
            agreed = [tie for tie in ties if _distance2(tie, solved) <= _GATE]
            if len(agreed) == len(ties):
                break
            ties = agreed
        smoothed[indices] = solved
        return smoothed

    def _ties(self, keyframes: Sequence[Keyframe], poses: FloatArray) -> list[Factor]:
        """Return what each keyframe says of its pose among those of other times."""
        views = np.full((len(keyframes), 3), np.inf)
        times = np.empty(len(keyframes), dtype=np.int64)
        for index, keyframe in enumerate(keyframes):
            times[index] = keyframe.index
            points = points_of_keyframe(_points_of(keyframe), self._config)
            if len(points):
                views[index] = transform_points(poses[index], points.mean(axis=0)[None])
        # Of keyframes that saw nothing nothing can be compared.
        kept = np.flatnonzero(np.isfinite(views[:, 0]))
        tree = KDTree(views[kept])
        # Neighbours in time look at the same places: few are needed at once.
        seen = lru_cache(_SEEN)(lambda index: self._seen(keyframes[index]))
        windows = lru_cache(_WINDOWS)(lambda middle: self._window(middle, seen, poses, times))
        ties = []
        for index in map(int, kept):
            sweep = self._sweep(seen(index), keyframes[index])
            near = kept[tree.query_ball_point(views[index], _NEAR_M)]
            for other in self._other_times(index, near, views, times):
                tie = self._tie(windows(other), sweep, inverse(poses[other]) @ poses[index])
                if tie is not None:
                    ties.append(Factor(other, index, tie))
        return ties

    def _other_times(
        self,
        index: int,
        near: npt.NDArray[np.intp],
        views: FloatArray,
        times: npt.NDArray[np.int64],
    ) -> list[int]:
        """Return the keyframe with the nearest view of each earlier time, the nearest first.

        Where visits were forgotten, neighbours in the list are not neighbours in time.
        """
        earlier = np.sort(near[times[near] < times[index] - self._gap])
        if not len(earlier):
            return []
        nearest = []
        for time in np.split(earlier, np.flatnonzero(np.diff(times[earlier]) > self._gap) + 1):
            distances = np.linalg.norm(views[time] - views[index], axis=1)
            best = int(np.argmin(distances))
            middle = int(time[best]) // _STRIDE * _STRIDE
            while not _is_unbroken(times, middle, int(time[best])):
                middle += 1
            nearest.append((float(distances[best]), middle))
        return [other for _, other in sorted(nearest)[:_MOST_TIMES]]

    def _tie(self, window: LocalMap, sweep: Sweep, expected: Pose) -> GaussianPose | None:
        wide = isotropic_covariance(sigma_rad=_SIGMA_RAD, sigma_m=_SIGMA_M)
        near = confined(wide, is_planar=self._is_planar)
        fit = window.fit(sweep, GaussianPose(expected, near), certain(identity()), expected)
        moved_m, moved_rad = apart(expected, fit.pose)
        is_near = moved_m <= _MOST_M and moved_rad <= _MOST_RAD
        if not (fit.is_converged and is_near and fit.inlier_share >= _LEAST_SHARE):
            return None
        floor = isotropic_covariance(sigma_rad=_FLOOR_RAD, sigma_m=_FLOOR_M)
        return GaussianPose(
            fit.pose, confined(fit.own_covariance + floor, is_planar=self._is_planar)
        )

    def _seen(self, keyframe: Keyframe) -> SeenPoints:
        points = _points_of(keyframe)
        return SeenPoints.of_keyframe(points, keyframe.sensor_in_body, self._config)

    def _sweep(self, seen: SeenPoints, keyframe: Keyframe) -> Sweep:
        points = seen.points
        sweep = Sweep(points, np.zeros(len(points)), keyframe.sensor_in_body - points)
        if self._is_planar:
            return sweep
        odometry = self._config.odometry
        return sweep.thinned(odometry.voxel_size_m, odometry.max_points)

    def _window(
        self,
        middle: int,
        seen: Callable[[int], SeenPoints],
        poses: FloatArray,
        times: npt.NDArray[np.int64],
    ) -> LocalMap:
        around = range(max(0, middle - _WINDOW), min(len(poses), middle + _WINDOW + 1))
        indices = [i for i in around if _is_unbroken(times, i, middle)]
        relative = [inverse(poses[middle]) @ poses[index] for index in indices]
        return LocalMap.of(
            SeenPoints.together(relative, [seen(index) for index in indices]),
            self._config,
            sigma_m=self._config.covariance.sigma_m,
        )


def _points_of(keyframe: Keyframe) -> FloatArray:
    return np.ascontiguousarray(keyframe.points_in_body, dtype=np.float64)


def _is_unbroken(times: npt.NDArray[np.int64], first: int, second: int) -> bool:
    """Return whether no keyframe between two of a list was left out of it."""
    return bool(times[second] - times[first] == second - first)


def _motions(keyframes: Iterable[Keyframe], carried: Collection[int]) -> list[Factor]:
    """Return the motions between neighbours, unless the robot was carried to the second.

    What is wrong with a keyframe alone is in the motions to and from it; here both have it, as if
    apart: the trajectory then bends a little more freely to the ties, which hold it better.
    """
    return [
        Factor(before, before + 1, keyframe.previous_from_body)
        for before, (last, keyframe) in enumerate(pairwise(keyframes))
        if keyframe.index == last.index + 1 and before + 1 not in carried
    ]


def _alignments(
    hypothesis: Hypothesis, visits: Visits, first_of: Mapping[int, int]
) -> list[Factor]:
    """Return what ties visits to others than their neighbours, between their first keyframes.

    Where the odometry was lost between two visits, nothing else says where the second is.
    """
    lost = {visit for visit in first_of if visits[visit].keyframes[0].failure is not None}
    return [
        Factor(first_of[factor.visit_a], first_of[factor.visit_b], factor.a_from_b)
        for factor in hypothesis.graph.factors
        if factor.visit_b != factor.visit_a + 1 or factor.visit_b in lost
    ]


def _one_per_pair(factors: Sequence[Factor]) -> list[Factor]:
    """Return the last factor of each pair of keyframes: two of one pair say the same twice."""
    return list({(factor.visit_a, factor.visit_b): factor for factor in factors}.values())


def _distance2(tie: Factor, poses: FloatArray) -> float:
    return tie.a_from_b.mahalanobis2(inverse(poses[tie.visit_a]) @ poses[tie.visit_b])
