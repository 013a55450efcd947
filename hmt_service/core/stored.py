"""Everything that must survive the process: the engine's state as plain values.

Whatever else the engine holds (submaps, graphs, indices) can be computed from these.

References:
    Blanco et al. 2008, section III (areas, arcs), Eq. (14) (hypotheses and their weights).
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from hmt_service.core.chunked import Chunked
from hmt_service.core.config import Config, hash_of
from hmt_service.core.geometry import GaussianPose, Pose, exp, log
from hmt_service.core.types import Keyframe
from hmt_service.errors import InvalidInput

# Scans whose poses are computed at once.
_TOGETHER = 1024


@dataclass(frozen=True, slots=True)
class StoredVisit:
    """Consecutive keyframes that belong to one area; the first of them is the anchor."""

    visit: int
    """Identifier."""
    first_keyframe: int
    """Index of the first keyframe, the anchor."""
    last_keyframe: int
    """Index of the last keyframe, included."""
    is_forgotten: bool = False
    """Whether of what it has seen nothing is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredAssignment:
    """Which area a visit went to, in one hypothesis."""

    visit: int
    """The visit."""
    area: int
    """The area."""
    area_from_visit: GaussianPose | None
    """Pose of the visit's anchor inside the area; None: the visit founded the area."""
    is_carried: bool = False
    """Whether the robot was carried there: the motion since the visit before says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredFactor:
    """One independent measurement between the anchors of two visits."""

    visit_a: int
    """The visit that the measurement starts from."""
    visit_b: int
    """The visit that it leads to."""
    a_from_b: GaussianPose
    """Measured relative pose of the anchors."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredHypothesis:
    """One topology with its graph."""

    hypothesis: int
    """Identifier, unique in a run."""
    log_weight: float
    """Logarithm of its posterior mass; the masses of all hypotheses sum to one."""
    assignments: tuple[StoredAssignment, ...]
    """The area of every visit, in the order of the visits: the topological path."""
    reference_from_visit: Mapping[int, Pose]
    """Optimised pose of every visit's anchor, shape (4, 4)."""
    factors: tuple[StoredFactor, ...]
    """The graph, in the order of their visits."""

    @property
    def eliminated(self) -> frozenset[int]:
        """Visits that no arc leads to: what they said is in the arcs of their areas."""
        tied = {0, *(f.visit_a for f in self.factors), *(f.visit_b for f in self.factors)}
        return frozenset(self.reference_from_visit) - tied


@dataclass(frozen=True, slots=True, eq=False)
class StoredScan:
    """Where one scan was taken, relative to a keyframe: enough for the whole trajectory."""

    stamp_s: float
    """Sensor time."""
    keyframe_index: int
    """Keyframe that the pose is relative to."""
    keyframe_from_body: Pose
    """Pose of the scan relative to that keyframe, shape (4, 4)."""


class ScanLog:
    """Scans as they come, 36 bytes each: how far they are from keyframes, in single precision."""

    def __init__(self) -> None:
        """Start empty."""
        self._stamps_s = array("d")
        self._keyframes = array("i")
        self._tangents = array("f")

    def __len__(self) -> int:
        """Return the number of scans."""
        return len(self._stamps_s)

    def append(self, stamp_s: float, keyframe_index: int, keyframe_from_body: Pose) -> None:
        """Add the next scan."""
        self._stamps_s.append(stamp_s)
        self._keyframes.append(keyframe_index)
        self._tangents.extend(log(keyframe_from_body))

    def extend(self, scans: Sequence[StoredScan]) -> None:
        """Add scans in the order that they came, at least one."""
        self._stamps_s.extend(scan.stamp_s for scan in scans)
        self._keyframes.extend(scan.keyframe_index for scan in scans)
        poses = np.stack([scan.keyframe_from_body for scan in scans])
        self._tangents.extend(log(poses).astype(np.float32).ravel().tolist())

    def scans(self) -> Sequence[StoredScan]:
        """Return the scans so far, in the order that they came."""
        full, rest = divmod(len(self._stamps_s), _TOGETHER)
        return Chunked([_TOGETHER] * full + [rest], self._chunk)

    def between(self, start_s: float, end_s: float) -> list[StoredScan]:
        """Return the scans of an interval of sensor time, both ends included."""
        stamps_s = np.array(self._stamps_s)
        inside = np.flatnonzero((stamps_s >= start_s) & (stamps_s <= end_s))
        tangents = np.array(self._tangents, dtype=np.float64).reshape(-1, 6)[inside]
        keyframes = [self._keyframes[scan] for scan in inside]
        return list(map(StoredScan, stamps_s[inside].tolist(), keyframes, exp(tangents)))

    def _chunk(self, chunk: int) -> list[StoredScan]:
        part = slice(chunk * _TOGETHER, (chunk + 1) * _TOGETHER)
        tangents = self._tangents[6 * part.start : 6 * part.stop]
        poses = exp(np.array(tangents, dtype=np.float64).reshape(-1, 6))
        return list(map(StoredScan, self._stamps_s[part], self._keyframes[part], poses))


@dataclass(frozen=True, slots=True, eq=False)
class StoredMap:
    """A whole map: enough to answer every question about it, and to go on mapping."""

    revision: int
    """Map revision: grows with every change."""
    seed: int
    """Seed of the random generator of the run."""
    config_json: str
    """All settings, as `Config.model_dump_json` writes them."""
    keyframes: Sequence[Keyframe]
    """In the order of their indices."""
    visits: tuple[StoredVisit, ...]
    """In the order that they were made."""
    hypotheses: tuple[StoredHypothesis, ...]
    """All hypotheses that are alive, in the engine's order."""
    scans: Sequence[StoredScan]
    """In the order that they came."""

    @property
    def config_hash(self) -> str:
        """`Config.hash` of the settings, as the version that has written them computes it."""
        return hash_of(self.config_json)

    @property
    def config(self) -> Config:
        """The settings.

        Raises:
            InvalidInput: If they are not those of this version.
        """
        try:
            return Config.model_validate_json(self.config_json)
        except ValidationError as error:
            raise InvalidInput(f"the map's settings are not of this version: {error}") from error
