"""Visits: cutting one must not lose or move anything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from hmt_service.core.area_abstraction import cells_of
from hmt_service.core.config import load_config
from hmt_service.core.geometry import (
    GaussianPose,
    identity,
    inverse,
    planar_covariance,
    planar_pose,
    transform_points,
)
from hmt_service.core.submap import Visit, as_points, visit_of
from tests.core.factories import ROOM, cloud_of, keyframes_along, motion_covariance, visit_along

START = planar_pose(-1.5, -0.5, 0.3)
PATH = [START @ planar_pose(0.4 * i, 0.1 * i, 0.2 * i) for i in range(8)]
VISIT = visit_along(ROOM, PATH, visit=5)


def grown(count: int) -> Visit:
    keyframes = keyframes_along(ROOM, PATH[:count])
    visit = visit_of(5, keyframes[:1], load_config())
    for keyframe in keyframes[1:]:
        visit = visit.with_keyframe(keyframe)
    return visit


def test_visit_is_in_the_frame_of_its_first_keyframe() -> None:
    poses = [pose.mean for pose in VISIT.visit_from_keyframe]
    assert poses[0] == pytest.approx(identity())
    assert np.array(poses) == pytest.approx(np.array([inverse(START) @ p for p in PATH]))
    assert (VISIT.first_keyframe, VISIT.last_keyframe) == (0, 7)


def test_visit_that_grew_is_the_visit_of_all_its_keyframes() -> None:
    visit = grown(8)
    assert [k.index for k in visit.keyframes] == [k.index for k in VISIT.keyframes]
    for own, other in zip(visit.visit_from_keyframe, VISIT.visit_from_keyframe, strict=True):
        assert np.array_equal(own.mean, other.mean)
        assert np.array_equal(own.covariance, other.covariance)
    for mine, theirs in zip(visit.cells, VISIT.cells, strict=True):
        assert np.array_equal(mine, theirs)
    assert np.array_equal(visit.points, VISIT.points)


def test_growing_leaves_the_shorter_visit_as_it_was() -> None:
    visit = grown(4)
    before = visit.points
    longer = visit.with_keyframe(keyframes_along(ROOM, PATH[:5])[4])
    assert len(visit.keyframes) == 4
    assert len(longer.keyframes) == 5
    assert visit.points is before
    assert len(longer.points) > len(before)


@given(first_of_new=st.integers(1, 7))
@settings(deadline=None)
def test_cut_keeps_every_keyframe_where_it_is(first_of_new: int) -> None:
    earlier, later, motion = VISIT.split(first_of_new)
    assert (earlier.visit, later.visit) == (5, 6)
    assert earlier.keyframes + later.keyframes == VISIT.keyframes
    assert (earlier.last_keyframe, later.first_keyframe) == (first_of_new - 1, first_of_new)
    rejoined = list(earlier.visit_from_keyframe)
    rejoined += [motion @ pose for pose in later.visit_from_keyframe]
    for own, judge in zip(rejoined, VISIT.visit_from_keyframe, strict=True):
        assert own.mean == pytest.approx(judge.mean, abs=1e-12)
        assert own.covariance == pytest.approx(judge.covariance, abs=1e-12)


def test_submap_lies_on_the_walls_and_covers_what_was_seen() -> None:
    walls = KDTree(cloud_of(ROOM, spacing_m=0.01))
    in_world = VISIT.points_in(START)
    assert np.max(walls.query(in_world)[0]) < 0.006
    submap = KDTree(in_world)
    for keyframe, pose in zip(VISIT.keyframes, PATH, strict=True):
        seen = transform_points(pose, keyframe.points_in_body)
        assert np.max(submap.query(seen)[0]) < 0.05 * np.sqrt(2.0) + 1e-6


def test_submap_has_one_point_per_half_voxel() -> None:
    cells = cells_of(VISIT.points, 0.5 * VISIT.config.odometry.voxel_size_m)
    assert len(cells) == len(VISIT.points)


def test_extent_holds_the_path_and_most_of_the_points() -> None:
    positions = np.array([pose.mean[:3, 3] for pose in VISIT.visit_from_keyframe])
    distances = np.linalg.norm(positions - VISIT.centre, axis=1)
    assert distances.max() == pytest.approx(VISIT.radius_m)
    assert VISIT.centre == pytest.approx(0.5 * (positions.min(axis=0) + positions.max(axis=0)))
    reached = np.linalg.norm(VISIT.points - VISIT.centre, axis=1) <= VISIT.reach_m
    assert np.mean(reached) == pytest.approx(0.9, abs=0.01)


def test_stored_points_are_single_precision() -> None:
    points = as_points(VISIT.points)
    assert points.dtype == np.float32
    assert points == pytest.approx(VISIT.points, abs=1e-6)


def test_own_errors_cancel_along_the_path() -> None:
    own = planar_covariance(motion_covariance(0.002, 0.01))
    drift = planar_covariance(motion_covariance(0.0005, 0.001))
    keyframes = [
        replace(
            keyframe,
            own_error=own,
            previous_from_body=GaussianPose(identity(), drift + 2.0 * own),
        )
        for keyframe in keyframes_along(ROOM, [identity()] * 21)
    ]
    visit = visit_of(0, keyframes, load_config())
    ends = 2.0 * own[3, 3]
    for count in (1, 5, 20):
        variance = visit.visit_from_keyframe[count].covariance[3, 3]
        assert variance == pytest.approx(ends + count * drift[3, 3], rel=1e-6)
    # Cut in two and joined again, it is the same.
    _, later, motion = visit.split(10)
    assert motion.covariance[3, 3] == pytest.approx(ends + 10 * drift[3, 3], rel=1e-6)
    assert later.visit_from_keyframe[-1].covariance[3, 3] == pytest.approx(
        ends + 10 * drift[3, 3], rel=1e-6
    )


def test_news_are_the_points_in_cells_that_no_keyframe_before_saw() -> None:
    size_m = VISIT.config.areas.cell_size_m
    assert VISIT.news[0].share == 1.0
    assert VISIT.news_of(3).share == VISIT.news[3].share
    for position, news in enumerate(VISIT.news):
        keyframe, pose = VISIT.keyframes[position], VISIT.visit_from_keyframe[position].mean
        seen: set[int] = set().union(*(cells.tolist() for cells in VISIT.cells[:position]))
        is_new = [
            cells_of(transform_points(pose, point[None]), size_m)[0] not in seen
            for point in keyframe.points_in_body
        ]
        assert np.array_equal(news.keyframe.points_in_body, keyframe.points_in_body[is_new])
        assert news.share == pytest.approx(np.mean(is_new))


def test_second_look_from_the_same_place_is_no_news() -> None:
    twice = visit_along(ROOM, [START, START])
    assert twice.news[1].share == 0.0
    assert not len(twice.news[1].keyframe.points_in_body)
