"""The tables of a map file: values to rows and back, and the digest of all rows.

Poses are blobs of little-endian float64 and come back bit for bit: the upper three rows of the
matrix (12 numbers), then the 6x6 covariance where there is one (36 numbers), row by row. Points are
rounded to a grid whose resolution stands in `meta`, and compressed. Rows keep the tuples' order:
they are numbered from 1.

`meta` also holds a digest of everything else, which follows each change: the sum of the SHA-256 of
all rows, each with its table and number. Up to version 3 it was one SHA-256 of all rows; that of a
map of version 3 is still compared, 2 had none.

References:
    own; https://www.sqlite.org/fileformat2.html.
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import zip_longest
from types import MappingProxyType
from typing import Any

import numpy as np
import zstandard

from hmt_service import __version__
from hmt_service.core.chunked import Chunked
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
from hmt_service.errors import InvalidInput

SCHEMA_VERSION = 4
"""Version of what is written, in `PRAGMA user_version`."""
READABLE = (2, 4)
"""First and last version that is read. In 3 came sessions and a digest; since 4 the digest can be
brought up to date, visits say themselves whether they were forgotten, and assignments whether the
robot was carried there."""
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

SCHEMA = """
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
    visit INTEGER NOT NULL UNIQUE, first_keyframe INTEGER NOT NULL, last_keyframe INTEGER NOT NULL,
    is_forgotten INTEGER NOT NULL
) STRICT;
CREATE TABLE hypotheses (hypothesis INTEGER NOT NULL UNIQUE, log_weight REAL NOT NULL) STRICT;
CREATE TABLE assignments (
    hypothesis INTEGER NOT NULL, visit INTEGER NOT NULL, area INTEGER NOT NULL,
    area_from_visit BLOB, is_carried INTEGER NOT NULL
) STRICT;
CREATE TABLE anchors (
    hypothesis INTEGER NOT NULL, visit INTEGER NOT NULL, reference_from_visit BLOB NOT NULL
) STRICT;
CREATE TABLE factors (
    hypothesis INTEGER NOT NULL, visit_a INTEGER NOT NULL, visit_b INTEGER NOT NULL,
    a_from_b BLOB NOT NULL
) STRICT;
"""
"""What makes an empty database one of version 4."""

_Row = tuple[Any, ...]
_COMPRESSION_LEVEL = 6
# Keyframes that are in memory together while they are read or written.
_TOGETHER = 16
_MODULUS = 1 << 256
_FIRST_WITH_SUM = 4


def write_rows(database: sqlite3.Connection, stored: StoredMap) -> str:
    """Bring the tables from an earlier state of the same map up to this one; they may be empty.

    Keyframes and scans are added. Those that are there stay what they are, but of visits that were
    forgotten since only the path does: no others are asked for. The same map gives the same rows.

    Args:
        database: With all tables, in a transaction.
        stored: The map.

    Returns:
        The digest of the content.

    Raises:
        InvalidInput: If a point is not finite or too far away to be stored.
    """
    tables = _Tables(database)
    forgotten = tables.forgotten()
    tables.replace("visits", map(_visit_row, stored.visits))
    _write_keyframes(tables, stored, forgotten)
    scans = stored.scans[tables.count("scans") :]
    tables.append(
        "scans",
        ((_real(s.stamp_s), s.keyframe_index, _pose_blob(s.keyframe_from_body)) for s in scans),
    )
    hypotheses = stored.hypotheses
    tables.replace("hypotheses", ((h.hypothesis, _real(h.log_weight)) for h in hypotheses))
    tables.replace("assignments", (row for h in hypotheses for row in _assignment_rows(h)))
    tables.replace("anchors", (row for h in hypotheses for row in _anchor_rows(h)))
    tables.replace("factors", (row for h in hypotheses for row in _factor_rows(h)))
    return tables.close(
        {
            "created_by": f"hmt-service {__version__}",
            "revision": str(stored.revision),
            "seed": str(stored.seed),
            "config": stored.config_json,
            "point_resolution_m": repr(POINT_RESOLUTION_M),
        }
    )


def _write_keyframes(tables: _Tables, stored: StoredMap, forgotten: frozenset[int]) -> None:
    """Add keyframes, and write those again whose visits are not among the forgotten ones yet."""
    compressor = zstandard.ZstdCompressor(level=_COMPRESSION_LEVEL, write_checksum=True)
    known = tables.count("keyframes")
    for visit in stored.visits:
        if visit.is_forgotten and visit.visit not in forgotten:
            again = range(visit.first_keyframe, min(visit.last_keyframe + 1, known))
            for keyframe in stored.keyframes[again.start : again.stop]:
                tables.put("keyframes", keyframe.index + 1, _keyframe_row(keyframe, compressor))
    for first in range(known, len(stored.keyframes), _TOGETHER):
        keyframes = stored.keyframes[first : first + _TOGETHER]
        tables.append("keyframes", (_keyframe_row(k, compressor) for k in keyframes))


class _Tables:
    """Tables whose digest follows what is written."""

    def __init__(self, database: sqlite3.Connection) -> None:
        self._database = database
        self._digest = int(digest_in(database) or "0", 16)
        self._columns = {table: _columns(database, table) for table in TABLES}

    def count(self, table: str) -> int:
        return _count(self._database, table)

    def forgotten(self) -> frozenset[int]:
        """Return the visits of which only the path is there."""
        visits = self._database.execute("SELECT visit FROM visits WHERE is_forgotten")
        return frozenset(visit for (visit,) in visits)

    def append(self, table: str, rows: Iterable[_Row]) -> None:
        for number, row in enumerate(rows, start=self.count(table) + 1):
            self._change(table, number, None, row)

    def put(self, table: str, number: int, row: _Row) -> None:
        """Write one row in place of the one that is there."""
        held = self._database.execute(f"SELECT * FROM {table} WHERE rowid = ?", (number,))
        self._change(table, number, held.fetchone(), row)

    def replace(self, table: str, rows: Iterable[_Row]) -> None:
        """Make these rows the content of a table; those that are there already are left alone."""
        # Read before the first change: a row with the number of a later one takes its place.
        held = list(_content(self._database, table))
        for number, (old, new) in enumerate(zip_longest(held, rows), start=1):
            self._change(table, number, old, new)

    def close(self, meta: dict[str, str]) -> str:
        """Write what is said of the whole, and return the digest."""
        self.replace("meta", meta.items())
        digest = f"{self._digest:064x}"
        self._database.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (DIGEST, digest))
        return digest

    def _change(self, table: str, number: int, old: _Row | None, new: _Row | None) -> None:
        if old == new:
            return
        if new is None:
            self._database.execute(f"DELETE FROM {table} WHERE rowid = ?", (number,))
        else:
            names, places = ", ".join(self._columns[table]), ", ".join("?" * len(new))
            self._database.execute(
                f"INSERT OR REPLACE INTO {table} (rowid, {names}) VALUES (?, {places})",
                (number, *new),
            )
        for row, sign in ((old, -1), (new, 1)):
            if row is not None:
                self._digest += sign * _row_digest(table, number, row)
        self._digest %= _MODULUS


def content_digest(database: sqlite3.Connection) -> str:
    """Return the digest of all rows of all tables but the digest itself, in hexadecimal."""
    (version,) = database.execute("PRAGMA user_version").fetchone()
    rows = (
        (table, number, row)
        for table in TABLES
        for number, row in enumerate(_content(database, table), start=1)
    )
    if version >= _FIRST_WITH_SUM:
        return f"{sum(_row_digest(*each) for each in rows) % _MODULUS:064x}"
    digest = hashlib.sha256()
    for _, _, row in rows:
        for part in _row_parts(row):
            digest.update(part)
    return digest.hexdigest()


def digest_in(database: sqlite3.Connection) -> str | None:
    """Return the digest that stands in a map file; None: it is empty, or of version 2."""
    held = database.execute("SELECT value FROM meta WHERE key = ?", (DIGEST,)).fetchone()
    return None if held is None else str(held[0])


def _row_digest(table: str, number: int, row: _Row) -> int:
    digest = hashlib.sha256(f"{table} {number} ".encode())
    for part in _row_parts(row):
        digest.update(part)
    return int.from_bytes(digest.digest())


def _row_parts(row: _Row) -> tuple[bytes, bytes]:
    # Lengths keep the borders between values: "ab", "c" is not "a", "bc".
    values = [v if isinstance(v, bytes) else repr(v).encode() for v in row]
    return repr([len(value) for value in values]).encode(), b"".join(values)


def _count(database: sqlite3.Connection, table: str) -> int:
    (last,) = database.execute(f"SELECT max(rowid) FROM {table}").fetchone()
    return int(last or 0)


def _columns(database: sqlite3.Connection, table: str) -> list[str]:
    return [name for _, name, *_ in database.execute(f"PRAGMA table_info({table})")]


def _rows(database: sqlite3.Connection, table: str) -> Iterator[Any]:
    return database.execute(f"SELECT * FROM {table} ORDER BY rowid")


def _content(database: sqlite3.Connection, table: str) -> Iterator[_Row]:
    """Return the rows that the digest is of."""
    return (row for row in _rows(database, table) if row[0] != DIGEST)


def _keyframe_row(keyframe: Keyframe, compressor: zstandard.ZstdCompressor) -> _Row:
    return (
        keyframe.index,
        _real(keyframe.stamp_s),
        _numbers_blob(keyframe.sensor_in_body),
        _gaussian_blob(keyframe.previous_from_body),
        _numbers_blob(keyframe.own_error.ravel()),
        None if keyframe.failure is None else keyframe.failure.value,
        _points_blob(keyframe.points_in_body, compressor),
    )


def _visit_row(visit: StoredVisit) -> _Row:
    return visit.visit, visit.first_keyframe, visit.last_keyframe, int(visit.is_forgotten)


def _assignment_rows(hypothesis: StoredHypothesis) -> Iterator[_Row]:
    for a in hypothesis.assignments:
        pose = None if a.area_from_visit is None else _gaussian_blob(a.area_from_visit)
        yield hypothesis.hypothesis, a.visit, a.area, pose, int(a.is_carried)


def _anchor_rows(hypothesis: StoredHypothesis) -> Iterator[_Row]:
    for visit, pose in hypothesis.reference_from_visit.items():
        yield hypothesis.hypothesis, visit, _pose_blob(pose)


def _factor_rows(hypothesis: StoredHypothesis) -> Iterator[_Row]:
    for f in hypothesis.factors:
        yield hypothesis.hypothesis, f.visit_a, f.visit_b, _gaussian_blob(f.a_from_b)


def read_rows(
    database: sqlite3.Connection, *, with_points: bool = True, is_lazy: bool = False
) -> StoredMap:
    """Return the map in the tables.

    Args:
        database: Of any version that is read.
        with_points: Whether keyframes come with what they saw, which is most of it.
        is_lazy: Whether keyframes are read when they are asked for, while the database is open.
    """
    meta = dict(_rows(database, "meta"))
    keyframes = _read_keyframes(
        database, float(meta["point_resolution_m"]), with_points=with_points
    )
    scans = tuple(
        StoredScan(stamp_s, index, _pose(pose)) for stamp_s, index, pose in _rows(database, "scans")
    )
    hypotheses = _read_hypotheses(database)
    return StoredMap(
        revision=int(meta["revision"]),
        seed=int(meta["seed"]),
        config_json=meta["config"],
        keyframes=keyframes if is_lazy else tuple(keyframes),
        visits=_read_visits(database, hypotheses),
        hypotheses=hypotheses,
        scans=scans,
    )


def _read_keyframes(
    database: sqlite3.Connection, resolution_m: float, *, with_points: bool
) -> Chunked[Keyframe]:
    decompressor = zstandard.ZstdDecompressor()

    def chunk(number: int) -> tuple[Keyframe, ...]:
        rows = database.execute(
            "SELECT * FROM keyframes WHERE rowid > ? AND rowid <= ? ORDER BY rowid",
            (number * _TOGETHER, (number + 1) * _TOGETHER),
        )
        return tuple(
            Keyframe(
                index,
                stamp_s,
                _points(points, resolution_m, decompressor) if with_points else NO_POINTS,
                _numbers(sensor),
                _gaussian(motion),
                _numbers(own_error).reshape(6, 6),
                None if failure is None else TrackingFailure(failure),
            )
            for index, stamp_s, sensor, motion, own_error, failure, points in rows
        )

    full, rest = divmod(_count(database, "keyframes"), _TOGETHER)
    return Chunked([_TOGETHER] * full + [rest], chunk)


def _read_visits(
    database: sqlite3.Connection, hypotheses: tuple[StoredHypothesis, ...]
) -> tuple[StoredVisit, ...]:
    # Until version 4 only the graphs told which ones were forgotten.
    forgotten = hypotheses[0].eliminated if hypotheses else frozenset()
    return tuple(
        StoredVisit(visit, first, last, bool(said[0]) if said else visit in forgotten)
        for visit, first, last, *said in _rows(database, "visits")
    )


def _read_hypotheses(database: sqlite3.Connection) -> tuple[StoredHypothesis, ...]:
    assignments = defaultdict[int, list[StoredAssignment]](list)
    # Before version 4 nobody was carried.
    for hypothesis, visit, area, pose, *is_carried in _rows(database, "assignments"):
        area_from_visit = None if pose is None else _gaussian(pose)
        assignments[hypothesis].append(
            StoredAssignment(visit, area, area_from_visit, any(is_carried))
        )
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


def _real(number: float) -> float:
    """Return a number as it comes back: SQLite knows no negative zero."""
    return float(number) + 0.0


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
