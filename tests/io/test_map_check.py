"""`check_map` on files that were really damaged."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hmt_service.core.geometry import GaussianPose, exp
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import write_map
from hmt_service.io.map_rows import DIGEST, SCHEMA_VERSION, TABLES, content_digest
from tests.mapped import map_file_in, mapped


def damaged(folder: Path, *statements: str, values: Sequence[object] = ()) -> tuple[str, ...]:
    """Return what is wrong with the map after these changes, whose digest is right again."""
    path = map_file_in(folder)
    with closing(sqlite3.connect(path)) as database, database:
        for statement in statements:
            assert database.execute(statement, values).rowcount > 0
        digest = content_digest(database)
        database.execute("UPDATE meta SET value = ? WHERE key = ?", (digest, DIGEST))
    return check_map(path)


def content(path: Path) -> list[list[tuple[object, ...]]]:
    with closing(sqlite3.connect(path)) as database:
        return [list(database.execute(f"SELECT * FROM {table}")) for table in TABLES]


def test_a_map_that_the_engine_made_is_sound_and_not_changed(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    before = path.read_bytes()
    assert check_map(path) == ()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_every_flipped_bit_that_changes_the_content_is_found(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    whole, written, found = path.read_bytes(), content(path), 0
    rng = np.random.default_rng(0)
    for _ in range(60):
        # The head says whether it is a map file at all; it is tested below.
        place = int(rng.integers(100, len(whole)))
        changed = bytearray(whole)
        changed[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        if check_map(path):
            found += 1
        else:
            assert content(path) == written
    assert found > 20


@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.9])
def test_truncated_file_is_a_damaged_map(tmp_path: Path, share: float) -> None:
    path = map_file_in(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert any("malformed" in violation for violation in check_map(path))


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("DELETE FROM meta WHERE key = 'seed'", "meta: seed is missing"),
        ("UPDATE meta SET value = '-1' WHERE key = 'point_resolution_m'", "meta: point_resol"),
        ("UPDATE meta SET value = '{\"sensor\": 1}' WHERE key = 'config'", "settings are refused"),
        ("DELETE FROM keyframes WHERE keyframe = 3", "keyframes: number 4 stands where 3 should"),
        ("UPDATE keyframes SET stamp_s = 9e999 WHERE keyframe = 5", "keyframes, row 5: stamp inf"),
        ("UPDATE keyframes SET failure = 'bored' WHERE keyframe = 5", "failure 'bored' is unknown"),
        (
            "UPDATE keyframes SET points_in_body = substr(points_in_body, 1, 30) "
            "WHERE keyframe = 7",
            "keyframes, keyframe 7: points_in_body of 30 bytes cannot be decompressed",
        ),
        ("UPDATE keyframes SET own_error = x'00' WHERE keyframe = 7", "has 1 bytes, not 288"),
        ("UPDATE scans SET keyframe = 999 WHERE rowid = 11", "scans, row 10: keyframe 999 is none"),
        ("DELETE FROM visits WHERE visit = 1", "visits: number 2 stands where 1 should"),
        ("UPDATE visits SET first_keyframe = 5 WHERE visit = 0", "visit 0: keyframes 5 to"),
        ("UPDATE visits SET last_keyframe = 60 WHERE visit = 2", "visits: the last one ends at"),
        ("UPDATE visits SET is_forgotten = 2 WHERE visit = 1", "visit 1: is_forgotten is 2, not"),
        (
            "UPDATE assignments SET is_carried = -1 WHERE visit = 1",
            "visit 1: is_carried is -1, not",
        ),
        ("DELETE FROM hypotheses", "hypotheses: there are none"),
        ("UPDATE hypotheses SET log_weight = -1.0", "probabilities of 1 sum to 0.367879441"),
        ("DELETE FROM assignments WHERE visit = 2", "assignments of visits 2 are missing, of 3"),
        ("UPDATE assignments SET visit = 1 WHERE visit = 2", "visits 1 are there more than once"),
        ("UPDATE assignments SET area = 0 WHERE visit = 1", "visit 1 founded area 0"),
        ("UPDATE assignments SET area = 2 WHERE visit = 2", "visit 2 was aligned with area 2"),
        ("UPDATE anchors SET visit = 8 WHERE visit = 2", "anchors of visits 8, which are none"),
        ("UPDATE factors SET visit_b = 9 WHERE rowid = 1", "does not tie two of 3 visits"),
        ("UPDATE factors SET hypothesis = 77 WHERE rowid = 1", "1 rows of hypothesis 77"),
    ],
)
def test_damage_is_named_with_its_numbers(tmp_path: Path, statement: str, expected: str) -> None:
    assert any(expected in violation for violation in damaged(tmp_path, statement))


@pytest.mark.parametrize(
    ("table", "column", "number", "value", "expected"),
    [
        ("anchors", "reference_from_visit", 0, 1.1, "is no rotation: R Rᵀ is"),
        ("anchors", "reference_from_visit", 3, np.nan, "has 1 of 12 numbers that are not finite"),
        ("scans", "keyframe_from_body", 5, -1.0, "is no rotation"),
        ("factors", "a_from_b", 12 + 7, -1.0, "is no covariance: an eigenvalue is -1"),
        ("factors", "a_from_b", 12 + 1, 0.5, "is not symmetric: by"),
        ("keyframes", "previous_from_body", 12, np.inf, "has 1 of 36 numbers"),
        ("keyframes", "own_error", 1, 0.5, "is not symmetric: by"),
        ("keyframes", "sensor_in_body", 2, np.inf, "has 1 of 3 numbers"),
    ],
)
def test_impossible_numbers_in_a_blob_are_found(
    tmp_path: Path, table: str, column: str, number: int, value: float, expected: str
) -> None:
    with closing(sqlite3.connect(map_file_in(tmp_path))) as database:
        (blob,) = database.execute(f"SELECT {column} FROM {table} WHERE rowid = 3").fetchone()
    numbers = np.frombuffer(blob, "<f8").copy()
    numbers[number] = value
    statement = f"UPDATE {table} SET {column} = ? WHERE rowid = 3"
    (violation,) = damaged(tmp_path, statement, values=(numbers.tobytes(),))
    assert expected in violation
    assert column in violation


def test_one_damage_does_not_hide_another(tmp_path: Path) -> None:
    violations = damaged(
        tmp_path,
        "UPDATE keyframes SET points_in_body = x'00' WHERE keyframe IN (2, 9)",
        "DELETE FROM anchors WHERE visit = 1",
    )
    assert len(violations) == 3


def test_missing_table_is_named(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("DROP TABLE factors")
    assert check_map(path) == ("database: no such table: factors; the rest was not checked",)


def test_changed_number_that_is_possible_is_found_by_the_digest(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE keyframes SET stamp_s = stamp_s + 1e-6 WHERE keyframe = 4")
    (violation,) = check_map(path)
    assert violation.startswith(f"meta: {DIGEST} is ")


def test_rounding_of_single_precision_is_no_damage(tmp_path: Path) -> None:
    stored = mapped().stored()
    rough = tuple(
        replace(
            keyframe,
            previous_from_body=GaussianPose(
                exp(np.full(6, 0.1)).astype(np.float32).astype(np.float64),
                np.full((6, 6), 1e-3, dtype=np.float32).astype(np.float64),
            ),
        )
        for keyframe in stored.keyframes
    )
    write_map(tmp_path / "map.hmt", replace(stored, keyframes=rough))
    assert check_map(tmp_path / "map.hmt") == ()


def test_what_is_no_map_file_of_this_version_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"absent\.hmt"):
        check_map(tmp_path / "absent.hmt")
    (tmp_path / "text.hmt").write_text("no map" * 99)
    with pytest.raises(InvalidInput, match="594 bytes"):
        check_map(tmp_path / "text.hmt")
    with closing(sqlite3.connect(tmp_path / "songs.hmt")) as database:
        database.execute("CREATE TABLE songs (title TEXT)")
    with pytest.raises(InvalidInput, match="another application"):
        check_map(tmp_path / "songs.hmt")
    newer = map_file_in(tmp_path)
    with closing(sqlite3.connect(newer)) as database:
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    with pytest.raises(InvalidInput, match=f"version {SCHEMA_VERSION + 1}"):
        check_map(newer)
