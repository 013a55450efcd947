"""The map file `*.hmt`: a whole map in one SQLite database that any SQLite tool can open.

Poses are blobs of little-endian float64 and come back bit for bit: the upper three rows of the
matrix (12 numbers), then the 6x6 covariance where there is one (36 numbers), row by row. Points are
rounded to a grid whose resolution stands in `meta`, and compressed. Rows keep the tuples' order.
`meta` also holds a digest of everything else, which `map_check` compares.

References:
    own; https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import zstandard

from hmt_service import __version__
from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray, GaussianPose, Pose
from hmt_service.core.stored import (
    StoredAssignment,
    StoredFactor,
    StoredHypothesis,
    StoredMap,
    StoredScan,
    StoredVisit,
)
from hmt_service.core.types import NO_POINTS, Keyframe, Points, TrackingFailure
from hmt_service.errors import InvalidInput, NotFound, Unavailable

SCHEMA_VERSION = 3
"""Version of what is written, in `PRAGMA user_version`."""
_READABLE = (2, 3)
"""Versions that are read. In 3 there may be several sessions, and always a digest."""
POINT_RESOLUTION_M = 0.005
"""Edge of the grid that points are rounded to."""

TABLES = (
    "meta",
    "keyframes",
    "scans",
    "visits",
    "hypotheses",
    "assignments",
    "anchors",
    "factors",
)
"""All tables."""
DIGEST = "content_sha256"
"""Key in `meta` of what `content_digest` says of the rest."""

# Magic string, `PRAGMA user_version` and `PRAGMA application_id`.
_HEAD = struct.Struct(">60sI4xI")
_APPLICATION_ID = int.from_bytes(b"hmtm")
_COMPRESSION_LEVEL = 6
_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
CREATE TABLE keyframes (
    keyframe INTEGER NOT NULL UNIQUE, stamp_s REAL NOT NULL, sensor_in_body BLOB NOT NULL,
    previous_from_body BLOB NOT NULL, own_error BLOB NOT NULL, failure TEXT,
    points_in_body BLOB NOT NULL
) STRICT;
CREATE TABLE scans (
    stamp_s REAL NOT NULL, keyframe INTEGER NOT NULL, keyframe_from_body BLOB NOT NULL
) STRICT;
CREATE TABLE visits (
    visit INTEGER NOT NULL UNIQUE, first_keyframe INTEGER NOT NULL, last_keyframe INTEGER NOT NULL
) STRICT;
CREATE TABLE hypotheses (hypothesis INTEGER NOT NULL UNIQUE, log_weight REAL NOT NULL) STRICT;
CREATE TABLE assignments (
    hypothesis INTEGER NOT NULL, visit INTEGER NOT NULL, area INTEGER NOT NULL, area_from_visit BLOB
) STRICT;
CREATE TABLE anchors (
    hypothesis INTEGER NOT NULL, visit INTEGER NOT NULL, reference_from_visit BLOB NOT NULL
) STRICT;
CREATE TABLE factors (
    hypothesis INTEGER NOT NULL, visit_a INTEGER NOT NULL, visit_b INTEGER NOT NULL,
    a_from_b BLOB NOT NULL
) STRICT;
"""


def write_map(path: Path, stored: StoredMap) -> None:
    """Write a map so that `path` holds either the old file or the whole new one, at any moment.

    The same map gives the same bytes. Points are rounded to `POINT_RESOLUTION_M`.

    Args:
        path: Map file; replaced if it exists.
        stored: The map.

    Raises:
        NotFound: If the folder does not exist.
        InvalidInput: If a point is not finite or too far away to be stored.
        Unavailable: If the file system refuses.
    """
    if not path.parent.is_dir():
        raise NotFound(f"folder {path.parent} of the map file {path.name} does not exist")
    partial = path.with_name(f"{path.name}.partial")
    try:
        partial.unlink(missing_ok=True)
        # Nobody else sees the partial file: it needs no journal, replacing `path` is the commit.
        with closing(sqlite3.connect(partial, isolation_level=None)) as database:
            database.execute("PRAGMA journal_mode = OFF")
            database.executescript(f"BEGIN; {_SCHEMA}")
            _write(database, stored)
            _insert(database, "meta", [(DIGEST, content_digest(database))])
            database.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
            database.execute("COMMIT")
        partial.replace(path)
    except (sqlite3.OperationalError, OSError) as error:
        raise Unavailable(
            f"map of {len(stored.keyframes)} keyframes not written to {path}: {error}"
        ) from error
    finally:
        partial.unlink(missing_ok=True)


