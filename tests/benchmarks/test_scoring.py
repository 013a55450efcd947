"""Topologies of a ring, of a dead end and of a corridor, each judged as the definition says."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.scoring import (
    Decision,
    Journey,
    Option,
    Placement,
    Topology,
    Verdict,
    always_new,
    decide,
    is_true_return,
    judge,
    judge_all,
    placement,
)
from hmt_service.core.geometry import FloatArray, inverse, planar_pose

RIGHT, FALSE_LOOP, MISSED_LOOP = Verdict.RIGHT, Verdict.FALSE_LOOP, Verdict.MISSED_LOOP


def journey(
    poses: Sequence[FloatArray], places: Sequence[int], first_keyframe: Sequence[int]
) -> Journey:
    """Return a journey whose estimates inside the visits have no error."""
    world_from_keyframe = np.array(poses)
    anchors = np.zeros(len(poses), dtype=np.int64)
    for first in first_keyframe:
        anchors[first:] = first
    visit_from_keyframe = np.linalg.inv(world_from_keyframe[anchors]) @ world_from_keyframe
    return Journey(
        world_from_keyframe, np.array(places), visit_from_keyframe, tuple(first_keyframe)
    )


def true_map(travelled: Journey) -> FloatArray:
    """Return the true pose of each visit in the frame of the first."""
    anchors = travelled.world_from_keyframe[list(travelled.first_keyframe)]
    return np.asarray(inverse(anchors[0]) @ anchors)


def topology(travelled: Journey, areas: Sequence[int], probability: float = 1.0) -> Topology:
    return Topology(probability, tuple(areas), true_map(travelled)[: len(areas)])


def moved(claim: Topology, visit: int, visit_from_moved: FloatArray) -> Topology:
    """Return a topology with one visit somewhere else."""
    poses = claim.reference_from_visit.copy()
    poses[visit] = poses[visit] @ visit_from_moved
    return Topology(claim.probability, claim.areas, poses)


LAP = 20
RADIUS_M = 0.5 / math.sin(math.pi / LAP)


def ring(keyframes: int, first_keyframe: Sequence[int]) -> Journey:
    """Return a drive along a ring of 20 m, a keyframe each metre and a new place each 5 m."""
    poses = [
        planar_pose(
            RADIUS_M * math.cos(math.tau * k / LAP),
            RADIUS_M * math.sin(math.tau * k / LAP),
            math.tau * k / LAP + math.pi / 2,
        )
        for k in range(keyframes)
    ]
    return journey(poses, [k % LAP // 5 for k in range(keyframes)], first_keyframe)


def line(positions_m: Sequence[float], first_keyframe: Sequence[int]) -> Journey:
    """Return a drive along a line with a new place each 4 m."""
    poses = [planar_pose(x, 0.0, 0.0) for x in positions_m]
    return journey(poses, [int(x // 4) for x in positions_m], first_keyframe)


RING = ring(30, range(0, 30, 5))
"""A lap and a half: the fifth visit is to the place of the first, the sixth to the second's."""
TRUTH = (0, 1, 2, 3, 0, 1)
ALL_NEW = (0, 1, 2, 3, 4, 5)


def test_what_is_true_is_right() -> None:
    assert judge_all(RING, topology(RING, TRUTH)) == (RIGHT,) * 6


def test_new_areas_in_known_places_are_missed_loops() -> None:
    assert judge_all(RING, topology(RING, ALL_NEW)) == (*(RIGHT,) * 4, MISSED_LOOP, MISSED_LOOP)
    assert [is_true_return(RING, visit) for visit in range(6)] == [False] * 4 + [True] * 2


def test_each_missed_loop_counts_alone() -> None:
    first_missed = judge_all(RING, topology(RING, (0, 1, 2, 3, 4, 1)))
    assert first_missed == (*(RIGHT,) * 4, MISSED_LOOP, RIGHT)


def test_a_visit_put_where_the_robot_was_not_is_a_false_loop() -> None:
    claim = topology(RING, (0, 1, 2, 1))
    poses = claim.reference_from_visit.copy()
    poses[3] = poses[1]  # half a lap away
    assert judge_all(RING, Topology(1.0, claim.areas, poses)) == (*(RIGHT,) * 3, FALSE_LOOP)


@pytest.mark.parametrize(
    ("gap", "verdict"),
    [
        (planar_pose(1.4, 0.0, 0.0), RIGHT),
        (planar_pose(0.0, -1.6, 0.0), FALSE_LOOP),
        (planar_pose(0.0, 0.0, math.radians(14.0)), RIGHT),
        (planar_pose(0.0, 0.0, math.radians(-16.0)), FALSE_LOOP),
    ],
)
def test_the_right_area_at_the_wrong_pose_is_a_false_loop(
    gap: FloatArray, verdict: Verdict
) -> None:
    """The nearest pair is the two anchors, or near them: the gap is the error, without a lever."""
    still = journey([np.eye(4)] * 3, [0, 1, 0], [0, 1, 2])
    claim = moved(topology(still, (0, 1, 0)), 2, gap)
    assert judge(still, claim, 2) is verdict


def test_a_bend_far_from_where_visits_touch_is_no_false_loop() -> None:
    """The visit comes back at 10 m, is turned by 10 degrees, and its anchor is 40 m away."""
    positions = [*np.arange(0.0, 11.0), *np.arange(60.0, 9.0, -1.0)]
    back = line(positions, [0, 11])
    at_10m, turn = planar_pose(-50.0, 0.0, 0.0), planar_pose(0.0, 0.0, math.radians(10.0))
    claim = moved(topology(back, (0, 0)), 1, at_10m @ turn @ inverse(at_10m))
    assert np.linalg.norm((claim.reference_from_visit[1] - true_map(back)[1])[:3, 3]) > 8.0
    assert judge(back, claim, 1) is RIGHT


