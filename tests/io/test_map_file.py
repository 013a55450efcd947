from __future__ import annotations

import sqlite3
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmt_service.core.engine import Engine
from hmt_service.core.geometry import GaussianPose, Pose, exp
from hmt_service.core.stored import (
    StoredAssignment,
    StoredFactor,
    StoredHypothesis,
    StoredMap,
    StoredScan,
    StoredVisit,
)
from hmt_service.core.types import Keyframe, MapMethod, Points, TrackingFailure
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import read_map, write_map
from hmt_service.io.map_info import map_info
from hmt_service.io.map_rows import POINT_RESOLUTION_M, SCHEMA_VERSION


def random_pose(rng: np.random.Generator) -> Pose:
    return exp(rng.normal(0.0, 1.0, 6))


def random_gaussian(rng: np.random.Generator) -> GaussianPose:
    root = rng.normal(0.0, 0.1, (6, 6))
    return GaussianPose(random_pose(rng), root @ root.T)


def random_map(
    seed: int, *, keyframes: int = 7, visits: int = 3, hypotheses: int = 2, points: int = 40
) -> StoredMap:
    rng = np.random.default_rng(seed)
    failures = [None, *TrackingFailure]
    return StoredMap(
        revision=int(rng.integers(1000)),
        seed=seed,
        config_json='{"particles": {"budget": 15}, "text": "Größe"}',
        keyframes=tuple(
            Keyframe(
                index,
                float(rng.uniform(0.0, 2e9)),
                rng.normal(0.0, 20.0, (points, 3)).astype(np.float32),
                rng.normal(0.0, 1.0, 3),
                random_gaussian(rng),
                rng.normal(size=(6, 6)),
                failures[index % len(failures)],
            )
            for index in range(keyframes)
        ),
        visits=tuple(StoredVisit(visit, 2 * visit, 2 * visit + 1) for visit in range(visits)),
        hypotheses=tuple(
            StoredHypothesis(
                hypothesis,
                float(rng.normal()),
                tuple(
                    StoredAssignment(
                        visit, visit, random_gaussian(rng) if visit % 2 else None, visit % 3 == 0
                    )
                    for visit in range(visits)
                ),
                {visit: random_pose(rng) for visit in range(visits)},
                tuple(
                    StoredFactor(visit, visit + 1, random_gaussian(rng))
                    for visit in range(visits - 1)
                ),
            )
            # Identifiers that are not in order: the file must keep the order of the tuple.
            for hypothesis in range(40, 40 - 3 * hypotheses, -3)
        ),
        scans=tuple(
            StoredScan(0.1 * number, number // 2, random_pose(rng))
            for number in range(2 * keyframes)
        ),
    )


def assert_same_gaussian(first: GaussianPose | None, second: GaussianPose | None) -> None:
    if first is None or second is None:
        assert first is second
        return
    assert np.array_equal(first.mean, second.mean)
    assert np.array_equal(first.covariance, second.covariance)


def assert_same_map(read: StoredMap, written: StoredMap) -> None:
    """Everything is equal to the last bit; points are equal up to half the resolution."""
    assert (read.revision, read.seed, read.config_json, read.visits) == (
        written.revision,
        written.seed,
        written.config_json,
        written.visits,
    )
    for keyframe, other in zip(read.keyframes, written.keyframes, strict=True):
        assert (keyframe.index, keyframe.stamp_s) == (other.index, other.stamp_s)
        assert keyframe.failure is other.failure
        assert np.array_equal(keyframe.sensor_in_body, other.sensor_in_body)
        assert_same_gaussian(keyframe.previous_from_body, other.previous_from_body)
        assert np.array_equal(keyframe.own_error, other.own_error)
        assert keyframe.points_in_body.dtype == np.float32
        assert keyframe.points_in_body.shape == other.points_in_body.shape
        assert keyframe.points_in_body == pytest.approx(
            other.points_in_body, rel=1e-6, abs=0.501 * POINT_RESOLUTION_M
        )
    for scan, other_scan in zip(read.scans, written.scans, strict=True):
        assert (scan.stamp_s, scan.keyframe_index) == (
            other_scan.stamp_s,
            other_scan.keyframe_index,
        )
        assert np.array_equal(scan.keyframe_from_body, other_scan.keyframe_from_body)
    for one, two in zip(read.hypotheses, written.hypotheses, strict=True):
        assert_same_hypothesis(one, two)


def assert_same_hypothesis(read: StoredHypothesis, written: StoredHypothesis) -> None:
    assert (read.hypothesis, read.log_weight) == (written.hypothesis, written.log_weight)
    for assignment, other in zip(read.assignments, written.assignments, strict=True):
        assert (assignment.visit, assignment.area) == (other.visit, other.area)
        assert_same_gaussian(assignment.area_from_visit, other.area_from_visit)
    assert list(read.reference_from_visit) == list(written.reference_from_visit)
    for visit, pose in read.reference_from_visit.items():
        assert np.array_equal(pose, written.reference_from_visit[visit])
    for factor, other_factor in zip(read.factors, written.factors, strict=True):
        assert (factor.visit_a, factor.visit_b) == (other_factor.visit_a, other_factor.visit_b)
        assert_same_gaussian(factor.a_from_b, other_factor.a_from_b)


def map_with_points(points: Points) -> StoredMap:
    whole = random_map(0, keyframes=1)
    return replace(whole, keyframes=(replace(whole.keyframes[0], points_in_body=points),))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    keyframes=st.integers(0, 9),
    visits=st.integers(0, 4),
    hypotheses=st.integers(0, 4),
    points=st.integers(0, 60),
)
def test_what_is_written_is_read(
    seed: int, keyframes: int, visits: int, hypotheses: int, points: int
) -> None:
    written = random_map(
        seed, keyframes=keyframes, visits=visits, hypotheses=hypotheses, points=points
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.hmt"
        write_map(path, written)
        assert_same_map(read_map(path), written)


def test_second_round_trip_changes_no_byte(tmp_path: Path) -> None:
    write_map(tmp_path / "first.hmt", random_map(1))
    write_map(tmp_path / "second.hmt", read_map(tmp_path / "first.hmt"))
    assert (tmp_path / "first.hmt").read_bytes() == (tmp_path / "second.hmt").read_bytes()


def test_points_have_known_grid_values(tmp_path: Path) -> None:
    points = np.array([[0.0124, -0.0126, 0.0], [163.9, -400.0, 1e6]], dtype=np.float32)
    write_map(tmp_path / "map.hmt", map_with_points(points))
    (keyframe,) = read_map(tmp_path / "map.hmt").keyframes
    expected = np.array([[0.010, -0.015, 0.0], [163.9, -400.0, 1e6]], dtype=np.float32)
    assert np.array_equal(keyframe.points_in_body, expected)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 2e7])