def read_map(path: Path, *, with_points: bool = True) -> StoredMap:
    """Read a map file.

    Args:
        path: Map file.
        with_points: Whether keyframes come with what they saw, which is most of the file. Only then
            the whole content is compared with its digest.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
    """
    with opened(path) as database:
        if with_points:
            known, found = dict(_rows(database, "meta")).get(DIGEST), content_digest(database)
            if known is not None and known != found:
                raise InvalidInput(f"{path} is damaged: it has digest {found[:12]}…, not {known}")
        return _read(database, with_points=with_points)


def read_config(path: Path) -> Config:
    """Read the settings that a map was built with.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
    """
    # Visits and hypotheses too: what is damaged is found out before anything begins.
    return read_map(path, with_points=False).config


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a map file for reading; what cannot be read meanwhile is told of the file.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
    """
    if not path.is_file():
        raise NotFound(f"map file {path} does not exist")
    _check_version(path)
    # Map files are replaced, never changed: "immutable" reads them from read-only media, too.
    uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
    try:
        with closing(sqlite3.connect(uri, uri=True)) as database:
            yield database
    # Damaged pages may hold any value of any type.
    except (sqlite3.DatabaseError, zstandard.ZstdError, KeyError, TypeError, ValueError) as error:
        size = path.stat().st_size
        raise InvalidInput(f"{path} ({size} bytes) is no map file or damaged: {error}") from error


def content_digest(database: sqlite3.Connection) -> str:
    """Return the SHA-256 of all rows of all tables but the digest itself, in hexadecimal."""
    digest = hashlib.sha256()
    for table in TABLES:
        for row in _rows(database, table):
            if row[0] != DIGEST:
                # Lengths keep the borders between values: "ab", "c" is not "a", "bc".
                values = [v if isinstance(v, bytes) else repr(v).encode() for v in row]
                digest.update(repr([len(value) for value in values]).encode())
                digest.update(b"".join(values))
    return digest.hexdigest()


def _check_version(path: Path) -> None:
    """Look at the head of the file only: it is there when the rest is damaged."""
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or not head.startswith(b"SQLite format 3\0"):
        raise InvalidInput(f"{path} ({path.stat().st_size} bytes) is no map file or damaged")
    _, version, application = _HEAD.unpack(head)
    if application != _APPLICATION_ID:
        raise InvalidInput(
            f"{path} is an SQLite file of another application "
            f"(id {application:#x}, a map file has {_APPLICATION_ID:#x})"
        )
    if version not in _READABLE:
        raise InvalidInput(
            f"{path} has schema version {version}, this program reads versions "
            f"{_READABLE[0]} to {_READABLE[-1]}"
        )


def _write(database: sqlite3.Connection, stored: StoredMap) -> None:
    meta = {
        "created_by": f"hmt-service {__version__}",
        "revision": str(stored.revision),
        "seed": str(stored.seed),
        "config": stored.config_json,
        "point_resolution_m": repr(POINT_RESOLUTION_M),
    }
    _insert(database, "meta", meta.items())
    compressor = zstandard.ZstdCompressor(level=_COMPRESSION_LEVEL, write_checksum=True)
    _insert(
        database,
        "keyframes",
        (
            (
                keyframe.index,
                keyframe.stamp_s,
                _numbers_blob(keyframe.sensor_in_body),
                _gaussian_blob(keyframe.previous_from_body),
                _numbers_blob(keyframe.own_error.ravel()),
                keyframe.failure,
                _points_blob(keyframe.points_in_body, compressor),
            )
            for keyframe in stored.keyframes
        ),
    )
    _insert(
        database,
        "scans",
        ((s.stamp_s, s.keyframe_index, _pose_blob(s.keyframe_from_body)) for s in stored.scans),
    )
    _insert(
        database, "visits", ((v.visit, v.first_keyframe, v.last_keyframe) for v in stored.visits)
    )
    for h in stored.hypotheses:
        _insert(database, "hypotheses", [(h.hypothesis, h.log_weight)])
        _insert(
            database,
            "assignments",
            (
                (
                    h.hypothesis,
                    a.visit,
                    a.area,
                    None if a.area_from_visit is None else _gaussian_blob(a.area_from_visit),
                )
                for a in h.assignments
            ),
        )
        _insert(
            database,
            "anchors",
            (
                (h.hypothesis, visit, _pose_blob(pose))
                for visit, pose in h.reference_from_visit.items()
            ),
        )
        _insert(
            database,
            "factors",
            ((h.hypothesis, f.visit_a, f.visit_b, _gaussian_blob(f.a_from_b)) for f in h.factors),
        )


def _read(database: sqlite3.Connection, *, with_points: bool) -> StoredMap:
    meta = dict(_rows(database, "meta"))
    resolution_m = float(meta["point_resolution_m"])
    decompressor = zstandard.ZstdDecompressor()
    keyframes = tuple(
        Keyframe(
            index,
            stamp_s,
            _points(points, resolution_m, decompressor) if with_points else NO_POINTS,
            _numbers(sensor),
            _gaussian(motion),
            _numbers(own_error).reshape(6, 6),
            None if failure is None else TrackingFailure(failure),
        )
        for index, stamp_s, sensor, motion, own_error, failure, points in _rows(
            database, "keyframes"
        )
    )
    scans = tuple(
        StoredScan(stamp_s, index, _pose(pose)) for stamp_s, index, pose in _rows(database, "scans")
    )
    return StoredMap(
        revision=int(meta["revision"]),
        seed=int(meta["seed"]),
        config_json=meta["config"],
        keyframes=keyframes,
        visits=tuple(StoredVisit(*row) for row in _rows(database, "visits")),
        hypotheses=_read_hypotheses(database),
        scans=scans,
    )


def _read_hypotheses(database: sqlite3.Connection) -> tuple[StoredHypothesis, ...]:
    assignments = defaultdict[int, list[StoredAssignment]](list)
    for hypothesis, visit, area, pose in _rows(database, "assignments"):
        area_from_visit = None if pose is None else _gaussian(pose)
        assignments[hypothesis].append(StoredAssignment(visit, area, area_from_visit))
    anchors = defaultdict[int, dict[int, Pose]](dict)
    for hypothesis, visit, pose in _rows(database, "anchors"):
        anchors[hypothesis][visit] = _pose(pose)
    factors = defaultdict[int, list[StoredFactor]](list)
    for hypothesis, visit_a, visit_b, pose in _rows(database, "factors"):
        factors[hypothesis].append(StoredFactor(visit_a, visit_b, _gaussian(pose)))
    return tuple(
        StoredHypothesis(
            hypothesis,
            log_weight,
            tuple(assignments[hypothesis]),
            MappingProxyType(anchors[hypothesis]),
            tuple(factors[hypothesis]),
        )
        for hypothesis, log_weight in _rows(database, "hypotheses")
    )


def _insert(database: sqlite3.Connection, table: str, rows: Iterable[tuple[object, ...]]) -> None:
    for row in rows:
        places = ", ".join("?" * len(row))
        database.execute(f"INSERT INTO {table} VALUES ({places})", row)


def _rows(database: sqlite3.Connection, table: str) -> Iterator[Any]:
    return database.execute(f"SELECT * FROM {table} ORDER BY rowid")


def _numbers_blob(numbers: FloatArray) -> bytes:
    return np.ascontiguousarray(numbers, dtype="<f8").tobytes()


def _numbers(blob: bytes) -> FloatArray:
    return np.frombuffer(blob, dtype="<f8").astype(np.float64)


def _pose_blob(pose: Pose) -> bytes:
    return _numbers_blob(pose[:3])


def _pose(blob: bytes) -> Pose:
    return np.vstack([_numbers(blob).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])


def _gaussian_blob(gaussian: GaussianPose) -> bytes:
    return _pose_blob(gaussian.mean) + _numbers_blob(gaussian.covariance)


def _gaussian(blob: bytes) -> GaussianPose:
    split = len(blob) - 36 * 8
    return GaussianPose(_pose(blob[:split]), _numbers(blob[split:]).reshape(6, 6))


def _points_blob(points: Points, compressor: zstandard.ZstdCompressor) -> bytes:
    """Return points as int32 cells, the bytes sorted by significance: the upper ones are alike."""
    cells = np.rint(points.astype(np.float64) / POINT_RESOLUTION_M)
    # The comparison is also false for NaN.
    if not np.all(np.abs(cells) < 2**31):
        raise InvalidInput(
            f"{np.count_nonzero(~(np.abs(cells) < 2**31))} of {cells.size} coordinates "
            f"are not finite or beyond {2**31 * POINT_RESOLUTION_M:.0f} m"
        )
    planes = np.ascontiguousarray(cells.T, dtype="<i4").view(np.uint8).reshape(-1, 4).T
    return compressor.compress(planes.tobytes())


def _points(blob: bytes, resolution_m: float, decompressor: zstandard.ZstdDecompressor) -> Points:
    planes = np.frombuffer(decompressor.decompress(blob), dtype=np.uint8).reshape(4, -1)
    cells = np.ascontiguousarray(planes.T).view("<i4").reshape(3, -1).T
    return (cells * resolution_m).astype(np.float32)
