"""All visits of a map: where they are, and what is kept of them.

What a robot sees again and again need not be kept again and again. The visits that founded areas,
and some more to each, keep their scans; of a later one that shows nothing new only the path stays.

References:
    Blanco et al. 2008, sections IV-D and V (the memory must not grow with the length of the path).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hmt_service.core.area_abstraction import cells_of
from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray, GaussianPose, Pose, inverse, transform_points
from hmt_service.core.submap import Visit, visit_of
from hmt_service.core.types import NO_POINTS, Keyframe, TrackingFailure

_UPPER = np.triu_indices(6)


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """What stays of a visit whose scans are forgotten: about 400 bytes per keyframe."""

    visit: int
    first_keyframe: int
    stamps_s: FloatArray
    sensors_in_body: FloatArray
    motions: FloatArray
    """Means of the motions since the keyframe before, shape (K, 3, 4)."""
    covariances: FloatArray
    """Of these, and of the keyframes alone: upper halves in single precision, shape (K, 2, 21)."""
    failures: tuple[TrackingFailure | None, ...]
    config: Config

    @classmethod
    def of(cls, visit: Visit) -> _Path:
        keyframes = visit.keyframes
        covariances = np.array(
            [[k.previous_from_body.covariance[_UPPER], k.own_error[_UPPER]] for k in keyframes]
        )
        return cls(
            visit.visit,
            visit.first_keyframe,
            np.array([k.stamp_s for k in keyframes]),
            np.array([k.sensor_in_body for k in keyframes], dtype=np.float32),
            np.array([k.previous_from_body.mean[:3] for k in keyframes]),
            covariances.astype(np.float32),
            tuple(k.failure for k in keyframes),
            visit.config,
        )

    def as_visit(self) -> Visit:
        """Return the visit, as one that saw nothing."""
        keyframes = [self._keyframe(position) for position in range(len(self.stamps_s))]
        return visit_of(self.visit, keyframes, self.config)

    def _keyframe(self, position: int) -> Keyframe:
        covariance, own_error = np.zeros((2, 6, 6))
        for matrix, half in zip((covariance, own_error), self.covariances[position], strict=True):
            matrix[_UPPER] = half
            matrix.T[_UPPER] = half
        motion = np.vstack([self.motions[position], [0.0, 0.0, 0.0, 1.0]])
        return Keyframe(
            index=self.first_keyframe + position,
            stamp_s=float(self.stamps_s[position]),
            points_in_body=NO_POINTS,
            sensor_in_body=self.sensors_in_body[position].astype(np.float64),
            previous_from_body=GaussianPose(motion, covariance),
            own_error=own_error,
            failure=self.failures[position],
        )


class Visits(Mapping[int, Visit]):
    """All visits by their numbers, in time order, and where each lies in its own frame."""

    def __init__(self, visits: Iterable[Visit] = ()) -> None:
        """Take some visits, numbered from 0."""
        self._visits: list[Visit | _Path] = []
        self._extents = np.zeros((0, 5))
        for visit in visits:
            self.put(visit)

    def __getitem__(self, visit: int) -> Visit:
        """Return one visit; if it was forgotten, as one that saw nothing."""
        kept = self._visits[visit]
        return kept.as_visit() if isinstance(kept, _Path) else kept

    def __iter__(self) -> Iterator[int]:
        """Iterate over the numbers."""
        return iter(range(len(self._visits)))

    def __len__(self) -> int:
        """Return the number of visits."""
        return len(self._visits)

    def put(self, visit: Visit) -> None:
        """Add the next visit, or replace one that has become longer or shorter."""
        if visit.visit == len(self._visits):
            self._visits.append(visit)
        else:
            self._visits[visit.visit] = visit
            self._extents = self._extents[: visit.visit]

    def keyframes(self, visit: int) -> int:
        """Return the number of keyframes of a visit."""
        kept = self._visits[visit]
        return len(kept.stamps_s if isinstance(kept, _Path) else kept.keyframes)

    def is_forgotten(self, visit: int) -> bool:
        """Return whether of a visit only the path is left."""
        return isinstance(self._visits[visit], _Path)

    def forget(self, visit: int) -> None:
        """Keep the path of a visit only."""
        self.extents(visit + 1)
        self._visits[visit] = _Path.of(self[visit])

    def extents(self, count: int) -> FloatArray:
        """Return centre, radius and reach of the first so many visits, shape (count, 5), m."""
        new = [
            [*visit.centre, visit.radius_m, visit.reach_m]
            for visit in map(self.__getitem__, range(len(self._extents), count))
        ]
        if new:
            self._extents = np.concatenate([self._extents, new])
        return self._extents[:count]


def share_new(visit: Visit, others: Iterable[Visit], poses: FloatArray) -> float:
    """Return the share of the cells of a visit that no other has points in, in [0, 1].

    Args:
        visit: The visit.
        others: Visits that it is compared with.
        poses: Those of all visits by their numbers, in one frame, shape (V, 4, 4).
    """
    cell_m = visit.config.areas.cell_size_m
    seen = cells_of(visit.points, cell_m)
    if not len(seen):
        return 0.0
    here = inverse(poses[visit.visit])
    known = [cells_of(other.points_in(here @ poses[other.visit]), cell_m) for other in others]
    return float(np.mean(~np.isin(seen, np.concatenate(known)))) if known else 1.0


def gaps_m(visit: Visit, here: Pose, poses: FloatArray, extents: FloatArray) -> FloatArray:
    """Return how far keyframes of a visit are from those of others at least, shape (N,), m.

    Args:
        visit: The visit.
        here: Its pose.
        poses: Those of the others, in the same frame, shape (N, 4, 4).
        extents: Those of the others, shape (N, 5).
    """
    centres = np.einsum("nij,nj->ni", poses[:, :3, :3], extents[:, :3]) + poses[:, :3, 3]
    offsets = centres - transform_points(here, visit.centre[None])
    return np.asarray(np.linalg.norm(offsets, axis=1) - extents[:, 3] - visit.radius_m)