def test_point_that_cannot_be_stored_is_refused(tmp_path: Path, bad: float) -> None:
    path = tmp_path / "map.hmt"
    points = np.array([[0.0, 1.0, bad], [0.0, 0.0, 0.0]], dtype=np.float32)
    with pytest.raises(InvalidInput, match="1 of 6 coordinates"):
        write_map(path, map_with_points(points))
    assert list(tmp_path.iterdir()) == []


def test_one_file_remains_after_writing_and_after_reading(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    write_map(path, random_map(2))
    write_map(path, random_map(3))
    read_map(path)
    assert list(tmp_path.iterdir()) == [path]


def test_failed_write_leaves_the_old_map(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    write_map(path, random_map(2))
    before = path.read_bytes()
    with pytest.raises(InvalidInput):
        write_map(path, map_with_points(np.full((1, 3), np.nan, dtype=np.float32)))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_old_map_is_replaced_and_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    write_map(path, random_map(2))
    before = path.read_bytes()
    with path.open("rb") as held_open:
        write_map(path, random_map(3))
        assert held_open.read() == before
    assert path.read_bytes() != before


def test_left_over_of_a_killed_writer_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "map.hmt.partial").write_bytes(b"half a map")
    write_map(tmp_path / "map.hmt", random_map(2))
    assert_same_map(read_map(tmp_path / "map.hmt"), random_map(2))


def test_path_that_is_a_folder_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "map.hmt").mkdir()
    with pytest.raises(Unavailable, match="7 keyframes"):
        write_map(tmp_path / "map.hmt", random_map(2))


def test_name_with_special_characters_is_read(tmp_path: Path) -> None:
    path = tmp_path / "50% of #2?mode=memory.hmt"
    write_map(path, random_map(2))
    assert_same_map(read_map(path), random_map(2))


def test_missing_file_and_folder_are_not_found(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"absent\.hmt"):
        read_map(tmp_path / "absent.hmt")
    with pytest.raises(NotFound, match="nowhere"):
        write_map(tmp_path / "nowhere" / "map.hmt", random_map(0))


def test_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    path.write_bytes(b"x" * 5000)
    with pytest.raises(InvalidInput, match="5000 bytes"):
        read_map(path)


def test_database_of_another_program_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE songs (title TEXT)")
    with pytest.raises(InvalidInput, match="another application"):
        read_map(path)


def test_newer_schema_is_refused_with_both_versions(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    write_map(path, random_map(0))
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    with pytest.raises(
        InvalidInput, match=f"version {SCHEMA_VERSION + 1}.* versions 2 to {SCHEMA_VERSION}"
    ):
        read_map(path)


@pytest.mark.parametrize("version", range(2, SCHEMA_VERSION + 1))
def test_every_version_that_was_ever_written_is_read(version: int) -> None:
    # The same map, written by the programs of their time; never to be written anew.
    path = Path(__file__).parent / "golden" / f"map_v{version}.hmt"
    stored = read_map(path)
    assert (len(stored.keyframes), len(stored.scans), len(stored.visits)) == (22, 110, 1)
    assert check_map(path) == ()
    assert map_info(path).schema_version == version
    (area,) = Engine.restored(stored).global_map(MapMethod.CONSISTENT).areas
    assert area.keyframes == 22
    assert len(area.points_in_area) > 100


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.6, 0.9])
def test_truncated_file_is_refused(tmp_path: Path, share: float) -> None:
    path = tmp_path / "map.hmt"
    write_map(path, random_map(0, keyframes=40, points=300))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InvalidInput):
        read_map(path)


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE keyframes SET points_in_body = substr(points_in_body, 1, 30) WHERE keyframe = 3",
        "UPDATE keyframes SET previous_from_body = x'00' WHERE keyframe = 3",
        "UPDATE keyframes SET failure = 'bored' WHERE keyframe = 3",
        "DELETE FROM meta WHERE key = 'seed'",
        "DROP TABLE factors",
    ],
)
def test_damaged_content_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "map.hmt"
    write_map(path, random_map(0))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(damage)
    with pytest.raises(InvalidInput, match="damaged"):
        read_map(path)
