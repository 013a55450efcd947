"""Search over shifts and turns, with an exhaustive one as the judge."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from hmt_service.core.correlation import Raster, View
from hmt_service.core.geometry import FloatArray, Pose, planar_pose, transform_points, yaw_of
from tests.core.factories import ROOM, SQUARE, line, visit_along

CELL_M = 0.25
RASTER = Raster(
    step_rad=0.125, least=0.3, peak_share=0.6, separation_m=0.6, separation_rad=0.15, most=8
)
Seen = tuple[FloatArray, FloatArray]


def seen_along(path: list[Pose], walls: FloatArray = ROOM) -> Seen:
    seen = visit_along(walls, path).seen
    return seen.points, seen.directions


def laid(pose: Pose, seen: Seen) -> Seen:
    points, directions = seen
    return transform_points(pose, points), directions @ pose[:3, :3].T


HERE = seen_along(line(planar_pose(-1.5, 0.0, 0.0), length_m=2.0))


@pytest.mark.parametrize("yaw", [0.0, 0.4, 3.0])
def test_points_are_found_where_they_were_put(yaw: float) -> None:
    put = planar_pose(2.0, -1.0, yaw)
    view = View.of(*laid(put, HERE), cell_m=CELL_M)
    best = view.best_peaks(
        *HERE, middle=np.array([1.0, 0.5]), yaw=yaw + 0.3, reach_m=3.0, reach_rad=0.5, raster=RASTER
    )[0]
    assert best.position == pytest.approx(put[:2, 3], abs=CELL_M)
    assert yaw_of(planar_pose(0.0, 0.0, best.yaw - yaw)) == pytest.approx(0.0, abs=0.07)
    assert best.score > 0.8


def test_nothing_is_found_outside_the_region() -> None:
    view = View.of(*laid(planar_pose(3.0, 0.0, 0.0), HERE), cell_m=CELL_M)
    found = [
        view.best_peaks(
            *HERE, middle=np.zeros(2), yaw=0.0, reach_m=reach_m, reach_rad=0.2, raster=RASTER
        )
        for reach_m in (1.0, 2.0, 4.0)
    ]
    for peaks, reach_m in zip(found, (1.0, 2.0, 4.0), strict=True):
        assert all(np.linalg.norm(p.position) <= reach_m + 2 * CELL_M for p in peaks)
    assert found[2][0].score > 0.9
    assert (
        view.best_peaks(
            *HERE, middle=np.array([500.0, 0.0]), yaw=0.0, reach_m=5.0, reach_rad=0.2, raster=RASTER
        )
        == []
    )


@pytest.mark.parametrize("least", [0.05, 0.3, 0.6])
def test_branch_and_bound_finds_what_an_exhaustive_search_finds(least: float) -> None:
    other = seen_along(line(planar_pose(1.5, 0.5, 2.0), length_m=1.0))
    view = View.of(*HERE, cell_m=CELL_M)
    # One turn and one shift at a time leave nothing to bound.
    every = replace(RASTER, least=1e-6, peak_share=0.0, most=1)
    steps = np.arange(-8, 9)
    scores = {}
    for turn, i, j in itertools.product(range(-3, 4), steps, steps):
        middle = view.low + (np.array([i, j]) + np.array(view.levels.shape[2:]) // 2 + 0.5) * CELL_M
        for peak in view.best_peaks(
            *other,
            middle=middle,
            yaw=0.125 * turn,
            reach_m=-0.9 * CELL_M,
            reach_rad=0.0,
            raster=every,
        ):
            scores[turn, i, j] = peak.score
    centre = view.low + (np.array(view.levels.shape[2:]) // 2 + 0.5) * CELL_M
    peaks = view.best_peaks(
        *other,
        middle=centre,
        yaw=0.0,
        reach_m=7 * CELL_M,
        reach_rad=0.375,
        raster=replace(RASTER, least=least, peak_share=0.0),
    )
    inside = {k: s for k, s in scores.items() if np.hypot(k[1], k[2]) <= 8.0}
    highest = max(inside.values())
    if highest < least:
        assert peaks == []
    else:
        assert peaks[0].score == pytest.approx(highest, abs=1e-6)
    assert all(peak.score >= least for peak in peaks)


def test_a_wall_seen_from_its_other_side_is_another_one() -> None:
    points, directions = HERE
    view = View.of(points, -directions, cell_m=CELL_M)
    peaks = view.best_peaks(
        *HERE, middle=np.zeros(2), yaw=0.0, reach_m=0.3, reach_rad=0.1, raster=RASTER
    )
    assert peaks == []


def test_who_asks_for_a_wider_region_finds_the_same_places() -> None:
    view = View.of(*HERE, cell_m=CELL_M)
    other = seen_along(line(planar_pose(1.0, 0.0, 0.0), length_m=1.0))
    found = [
        view.best_peaks(
            *other,
            middle=np.array([2.4, 0.1]) + shift,
            yaw=0.03 + shift,
            reach_m=1.0 + 3 * shift,
            reach_rad=0.2 + 3 * shift,
            raster=replace(RASTER, most=1),
        )[0]
        for shift in (0.0, 0.05)
    ]
    assert found[0].yaw == found[1].yaw
    assert np.array_equal(found[0].position, found[1].position)


def test_equal_places_are_all_found_once() -> None:
    square = seen_along([planar_pose(0.0, 0.0, 0.0)], SQUARE)
    view = View.of(*square, cell_m=CELL_M)
    peaks = view.best_peaks(
        *square, middle=np.zeros(2), yaw=0.0, reach_m=1.0, reach_rad=np.pi, raster=RASTER
    )
    assert len(peaks) == 4
    turns = sorted(round(peak.yaw / (np.pi / 2)) % 4 for peak in peaks)
    assert turns == [0, 1, 2, 3]
