"""Submaps: what one visit to an area has seen, in the visit's own frame.

A *visit* is one contiguous stay in an area. Visits are facts, cut from the sequence of observations
by the area abstraction and shared by all hypotheses; which area a visit was to is what hypotheses
disagree about.

References:
    Blanco et al. 2008, Proposition 1 and Eq. (4) (submaps are independent given the path).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from hmt_service.core.area_abstraction import Cells, cell_of_each, cells_of
from hmt_service.core.config import Config
from hmt_service.core.correlation import View
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    adjoint,
    certain,
    identity,
    symmetric,
    transform_points,
)
from hmt_service.core.local_map import LocalMap, SeenPoints, Sweep
from hmt_service.core.surfels import thin
from hmt_service.core.transients import without_transients
from hmt_service.core.types import Keyframe, Points

# Size of the cells that a submap keeps one point of, over those of the local map.
_SUBMAP_CELLS = 0.5
_NO_CELLS: Cells = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class News:
    """What a keyframe shows that none before it in its visit did.

    Two looks at one wall are not two pieces of evidence; and how well the known walls fit once more
    must not drown what the first look behind one of them says.
    """

    keyframe: Keyframe
    """The keyframe with those points only that are in cells that no keyframe before it saw."""
    share: float
    """Share of its points that these are, in [0, 1]."""


@dataclass(frozen=True, eq=False)
class Visit:
    """One contiguous stay in an area: a run of keyframes and the submap that they saw.

    Immutable; the visit that the robot is in is replaced by a longer one at each keyframe.
    """

    visit: int
    """Identifier, in order of time."""
    keyframes: tuple[Keyframe, ...]
    """The keyframes, in time order; the first is the visit's frame."""
    visit_from_keyframe: tuple[GaussianPose, ...]
    """Pose of each keyframe in the visit's frame."""
    cells: tuple[Cells, ...]
    """Cells that each keyframe saw, in the visit's frame."""
    config: Config
    """Settings of all stages."""

    @property
    def first_keyframe(self) -> int:
        """Index of the first keyframe."""
        return self.keyframes[0].index

    @property
    def last_keyframe(self) -> int:
        """Index of the last keyframe."""
        return self.keyframes[-1].index

    @property
    def last_stamp_s(self) -> float:
        """Sensor time of the last keyframe."""
        return self.keyframes[-1].stamp_s

    @cached_property
    def points(self) -> FloatArray:
        """Submap: what stood still, in the visit's frame, shape (N, 3), m.

        One point per cell of half a voxel.
        """
        return self.seen.points

    @property
    def seen(self) -> SeenPoints:
        """The submap, with the side that each point was seen from."""
        return self._submap[0]

    @cached_property
    def _submap(self) -> tuple[SeenPoints, npt.NDArray[np.int32]]:
        """The submap, and the position of the keyframe that saw each point."""
        cell_m, is_planar = self.config.odometry.voxel_size_m, self.config.sensor.is_planar
        poses = [pose.mean for pose in self.visit_from_keyframe]
        clouds = without_transients(self.keyframes, poses, self.config)
        sensors = [
            transform_points(pose, keyframe.sensor_in_body[None])[0]
            for keyframe, pose in zip(self.keyframes, poses, strict=True)
        ]
        seen = [
            SeenPoints.of(cloud, sensor, cell_m=cell_m, is_planar=is_planar)
            for cloud, sensor in zip(clouds, sensors, strict=True)
        ]
        whole = SeenPoints.together([identity()] * len(seen), seen)
        seen_by = np.repeat(np.arange(len(seen), dtype=np.int32), [len(s.points) for s in seen])
        kept = thin(whole.points, _SUBMAP_CELLS * cell_m)
        return SeenPoints(whole.points[kept], whole.directions[kept]), seen_by[kept]

    @cached_property
    def sweep(self) -> Sweep:
        """What of the submap is registered in others: one point per voxel, and not too many."""
        whole = Sweep(self.points, np.zeros(len(self.points)), self.seen.directions)
        odometry = self.config.odometry
        return whole.thinned(odometry.voxel_size_m, 2 * odometry.max_points)

    @cached_property
    def news(self) -> tuple[News, ...]:
        """What each keyframe shows that none before it did."""
        return tuple(map(self.news_of, range(len(self.keyframes))))

    def news_of(self, position: int) -> News:
        """Return what a keyframe shows that none before it did.

        Args:
            position: Its place in the visit, from 0.
        """
        keyframe, pose = self.keyframes[position], self.visit_from_keyframe[position]
        points = transform_points(pose.mean, keyframe.points_in_body)
        own = cell_of_each(points, self.config.areas.cell_size_m)
        is_new = np.isin(own, np.concatenate([_NO_CELLS, *self.cells[:position]]), invert=True)
        seen_first = replace(keyframe, points_in_body=keyframe.points_in_body[is_new])
        return News(seen_first, float(is_new.sum()) / max(len(is_new), 1))

    def points_in(self, frame_from_visit: Pose) -> FloatArray:
        """Return the submap in another frame, shape (N, 3), m."""
        return transform_points(frame_from_visit, self.points)

    def known_from(self, position: FloatArray) -> SeenPoints:
        """Return what of the submap is known from a place as well as a range is expected.

        Long visits are bent: what was seen early and late in one does not fit together everywhere.

        Args:
            position: The place in the visit's frame, shape (3,), m.
        """
        max_sigma_m = self.config.observation.hit_sigma_m
        positions, sigmas_m = self._positions
        nearest = np.argmin(np.linalg.norm(positions - position, axis=1))
        is_known = np.abs(sigmas_m**2 - sigmas_m[nearest] ** 2) <= max_sigma_m**2
        if np.all(is_known):
            return self.seen
        kept = is_known[self._submap[1]]
        return SeenPoints(self.points[kept], self.seen.directions[kept])

    @cached_property
    def _positions(self) -> tuple[FloatArray, FloatArray]:
        """Positions of the keyframes, shape (K, 3), and their standard deviations, (K,), m."""
        poses = self.visit_from_keyframe
        return np.array([p.mean[:3, 3] for p in poses]), np.array([p.sigma_m for p in poses])

    @cached_property
    def local_map(self) -> LocalMap:
        """The submap, ready to register others in it."""
        return LocalMap.of(self.seen, self.config, sigma_m=self.config.covariance.sigma_submap_m)

    @cached_property
    def view(self) -> View:
        """The submap seen from above, ready to be searched for others."""
        return View.of(
            self.seen.points, self.seen.directions, cell_m=self.config.alignment.raster_m
        )

    def rest(self) -> None:
        """Drop what takes several times the memory that the points do; it is made again."""
        for name in ("local_map", "view"):
            vars(self).pop(name, None)

    @cached_property
    def bend(self) -> FloatArray:
        """Covariance of the visit's frame where its content is known, shape (6, 6).

        What is aligned with another submap are the points that keyframes saw; how far the frame is
        from there is as uncertain as their poses in it are, on average.
        """
        moved = [
            adjoint(pose.mean) @ pose.covariance @ adjoint(pose.mean).T
            for pose in self.visit_from_keyframe
        ]
        return symmetric(np.mean(moved, axis=0))

    @cached_property
    def centre(self) -> FloatArray:
        """Middle of the keyframes' positions in the visit's frame, shape (3,), m."""
        positions = np.array([pose.mean[:3, 3] for pose in self.visit_from_keyframe])
        return np.asarray(0.5 * (positions.min(axis=0) + positions.max(axis=0)))

    @cached_property
    def radius_m(self) -> float:
        """Distance from the centre within which all keyframes were taken."""
        positions = np.array([pose.mean[:3, 3] for pose in self.visit_from_keyframe])
        return float(np.linalg.norm(positions - self.centre, axis=1).max())

    @cached_property
    def reach_m(self) -> float:
        """Distance from the centre within which nine in ten of the submap's points lie, or 0."""
        if not len(self.points):
            return 0.0
        return float(np.quantile(np.linalg.norm(self.points - self.centre, axis=1), 0.9))

    def with_keyframe(self, keyframe: Keyframe) -> Visit:
        """Return this visit, longer by one keyframe."""
        pose = _chained(self.visit_from_keyframe[-1], self.keyframes[-1], keyframe)
        return Visit(
            self.visit,
            (*self.keyframes, keyframe),
            (*self.visit_from_keyframe, pose),
            (*self.cells, _cells(keyframe, pose.mean, self.config)),
            self.config,
        )

    def split(self, first_of_new: int) -> tuple[Visit, Visit, GaussianPose]:
        """Return the earlier part, the later part as the next visit, and the motion between them.

        Args:
            first_of_new: Position, in this visit, of the first keyframe of the later part.
        """
        earlier = Visit(
            self.visit,
            self.keyframes[:first_of_new],
            self.visit_from_keyframe[:first_of_new],
            self.cells[:first_of_new],
            self.config,
        )
        later = visit_of(self.visit + 1, self.keyframes[first_of_new:], self.config)
        return earlier, later, earlier.motion_to(later)

    def motion_to(self, following: Visit) -> GaussianPose:
        """Return the motion from this visit's frame to that of the visit just after it."""
        return _chained(self.visit_from_keyframe[-1], self.keyframes[-1], following.keyframes[0])


