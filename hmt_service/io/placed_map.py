"""A stored map as one hypothesis sees it: every visit, keyframe and scan in one frame.

References:
    Blanco et al. 2008, section IV-C (the globally consistent map).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, transform_points
from hmt_service.core.stored import StoredHypothesis, StoredMap
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput, NotFound, Unavailable

if TYPE_CHECKING:
    from hmt_service.core.submap import Visit


@dataclass(frozen=True, eq=False)
class PlacedMap:
    """One hypothesis of a stored map in the frame of one of its areas."""

    stored: StoredMap
    """The map."""
    config: Config
    """Its settings."""
    hypothesis: StoredHypothesis
    """The hypothesis."""
    reference_area: int
    """The area whose frame everything is in."""
    reference_from_visit: Mapping[int, Pose]
    """Pose of every visit's anchor, shape (4, 4)."""

    @classmethod
    def of(
        cls, stored: StoredMap, *, hypothesis: int | None = None, reference_area: int | None = None
    ) -> PlacedMap:
        """Place a map.

        Args:
            stored: The map.
            hypothesis: Identifier; None for the most probable one.
            reference_area: Area whose frame is used; None for the first one.

        Raises:
            Unavailable: If the map is empty.
            NotFound: If there is no such hypothesis or area.
            InvalidInput: If the settings are not of this version, or visits have no place.
        """
        chosen = _hypothesis(stored, hypothesis)
        areas = [a.area for a in chosen.assignments if a.area_from_visit is None]
        reference = areas[0] if reference_area is None else reference_area
        if reference not in areas:
            raise NotFound(
                f"area {reference} is not in hypothesis {chosen.hypothesis}, "
                f"which has {len(areas)} areas: {areas}"
            )
        if missing := {v.visit for v in stored.visits} - set(chosen.reference_from_visit):
            raise InvalidInput(f"visits {sorted(missing)} have no pose: the map is damaged")
        area_from_first = inverse(chosen.reference_from_visit[reference])
        poses = {v: area_from_first @ pose for v, pose in chosen.reference_from_visit.items()}
        return cls(stored, stored.config, chosen, reference, poses)

    @cached_property
    def reference_from_keyframe(self) -> FloatArray:
        """Pose of every keyframe by its index, shape (K, 4, 4)."""
        poses = []
        for visit in self.stored.visits:
            pose = self.reference_from_visit[visit.visit] @ identity()
            poses.append(pose)
            for keyframe in self.stored.keyframes[
                visit.first_keyframe + 1 : visit.last_keyframe + 1
            ]:
                pose = pose @ keyframe.previous_from_body.mean
                poses.append(pose)
        return np.array(poses).reshape(-1, 4, 4)

    def trajectory(self) -> tuple[StampedPose, ...]:
        """Return the pose of every scan, in time order."""
        poses = self.reference_from_keyframe
        return tuple(
            StampedPose(scan.stamp_s, poses[scan.keyframe_index] @ scan.keyframe_from_body)
            for scan in self.stored.scans
            if scan.keyframe_index < len(poses)
        )

    @cached_property
    def visits(self) -> tuple[Visit, ...]:
        """All visits with their submaps, in time order."""
        # Loads the compiler of the core, which tables and trajectories need not wait for.
        from hmt_service.core.submap import visit_of

        keyframes = self.stored.keyframes
        return tuple(
            visit_of(v.visit, keyframes[v.first_keyframe : v.last_keyframe + 1], self.config)
            for v in self.stored.visits
        )

    @cached_property
    def area_of(self) -> dict[int, int]:
        """The area of every visit."""
        return {a.visit: a.area for a in self.hypothesis.assignments}

    def points_in_areas(self) -> dict[int, FloatArray]:
        """Return the submap of every area in the reference frame, shape (N, 3) each, m."""
        clouds: dict[int, list[FloatArray]] = {}
        for visit in self.visits:
            points = transform_points(self.reference_from_visit[visit.visit], visit.points)
            clouds.setdefault(self.area_of[visit.visit], []).append(points)
        return {area: np.concatenate(of_area) for area, of_area in sorted(clouds.items())}

    def submaps(self) -> dict[int, FloatArray]:
        """Return the submap of every area in its own frame, shape (N, 3) each, m."""
        return {
            area: transform_points(inverse(self.reference_from_visit[area]), points)
            for area, points in self.points_in_areas().items()
        }

    def points(self) -> FloatArray:
        """Return the submaps of all areas in the reference frame, shape (N, 3), m."""
        return np.concatenate(list(self.points_in_areas().values()))


def _hypothesis(stored: StoredMap, hypothesis: int | None) -> StoredHypothesis:
    if not stored.hypotheses or not stored.keyframes:
        raise Unavailable(
            f"the map is empty: {len(stored.hypotheses)} hypotheses, {len(stored.keyframes)} "
            "keyframes"
        )
    if hypothesis is None:
        return max(stored.hypotheses, key=lambda h: h.log_weight)
    for candidate in stored.hypotheses:
        if candidate.hypothesis == hypothesis:
            return candidate
    identifiers = [h.hypothesis for h in stored.hypotheses]
    raise NotFound(f"hypothesis {hypothesis} is not one of {identifiers}")
