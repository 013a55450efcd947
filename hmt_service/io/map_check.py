"""Whether a map file is sound: everything that it says is readable, possible and fits together.

Blobs are decoded here by the description of the format in `map_file`, not by its code, and row by
row: one damaged blob does not hide the next.

References:
    own; https://www.sqlite.org/pragma.html#pragma_integrity_check.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from pydantic import ValidationError

from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import TrackingFailure
from hmt_service.io.map_file import opened
from hmt_service.io.map_rows import DIGEST, TABLES, content_digest

# What is stored in single precision is no rotation, and no covariance, to the last digit.
_ROTATION_TOLERANCE = 1e-5
_EIGENVALUE_TOLERANCE = 1e-6
_MASS_TOLERANCE = 1e-6
_POINT_BYTES = 12
_SHOWN = 5
_FIRST_WITH_DIGEST = 3
_Row = Mapping[str, Any]
_TYPES: Mapping[str, type] = {"TEXT": str, "INTEGER": int, "REAL": float, "BLOB": bytes}


def check_map(path: Path) -> tuple[str, ...]:
    """Return everything that is wrong with a map file, one line each; nothing if it is sound.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file or was written by another version.
    """
    with opened(path) as database:
        return tuple(_violations(database))


def _violations(database: sqlite3.Connection) -> Iterator[str]:
    yield from _database(database)
    tables: dict[str, list[_Row]] = {}
    try:
        for table in TABLES:
            tables[table] = []
            yield from _read(database, table, tables[table])
        digest = content_digest(database)
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        yield f"database: {error}; the rest was not checked"
        return
    (version,) = database.execute("PRAGMA user_version").fetchone()
    yield from _meta({row["key"]: row["value"] for row in tables["meta"]}, digest, version)
    yield from _content(tables)
    keyframes = [row["keyframe"] for row in tables["keyframes"]]
    visits = [row["visit"] for row in tables["visits"]]
    yield from _counted("keyframes", keyframes)
    yield from _counted("visits", visits)
    yield from _scans(tables["scans"], len(keyframes))
    yield from _extents(tables["visits"], len(keyframes))
    yield from _weights(tables["hypotheses"])
    yield from _hypotheses(tables, visits)


def _database(database: sqlite3.Connection) -> Iterator[str]:
    """Yield what SQLite finds wrong with its own pages; one finding may have several lines."""
    try:
        for (text,) in database.execute("PRAGMA integrity_check"):
            if text != "ok":
                yield f"database: {' '.join(text.split())}"
    except (sqlite3.DatabaseError, UnicodeDecodeError) as error:
        yield f"database: {error}"


def _read(database: sqlite3.Connection, table: str, rows: list[_Row]) -> Iterator[str]:
    """Append the rows of a table, and yield why some are left out.

    Pages are not read as they were written when they are damaged: any value may be of any type.
    """
    columns = list(database.execute(f"PRAGMA table_info({table})"))
    for position, row in enumerate(database.execute(f"SELECT * FROM {table} ORDER BY rowid")):
        wrong = [
            f"{name} is {type(value).__name__}, not {declared}"
            for (_, name, declared, is_needed, *_), value in zip(columns, row, strict=True)
            if not isinstance(value, _TYPES[declared]) and (is_needed or value is not None)
        ]
        if wrong:
            yield f"{table}, row {position}: {', '.join(wrong)}"
        else:
            rows.append({column[1]: value for column, value in zip(columns, row, strict=True)})


def _meta(meta: Mapping[str, str], digest: str, version: int) -> Iterator[str]:
    if DIGEST not in meta and version >= _FIRST_WITH_DIGEST:
        yield f"meta: {DIGEST} is missing"
    if meta.get(DIGEST, digest) != digest:
        yield f"meta: {DIGEST} is {meta[DIGEST][:12]}…, that of the content is {digest[:12]}…"
    for key, read in _META.items():
        if key not in meta:
            yield f"meta: {key} is missing"
            continue
        try:
            read(meta[key])
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            yield f"meta: {error.error_count()} settings are refused, first {place}: {first['msg']}"
        except ValueError as error:
            yield f"meta: {key}: {error}"


def _resolution_m(text: str) -> None:
    if not 0.0 < float(text) < np.inf:
        raise ValueError(f"{text} m is no size of a cell")


_META: Mapping[str, Callable[[str], object]] = {
    "created_by": str,
    "revision": int,
    "seed": int,
    "config": Config.model_validate_json,
    "point_resolution_m": _resolution_m,
}


# ------------------------------------------------------------------ what single values say


def _content(tables: Mapping[str, Sequence[_Row]]) -> Iterator[str]:
    """Yield what is wrong with single blobs, stamps and names."""
    for table, columns in _BLOBS.items():
        for row in tables[table]:
            for column, faults in columns.items():
                for fault in faults(row[column]):
                    yield f"{_named(table, row)}: {column} {fault}"
    failures = {None, *TrackingFailure}
    for row in tables["keyframes"]:
        if row["failure"] not in failures:
            yield f"{_named('keyframes', row)}: failure {row['failure']!r} is unknown"
    for table in ("keyframes", "scans"):
        for position, row in enumerate(tables[table]):
            if not np.isfinite(row["stamp_s"]):
                yield f"{table}, row {position}: stamp {row['stamp_s']} s is not finite"


def _named(table: str, row: _Row) -> str:
    numbers = (f"{name} {value}" for name, value in row.items() if isinstance(value, int))
    return f"{table}, {', '.join(numbers)}"


def _numbers(blob: bytes, count: int) -> FloatArray | str:
    """Return so many finite numbers, or what they are instead."""
    if len(blob) != 8 * count:
        return f"has {len(blob)} bytes, not {8 * count}"
    numbers = np.frombuffer(blob, dtype="<f8")
    if not np.all(np.isfinite(numbers)):
        return (
            f"has {np.count_nonzero(~np.isfinite(numbers))} of {count} numbers that are not finite"
        )
    return numbers


def _vector(blob: bytes) -> Iterator[str]:
    numbers = _numbers(blob, 3)
    if isinstance(numbers, str):
        yield numbers


def _pose(blob: bytes) -> Iterator[str]:
    numbers = _numbers(blob, 12)
    if isinstance(numbers, str):
        yield numbers
        return
    rotation = numbers.reshape(3, 4)[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
    # The comparison is also false for NaN, which huge numbers end in.
    if not (error <= _ROTATION_TOLERANCE and determinant > 0.0):
        yield f"is no rotation: R Rᵀ is {error:.3g} from 1, the determinant is {determinant:.6g}"


def _covariance(blob: bytes) -> Iterator[str]:
    numbers = _numbers(blob, 36)
    if isinstance(numbers, str):
        yield numbers
        return
    matrix = numbers.reshape(6, 6)
    largest = np.abs(matrix).max()
    asymmetry = np.abs(0.5 * matrix - 0.5 * matrix.T).max()
    if asymmetry > _EIGENVALUE_TOLERANCE * largest:
        yield f"is not symmetric: by {2.0 * asymmetry:.3g} of {largest:.3g}"
        return
    lowest = np.linalg.eigvalsh(matrix / max(largest, np.finfo(np.float64).tiny))[0]
    if not lowest >= -_EIGENVALUE_TOLERANCE:
        yield f"is no covariance: an eigenvalue is {lowest * largest:.3g} of {largest:.3g}"


def _gaussian(blob: bytes | None) -> Iterator[str]:
    if blob is None:
        return
    if len(blob) != 8 * 48:
        yield f"has {len(blob)} bytes, not {8 * 48}"
        return
    yield from _pose(blob[: 8 * 12])
    yield from _covariance(blob[8 * 12 :])


def _points(blob: bytes) -> Iterator[str]:
    try:
        size = len(zstandard.ZstdDecompressor().decompress(blob))
    except (zstandard.ZstdError, MemoryError) as error:
        yield f"of {len(blob)} bytes cannot be decompressed: {error}"
        return
    if size % _POINT_BYTES:
        yield f"has {size} bytes, which are no points of {_POINT_BYTES} bytes"


_BLOBS: Mapping[str, Mapping[str, Callable[[bytes], Iterator[str]]]] = {
    "keyframes": {
        "sensor_in_body": _vector,
        "previous_from_body": _gaussian,
        "own_error": _covariance,
        "points_in_body": _points,
    },
    "scans": {"keyframe_from_body": _pose},
    "assignments": {"area_from_visit": _gaussian},
    "anchors": {"reference_from_visit": _pose},
    "factors": {"a_from_b": _gaussian},
}


# ------------------------------------------------------------------ what fits together


def _counted(name: str, numbers: Sequence[int]) -> Iterator[str]:
    """Yield why numbers are not 0, 1, 2, ..."""
    if not numbers:
        yield f"{name}: there are none"
    for position, number in enumerate(numbers):
        if number != position:
            yield f"{name}: number {number} stands where {position} should, of {len(numbers)}"
            return


def _scans(scans: Sequence[_Row], keyframes: int) -> Iterator[str]:
    for position, row in enumerate(scans):
        if not 0 <= row["keyframe"] < keyframes:
            yield f"scans, row {position}: keyframe {row['keyframe']} is none of {keyframes}"


def _extents(visits: Sequence[_Row], keyframes: int) -> Iterator[str]:
    """Yield where visits do not follow on each other, or leave keyframes out."""
    expected = 0
    for row in visits:
        first, last = row["first_keyframe"], row["last_keyframe"]
        if first != expected or last < first:
            yield (
                f"visits, visit {row['visit']}: keyframes {first} to {last}, "
                f"the one before ends at {expected - 1}"
            )
        yield from _flag(f"visits, visit {row['visit']}", row, "is_forgotten")
        expected = last + 1
    if visits and expected != keyframes:
        yield f"visits: the last one ends at keyframe {expected - 1} of 0 to {keyframes - 1}"


def _weights(hypotheses: Sequence[_Row]) -> Iterator[str]:
    if not hypotheses:
        yield "hypotheses: there are none"
        return
    with np.errstate(over="ignore"):
        mass = float(np.sum(np.exp([row["log_weight"] for row in hypotheses])))
    if not abs(mass - 1.0) <= _MASS_TOLERANCE:
        yield f"hypotheses: the probabilities of {len(hypotheses)} sum to {mass:.9g}"


def _flag(name: str, row: _Row, column: str) -> Iterator[str]:
    """Yield why a truth value, which older versions do not have, is none."""
    if row.get(column, 0) not in (0, 1):
        yield f"{name}: {column} is {row[column]}, not 0 or 1"


def _hypotheses(tables: Mapping[str, Sequence[_Row]], visits: Sequence[int]) -> Iterator[str]:
    known = [row["hypothesis"] for row in tables["hypotheses"]]
    for table in ("assignments", "anchors", "factors"):
        strangers = Counter(row["hypothesis"] for row in tables[table])
        for hypothesis in known:
            strangers.pop(hypothesis, None)
        for hypothesis, rows in sorted(strangers.items()):
            yield f"{table}: {rows} rows of hypothesis {hypothesis}, which is none of {known}"
    for hypothesis in known:
        assignments, anchors, factors = (
            [row for row in tables[table] if row["hypothesis"] == hypothesis]
            for table in ("assignments", "anchors", "factors")
        )
        name = f"hypothesis {hypothesis}"
        yield from _each_visit(f"{name}: assignments", [r["visit"] for r in assignments], visits)
        yield from _each_visit(f"{name}: anchors", [r["visit"] for r in anchors], visits)
        yield from _founders(name, assignments)
        yield from _factors(name, factors, frozenset(visits))


def _each_visit(name: str, found: Sequence[int], visits: Sequence[int]) -> Iterator[str]:
    """Yield which visits are not there exactly once."""
    counts = Counter(found)
    missing = [visit for visit in visits if not counts[visit]]
    if missing:
        yield f"{name} of {_some(missing)} are missing, of {len(visits)} visits"
    if several := [visit for visit, count in counts.items() if count > 1]:
        yield f"{name} of {_some(several)} are there more than once"
    if unknown := sorted(counts.keys() - set(visits)):
        yield f"{name} of {_some(unknown)}, which are none of {len(visits)} visits"


def _founders(name: str, assignments: Sequence[_Row]) -> Iterator[str]:
    founded = {row["area"] for row in assignments if row["area_from_visit"] is None}
    for row in assignments:
        visit, area = row["visit"], row["area"]
        yield from _flag(f"{name}: visit {visit}", row, "is_carried")
        if (row["area_from_visit"] is None) != (area == visit):
            said = "founded" if row["area_from_visit"] is None else "was aligned with"
            yield f"{name}: visit {visit} {said} area {area}; an area is founded by its own visit"
        elif area > visit or area not in founded:
            yield f"{name}: visit {visit} was to area {area}, which nothing before it has founded"


def _factors(name: str, factors: Sequence[_Row], visits: frozenset[int]) -> Iterator[str]:
    for row in factors:
        ends = row["visit_a"], row["visit_b"]
        if ends[0] == ends[1] or not visits.issuperset(ends):
            yield f"{name}: factor {ends[0]} – {ends[1]} does not tie two of {len(visits)} visits"


def _some(numbers: Sequence[int]) -> str:
    shown = " ".join(map(str, numbers[:_SHOWN]))
    return f"visits {shown}" if len(numbers) <= _SHOWN else f"visits {shown} … ({len(numbers)})"