def _chained(visit_from_last: GaussianPose, last: Keyframe, new: Keyframe) -> GaussianPose:
    """Return the pose of the keyframe after the last one, in the frame of the visit.

    What is wrong with the last keyframe alone was in its own pose, and is in the motion from it
    with opposite sign: it cancels. The first keyframe's own pose is exact by definition.
    """
    is_first = not np.any(visit_from_last.covariance)
    cancelled = 0.0 if is_first else 2.0 * last.own_error
    kept = GaussianPose(visit_from_last.mean, visit_from_last.covariance - cancelled)
    return kept @ new.previous_from_body


def visit_of(visit: int, keyframes: Sequence[Keyframe], config: Config) -> Visit:
    """Return a visit made of these keyframes, in the frame of the first of them."""
    poses = [certain(identity())]
    for last, keyframe in pairwise(keyframes):
        poses.append(_chained(poses[-1], last, keyframe))
    cells = tuple(
        _cells(keyframe, pose.mean, config) for keyframe, pose in zip(keyframes, poses, strict=True)
    )
    return Visit(visit, tuple(keyframes), tuple(poses), cells, config)


def _cells(keyframe: Keyframe, visit_from_keyframe: Pose, config: Config) -> Cells:
    points = transform_points(visit_from_keyframe, keyframe.points_in_body)
    return cells_of(points, config.areas.cell_size_m)


def as_points(points: FloatArray) -> Points:
    """Return points in the precision in which they are stored and served, shape (N, 3), m."""
    return points.astype(np.float32)