def test_only_the_founder_says_what_an_area_is() -> None:
    """Visit 3 was wrongly added to area 1, visit 4 is put there too; visit 5 really is there."""
    claim = topology(RING, (0, 1, 2, 1, 1, 1))
    poses = claim.reference_from_visit.copy()
    poses[3] = poses[4] = poses[1]
    verdicts = judge_all(RING, Topology(1.0, claim.areas, poses))
    assert verdicts[3:] == (FALSE_LOOP, FALSE_LOOP, RIGHT)


def test_a_border_inside_a_known_place_misses_nothing() -> None:
    """The first area is 10 m long; coming back, the robot crosses a border in the middle of it."""
    travelled = ring(30, [0, 10, 20, 25])
    assert judge_all(travelled, topology(travelled, (0, 1, 0, 3))) == (RIGHT,) * 4
    assert judge_all(travelled, topology(travelled, (0, 1, 2, 3)))[2:] == (MISSED_LOOP,) * 2
    assert judge_all(travelled, topology(travelled, (0, 1, 2, 0)))[2:] == (MISSED_LOOP, RIGHT)


def test_turning_round_in_a_dead_end_is_no_loop_but_going_on_is() -> None:
    way_out = list(np.arange(0.0, 16.0))
    travelled = line([*way_out, *reversed(way_out)], [0, 8, 16, 24])
    assert [is_true_return(travelled, visit) for visit in range(4)] == [False, False, False, True]
    assert judge_all(travelled, topology(travelled, (0, 1, 2, 3)))[2:] == (RIGHT, MISSED_LOOP)
    assert judge_all(travelled, topology(travelled, (0, 1, 2, 0)))[2:] == (RIGHT, RIGHT)


def test_a_place_seen_less_than_ten_metres_ago_was_not_left() -> None:
    there_and_back = [0.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0, 0.0]
    travelled = line(there_and_back, [0, 3, 6])
    assert travelled.travelled_m[-1] == 8.0
    assert not is_true_return(travelled, 2)
    wider = line([2.5 * x for x in there_and_back], [0, 3, 6])
    assert is_true_return(wider, 2)


@pytest.mark.parametrize(("known", "is_return"), [(4, True), (3, False)])
def test_two_thirds_of_the_keyframes_make_a_return(*, known: int, is_return: bool) -> None:
    known_places, new_places = [0.5] * known, [100.5] * (6 - known)
    travelled = line([0.0, 1.0, 50.0, 51.0, *known_places, *new_places], [0, 2, 4])
    assert is_true_return(travelled, 2) is is_return


def test_a_wall_or_two_metres_keep_places_apart() -> None:
    """The robot comes back to 0 m, or 1.9 m or 2.1 m beside it, or behind a wall."""
    for beside_m, place, is_return in (
        (0.0, 0, True),
        (1.9, 0, True),
        (2.1, 0, False),
        (0.5, 7, False),
    ):
        poses = [planar_pose(0.0, 0.0, 0.0), planar_pose(50.0, 0.0, 0.0)]
        travelled = journey([*poses, planar_pose(0.0, beside_m, 0.0)], [0, 5, place], [0, 1, 2])
        assert is_true_return(travelled, 2) is is_return


def test_placement_asks_each_keyframe_that_returns_wherever_the_borders_are() -> None:
    """Ten keyframes return; the last four of them are 1.6 m from where they really are."""
    true_poses = RING.world_from_keyframe
    assert placement(RING, true_poses) == Placement(10, 10)
    poses = true_poses.copy()
    poses[26:] = poses[26:] @ planar_pose(1.6, 0.0, 0.0)
    assert placement(ring(30, [0]), poses) == Placement(10, 6)
    elsewhere = planar_pose(50.0, -20.0, 1.0) @ true_poses
    assert placement(RING, elsewhere) == Placement(10, 10)


def test_one_option_per_place_that_hypotheses_tell_apart() -> None:
    truth = topology(RING, TRUTH[:5], 0.3)
    hypotheses = [
        truth,
        moved(topology(RING, TRUTH[:5], 0.2), 4, planar_pose(1.0, 0.0, 0.0)),  # the same option
        moved(topology(RING, TRUTH[:5], 0.1), 4, planar_pose(4.0, 0.0, 0.0)),  # another mode
        topology(RING, ALL_NEW[:5], 0.15),
        topology(RING, (0, 1, 1, 3, 4), 0.25),  # another past, but new here as well
    ]
    decision = decide(RING, hypotheses, 4)
    assert decision.is_return
    assert [(o.is_known, o.is_right) for o in decision.options] == [
        (True, True),
        (False, False),
        (True, False),
    ]
    np.testing.assert_allclose([o.probability for o in decision.options], [0.5, 0.4, 0.1])


def test_the_option_believed_most_is_first_though_its_hypotheses_are_light() -> None:
    hypotheses = [
        topology(RING, TRUTH[:5], 0.4),
        topology(RING, ALL_NEW[:5], 0.3),
        topology(RING, ALL_NEW[:5], 0.3),
    ]
    first, second = decide(RING, hypotheses, 4).options
    assert first == Option(0.6, is_known=False, is_right=False)
    assert second == Option(0.4, is_known=True, is_right=True)


def test_always_new_is_certain() -> None:
    assert always_new(RING, 3) == Decision(
        (Option(1.0, is_known=False, is_right=True),), is_return=False
    )
    assert always_new(RING, 4) == Decision(
        (Option(1.0, is_known=False, is_right=False),), is_return=True
    )
