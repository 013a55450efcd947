from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import GlobalMap, MapMethod
from hmt_service.core.versions import recipe_of, version_of
from tests.flat import SETTINGS, readings

clouds = st.lists(st.tuples(*[st.floats(-1e4, 1e4, width=32)] * 3), max_size=4).map(
    lambda rows: np.array(rows, dtype=np.float32).reshape(-1, 3)
)


@given(clouds, clouds)
def test_a_version_is_that_of_the_points(one: np.ndarray, other: np.ndarray) -> None:
    assert 1 <= version_of(one) < 2**48
    assert version_of(one) == version_of(one.copy())
    assert (version_of(one) == version_of(other)) == (one.tobytes() == other.tobytes())


def test_a_recipe_is_that_of_its_parts() -> None:
    assert recipe_of([b"a", b"b"]) == recipe_of(iter([b"a", b"b"]))
    assert recipe_of([b"a"]) != recipe_of([b"b"])


@cache
def maps() -> tuple[Engine, tuple[GlobalMap, ...]]:
    """Return an engine, and its map at several moments of a drive."""
    config = load_config(text=SETTINGS)
    odometry, engine = Odometry(config), Engine(config)
    taken = []
    for number, reading in enumerate(readings(200)):
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
        if number % 40 == 39:
            taken.append(engine.global_map(MapMethod.CONSISTENT))
    return engine, tuple(taken)


def test_versions_change_exactly_when_points_do() -> None:
    _, taken = maps()
    seen: dict[tuple[int, int], np.ndarray] = {}
    changes = 0
    for placed in (area for each in taken for area in each.areas):
        before = seen.setdefault((placed.area, placed.version), placed.points_in_area)
        np.testing.assert_array_equal(before, placed.points_in_area)
        changes += before is placed.points_in_area
    # Different versions are different points, too.
    assert len({points.tobytes() for points in seen.values()}) == len(seen) == changes
    assert len(taken[-1].areas) < len(seen) < sum(len(each.areas) for each in taken)


def test_points_of_known_versions_are_left_out_also_at_the_first_question() -> None:
    engine, taken = maps()
    versions = {area.area: area.version for area in taken[-1].areas}
    for _ in range(2):
        again = engine.global_map(MapMethod.CONSISTENT, known=versions)
        assert {area.area: area.version for area in again.areas} == versions
        assert all(len(area.points_in_area) == 0 for area in again.areas)
        engine._versions.clear()
    stale = {area: version + 1 for area, version in versions.items()}
    whole = engine.global_map(MapMethod.CONSISTENT, known=stale)
    for mine, theirs in zip(whole.areas, taken[-1].areas, strict=True):
        np.testing.assert_array_equal(mine.points_in_area, theirs.points_in_area)


def test_without_points_there_is_no_version() -> None:
    engine, _ = maps()
    bare = engine.global_map(MapMethod.CONSISTENT, with_points=False)
    assert {area.version for area in bare.areas} == {0}
    assert engine.area_details(0, with_points=False).area.version == 0


def test_the_trajectory_is_that_of_all_keyframes_to_the_last_bit() -> None:
    engine, _ = maps()
    poses = engine._particles.best.keyframe_poses(engine._visits.values())
    for pose, scan in zip(engine.trajectory(), engine._scans.scans(), strict=True):
        expected = poses[scan.keyframe_index] @ scan.keyframe_from_body
        np.testing.assert_array_equal(pose.reference_from_body, expected)


def test_a_part_of_the_trajectory_is_that_of_the_whole() -> None:
    engine, _ = maps()
    whole = engine.trajectory()
    part = engine.trajectory_between(whole[30].stamp_s, whole[60].stamp_s)
    assert [pose.stamp_s for pose in part.poses] == [pose.stamp_s for pose in whole[30:61]]
    for mine, theirs in zip(part.poses, whole[30:61], strict=True):
        np.testing.assert_allclose(mine.reference_from_body, theirs.reference_from_body, atol=1e-6)
    assert engine.trajectory_between(5e9, 6e9).poses == ()
    assert not part.is_smoothed
