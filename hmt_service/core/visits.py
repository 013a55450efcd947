"""All visits of a map: where they are, and what is kept of them.

What a robot sees again and again need not be kept again and again. The visits that founded areas,
and some more to each, keep their scans; of a later one that shows nothing new only the path stays,
and what it says of the areas around it is in their arcs. Where memory has a budget, the visits used
longest ago are put on a shelf, and taken from it when they are needed.

References:
    Blanco et al. 2008, sections IV-D and V (the memory must not grow with the length of the path).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from hmt_service.core.chunked import Chunked
from hmt_service.core.config import Config
from hmt_service.core.footprint import footprint_bytes
from hmt_service.core.geometry import (
    PLANAR_AXES,
    FloatArray,
    GaussianPose,
    Pose,
    confined,
    inverse,
    transform_points,
)
from hmt_service.core.submap import Visit, visit_of
from hmt_service.core.types import NO_POINTS, Keyframe, TrackingFailure
from hmt_service.errors import InvalidInput, Unavailable


class Shelf(Protocol):
    """Where the keyframes of visits are that memory has no room for."""

    @property
    def size_bytes(self) -> int:
        """What lies there."""

    def put(self, visit: int, keyframes: Sequence[Keyframe]) -> None:
        """Keep the keyframes of a visit."""

    def get(self, visit: int) -> tuple[Keyframe, ...]:
        """Return them, the same in every bit."""


@dataclass(frozen=True, slots=True)
class MemoryBudget:
    """How much of the map may be in memory."""

    size_bytes: int
    """What visits may take; those in use at the moment are there even if they take more."""
    shelf: Shelf
    """Where the others are."""

    def __post_init__(self) -> None:
        """Refuse a budget that what is always in use would not fit into.

        Raises:
            InvalidInput: If it is below `LEAST_BUDGET_BYTES`.
        """
        if self.size_bytes < LEAST_BUDGET_BYTES:
            raise InvalidInput(
                f"a memory budget of {self.size_bytes / 1e6:g} MB is too small: the areas that the "
                f"robot is among take {LEAST_BUDGET_BYTES / 1e6:g} MB"
            )


@dataclass(frozen=True, slots=True)
class MemoryUsage:
    """How much of a budget is used."""

    held_bytes: int
    """What visits take in memory."""
    shelf_bytes: int
    """What is on the shelf, also of visits that are in memory again."""


LEAST_BUDGET_BYTES = 32_000_000
"""The open visit and the candidates that it is compared with."""
# Surfels and views take several times what the points do: of so many visits they are kept, the last
# used.
_READY = 24


@dataclass(frozen=True, slots=True, eq=False)
class _Path:
    """What stays of a visit that is forgotten: 100 to 170 bytes per keyframe."""

    visit: int
    first_keyframe: int
    stamps_s: FloatArray
    sensors_in_body: FloatArray
    motions: FloatArray
    """Motions since the keyframe before in single precision, shape (K, 3, 4)."""
    covariances: FloatArray
    """Of these: upper halves in single precision, shape (K, 6) in the plane, (K, 21) in space."""
    failures: tuple[TrackingFailure | None, ...]
    config: Config

    @classmethod
    def of(cls, visit: Visit) -> _Path:
        keyframes, upper = visit.keyframes, _upper(visit.config)
        return cls(
            visit.visit,
            visit.first_keyframe,
            np.array([k.stamp_s for k in keyframes]),
            np.array([k.sensor_in_body for k in keyframes], dtype=np.float32),
            np.array([k.previous_from_body.mean[:3] for k in keyframes], dtype=np.float32),
            np.array([k.previous_from_body.covariance[upper] for k in keyframes], dtype=np.float32),
            tuple(k.failure for k in keyframes),
            visit.config,
        )

    @property
    def last_stamp_s(self) -> float:
        return float(self.stamps_s[-1])

    def as_visit(self) -> Visit:
        """Return the visit, as one that saw nothing."""
        upper = _upper(self.config)
        keyframes = [self._keyframe(position, upper) for position in range(len(self.stamps_s))]
        return visit_of(self.visit, keyframes, self.config)

    def _keyframe(self, position: int, upper: tuple[np.ndarray, np.ndarray]) -> Keyframe:
        covariance = np.zeros((6, 6))
        covariance[upper] = self.covariances[position]
        covariance = confined(
            covariance + np.triu(covariance, 1).T, is_planar=self.config.sensor.is_planar
        )
        motion = np.vstack([self.motions[position], [0.0, 0.0, 0.0, 1.0]])
        return Keyframe(
            index=self.first_keyframe + position,
            stamp_s=float(self.stamps_s[position]),
            points_in_body=NO_POINTS,
            sensor_in_body=self.sensors_in_body[position].astype(np.float64),
            previous_from_body=GaussianPose(motion, covariance),
            own_error=np.zeros((6, 6)),
            failure=self.failures[position],
        )


@dataclass(frozen=True, slots=True)
class _Shelved:
    """What stays in memory of a visit on the shelf."""

    visit: int
    count: int
    last_stamp_s: float
    config: Config
    shelf: Shelf

    @property
    def keyframes(self) -> tuple[Keyframe, ...]:
        return self.shelf.get(self.visit)


def _upper(config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of what a covariance consists of."""
    axes = PLANAR_AXES if config.sensor.is_planar else np.arange(6)
    rows, columns = np.triu_indices(len(axes))
    return axes[rows], axes[columns]


