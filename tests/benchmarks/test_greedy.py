"""The chain that commits: right where places differ, wrong where the next room looks the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.greedy import greedy_poses
from hmt_service.core.config import load_config
from hmt_service.core.geometry import FloatArray, planar_pose
from hmt_service.core.submap import Visit, visit_of
from tests.core.factories import CORRIDOR, ROOM, Walls, gaussian, keyframes_along, line

CONFIG = load_config()
INSIDE = line(planar_pose(-1.5, 0.0, 0.0), length_m=3.0)


def visits_to(places: Sequence[Walls], motion_m: float) -> list[Visit]:
    """Return a visit to each of some places; from its frame to the next it is so far."""
    visits: list[Visit] = []
    for number, walls in enumerate(places):
        first = sum(len(visit.keyframes) for visit in visits)
        keyframes = list(keyframes_along(walls, INSIDE, first=first))
        # What goes before is the last keyframe of the visit before, 3 m into it.
        entered = gaussian(planar_pose(motion_m - 3.0, 0.0, 0.0))
        keyframes[0] = replace(keyframes[0], previous_from_body=entered)
        visits.append(visit_of(number, keyframes, CONFIG))
    return visits


def along_m(visits: Sequence[Visit]) -> FloatArray:
    poses: FloatArray = greedy_poses(visits, CONFIG)[:, 0, 3]
    return poses


def test_drift_is_corrected_where_the_robot_is_back() -> None:
    at_m = along_m(visits_to([ROOM, CORRIDOR, ROOM], 0.4))
    assert at_m == pytest.approx([0.0, 0.0, 0.0], abs=0.2)
    assert abs(at_m[2]) < 0.05


def test_a_room_that_looks_the_same_is_taken_for_the_one_known() -> None:
    # 6 m away, which is known to 7 cm: no doubt for a chain that weighs what it knows.
    at_m = along_m(visits_to([ROOM, CORRIDOR, ROOM], 3.0))
    assert at_m[2] < 1.0


@pytest.mark.parametrize("motion_m", [5.0, 9.0])
def test_what_is_out_of_the_window_is_left_alone(motion_m: float) -> None:
    at_m = along_m(visits_to([ROOM, CORRIDOR, ROOM], motion_m))
    assert at_m == pytest.approx([0.0, motion_m, 2 * motion_m], abs=0.1)


def test_what_does_not_fit_is_left_alone() -> None:
    turned = np.asarray(ROOM[:, [1, 0, 3, 2]] * 1.3)
    at_m = along_m(visits_to([ROOM, CORRIDOR, turned], 1.0))
    assert at_m == pytest.approx([0.0, 1.0, 2.0], abs=0.1)
