"""What a map file holds, in a few numbers; points are counted without being read.

References:
    own.
"""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from itertools import pairwise
from math import exp
from pathlib import Path

import numpy as np
import zstandard

from hmt_service.core.config import Preset, load_config
from hmt_service.core.stored import StoredHypothesis
from hmt_service.io.map_file import opened
from hmt_service.io.map_rows import read_rows
from hmt_service.io.placed_map import PlacedMap

_POINT_BYTES = 12
# The head of a compressed blob says how large its content is.
_HEAD_BYTES = 18


@dataclass(frozen=True, slots=True)
class HypothesisInfo:
    """One topology of a map."""

    hypothesis: int
    """Identifier."""
    probability: float
    """Posterior mass."""
    areas: int
    """Number of areas."""
    arcs: int
    """Number of pairs of areas that the robot has gone between directly."""
    loop_closures: int
    """Number of times that a known area was entered again."""


@dataclass(frozen=True, slots=True)
class MapInfo:
    """What a map file holds."""

    file_bytes: int
    """Size of the file."""
    schema_version: int
    """Version of its tables."""
    created_by: str
    """Program that wrote it, with its version."""
    revision: int
    """Map revision: grows with every change."""
    seed: int
    """Seed of the run."""
    preset: str | None
    """Preset that its settings are, None if they are others."""
    config_hash: str
    """Twelve digits that change when any setting does."""
    sensor: str
    """`planar` or `3-D`."""
    scans: int
    """Number of scans."""
    keyframes: int
    """Number of scans that were kept."""
    visits: int
    """Number of visits to areas."""
    points: int
    """Number of points of all keyframes."""
    point_resolution_m: float
    """Edge of the grid that they are rounded to."""
    first_stamp_s: float | None
    """Sensor time of the first scan."""
    last_stamp_s: float | None
    """Sensor time of the last scan."""
    length_m: float
    """Length of the path over all scans, in the most probable topology."""
    hypotheses: tuple[HypothesisInfo, ...]
    """All of them, the most probable first."""


def map_info(path: Path) -> MapInfo:
    """Return what a map file holds.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
        Unavailable: If it cannot be read now.
    """
    with opened(path) as database:
        stored = read_rows(database, with_points=False)
        meta = dict(database.execute("SELECT key, value FROM meta"))
        (version,) = database.execute("PRAGMA user_version").fetchone()
        points = _points(database)
        created_by, resolution_m = meta["created_by"], float(meta["point_resolution_m"])
    placed = PlacedMap.of(stored)
    config = placed.config
    stamps_s = [scan.stamp_s for scan in stored.scans]
    positions = np.array([pose.reference_from_body[:3, 3] for pose in placed.trajectory()])
    steps_m = np.linalg.norm(np.diff(positions.reshape(-1, 3), axis=0), axis=1)
    ordered = sorted(stored.hypotheses, key=lambda h: -h.log_weight)
    return MapInfo(
        file_bytes=path.stat().st_size,
        schema_version=version,
        created_by=created_by,
        revision=stored.revision,
        seed=stored.seed,
        preset=next((preset.value for preset in Preset if load_config(preset) == config), None),
        config_hash=config.hash(),
        sensor="planar" if config.sensor.is_planar else "3-D",
        scans=len(stored.scans),
        keyframes=len(stored.keyframes),
        visits=len(stored.visits),
        points=points,
        point_resolution_m=resolution_m,
        first_stamp_s=min(stamps_s, default=None),
        last_stamp_s=max(stamps_s, default=None),
        length_m=float(steps_m.sum()),
        hypotheses=tuple(map(_hypothesis_info, ordered)),
    )


def _hypothesis_info(hypothesis: StoredHypothesis) -> HypothesisInfo:
    path = [assignment.area for assignment in hypothesis.assignments]
    areas = sum(assignment.area_from_visit is None for assignment in hypothesis.assignments)
    return HypothesisInfo(
        hypothesis=hypothesis.hypothesis,
        probability=exp(hypothesis.log_weight),
        areas=areas,
        arcs=len({frozenset(pair) for pair in pairwise(path) if pair[0] != pair[1]}),
        loop_closures=len(path) - areas,
    )


def _points(database: sqlite3.Connection) -> int:
    """Return how many points all keyframes have, by the heads of their blobs."""
    total = 0
    for (row,) in database.execute("SELECT rowid FROM keyframes"):
        with database.blobopen("keyframes", "points_in_body", row, readonly=True) as blob:
            total += zstandard.frame_content_size(blob.read(_HEAD_BYTES)) // _POINT_BYTES
    return total