class Visits(Mapping[int, Visit]):
    """All visits by their numbers, in time order, and where each lies in its own frame."""

    def __init__(self, visits: Iterable[Visit] = (), *, budget: MemoryBudget | None = None) -> None:
        """Take some visits, numbered from 0.

        Args:
            visits: The visits.
            budget: How many may be in memory; None for all of them.
        """
        self._visits: list[Visit | _Path | _Shelved] = []
        self._extents = np.zeros((0, 5))
        self._budget = budget
        # Size of what is in memory, the last used last; what was used since may have grown.
        self._sizes: dict[int, int] = {}
        self._used = set[int]()
        self._on_shelf = set[int]()
        self._failure: str | None = None
        self._ready: dict[int, Visit] = {}
        for visit in visits:
            self.put(visit)

    def __getitem__(self, visit: int) -> Visit:
        """Return one visit; if it was forgotten, as one that saw nothing."""
        kept = self._visits[visit]
        if isinstance(kept, _Path):
            return kept.as_visit()
        if isinstance(kept, _Shelved):
            kept = self._visits[visit] = visit_of(visit, kept.keyframes, kept.config)
            self._use(kept)
            self._make_room()
        else:
            self._use(kept)
        return kept

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
        self._use(visit)
        self._make_room()

    def _use(self, visit: Visit) -> None:
        """Note that a visit is the last used one."""
        self._ready.pop(visit.visit, None)
        self._ready[visit.visit] = visit
        if len(self._ready) > _READY:
            self._ready.pop(next(iter(self._ready))).rest()
        if self._budget is not None:
            self._sizes[visit.visit] = self._sizes.pop(visit.visit, 0)
            self._used.add(visit.visit)

    def _make_room(self) -> None:
        """Put what was not used for the longest time on the shelf, but for the last two visits.

        What does not fit there stays: a budget is worth less than the map.
        """
        if self._budget is None:
            return
        for visit in self._used:
            self._sizes[visit] = footprint_bytes(self._visits[visit])
        total, last = sum(self._sizes.values()), next(reversed(self._sizes))
        self._used = {last}
        for visit in list(self._sizes):
            if total <= self._budget.size_bytes:
                break
            if visit != last and visit < len(self._visits) - 2:
                size = self._sizes[visit]
                try:
                    self._put_away(visit)
                except Unavailable as error:
                    self._failure = str(error)
                    return
                total -= size
        self._failure = None

    def _put_away(self, visit: int) -> None:
        kept = self._visits[visit]
        assert isinstance(kept, Visit), "what is on the shelf or forgotten has no size"
        assert self._budget is not None, "without a budget there is room"
        if visit not in self._on_shelf:
            self._budget.shelf.put(visit, kept.keyframes)
            self._on_shelf.add(visit)
        self._visits[visit] = _Shelved(
            visit, len(kept.keyframes), kept.last_stamp_s, kept.config, self._budget.shelf
        )
        self._drop(visit)

    def _drop(self, visit: int) -> None:
        """Have nothing of a visit in memory but what is in its place."""
        self._sizes.pop(visit, None)
        self._used.discard(visit)
        self._ready.pop(visit, None)

    @property
    def usage(self) -> MemoryUsage | None:
        """What they take; None without a budget: nobody has counted."""
        if self._budget is None:
            return None
        return MemoryUsage(sum(self._sizes.values()), self._budget.shelf.size_bytes)

    @property
    def failure(self) -> str | None:
        """Why more is in memory than the budget allows, if the shelf takes no more."""
        return self._failure

    def keyframes(self, visit: int) -> int:
        """Return the number of keyframes of a visit."""
        kept = self._visits[visit]
        if isinstance(kept, _Path):
            return len(kept.stamps_s)
        return kept.count if isinstance(kept, _Shelved) else len(kept.keyframes)

    def all_keyframes(self) -> Sequence[Keyframe]:
        """Return the keyframes of all visits as they are now, in time order."""
        kept = tuple(self._visits)

        def of(visit: int) -> Sequence[Keyframe]:
            now = kept[visit]
            return now.as_visit().keyframes if isinstance(now, _Path) else now.keyframes

        return Chunked([self.keyframes(visit) for visit in self], of)

    def last_stamp_s(self, visit: int) -> float:
        """Return the sensor time of the last keyframe of a visit."""
        return self._visits[visit].last_stamp_s

    def is_forgotten(self, visit: int) -> bool:
        """Return whether of a visit only the path is left."""
        return isinstance(self._visits[visit], _Path)

    def forget(self, visit: int) -> None:
        """Keep the path of a visit only."""
        self.extents(visit + 1)
        self._visits[visit] = _Path.of(self[visit])
        self._drop(visit)

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
    """Return the share of the points of a visit that none of another is near to, in [0, 1].

    Args:
        visit: The visit.
        others: Visits that it is compared with.
        poses: Those of all visits by their numbers, in one frame, shape (V, 4, 4).
    """
    near_m = visit.config.areas.cell_size_m
    if not len(visit.points):
        return 0.0
    here = inverse(poses[visit.visit])
    known = [other.points_in(here @ poses[other.visit]) for other in others]
    if not known:
        return 1.0
    distances, _ = KDTree(np.concatenate(known)).query(visit.points, distance_upper_bound=near_m)
    return float(np.mean(np.isinf(distances)))


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
