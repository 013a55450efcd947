"""Smoothing of all keyframes: what is bent becomes straight, what is not there is left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hmt_service.core.config import load_config
from hmt_service.core.geometry import (
    GaussianPose,
    Pose,
    identity,
    inverse,
    planar_pose,
)
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.smoothing import Smoother
from hmt_service.core.submap import Visit, visit_of
from hmt_service.core.visits import Visits
from tests.core.factories import ROOM, keyframes_along, motion_covariance

CONFIG = load_config(text="odometry: {window_keyframes: 3}")
OUT = [planar_pose(-1.0 + 0.25 * i, 0.1 * i, 0.05 * i) for i in range(9)]
PATH = [*OUT, *OUT[::-1]]
STEP = motion_covariance(0.01, 0.03)


def bent(path: Sequence[Pose], *, turn_rad: float) -> list[Visit]:
    """Return two visits, there and back, whose motions all turn too far by so much."""
    wrong = planar_pose(0.0, 0.0, turn_rad)
    keyframes = [
        replace(each, previous_from_body=GaussianPose(each.previous_from_body.mean @ wrong, STEP))
        for each in keyframes_along(ROOM, path, noise=np.random.default_rng(4))
    ]
    half = len(path) // 2
    return [visit_of(0, keyframes[:half], CONFIG), visit_of(1, keyframes[half:], CONFIG)]


def hypothesis_of(visits: Sequence[Visit]) -> Hypothesis:
    there, back = visits
    last = there.visit_from_keyframe[-1] @ back.keyframes[0].previous_from_body
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    graph.add_factor(Factor(0, 1, last))
    return Hypothesis(0, 0.0, Topology((Assignment(0, 0, None), Assignment(1, 1, None))), graph)


def errors_m(poses: Sequence[Pose] | np.ndarray, path: Sequence[Pose]) -> np.ndarray:
    truth = np.array([inverse(path[0]) @ pose for pose in path])
    return np.asarray(np.linalg.norm(np.asarray(poses)[:, :2, 3] - truth[:, :2, 3], axis=1))


def smoothed(visits: Sequence[Visit]) -> tuple[np.ndarray, np.ndarray]:
    """Return the poses before and after."""
    hypothesis, known = hypothesis_of(visits), Visits(visits)
    return hypothesis.keyframe_poses(known.values()), Smoother(CONFIG).smooth(hypothesis, known)


def test_a_bent_path_that_comes_back_becomes_straight() -> None:
    before, after = smoothed(bent(PATH, turn_rad=0.008))
    assert errors_m(before, PATH).max() > 0.1
    # There and back agree; how the first way was bent is seen by the way back only.
    assert errors_m(after, PATH).max() < 0.5 * errors_m(before, PATH).max()
    for out, home in zip(after[:9], after[:8:-1], strict=True):
        assert np.abs((inverse(out) @ home - identity())[:2]).max() < 0.02
    assert after[0] == pytest.approx(before[0], abs=1e-12)


def test_a_path_that_never_comes_back_stays_as_it_is() -> None:
    before, after = smoothed(bent([*OUT[:2], *OUT[2:4]], turn_rad=0.01))
    assert np.array_equal(before, after)


def test_what_has_moved_does_not_bend_the_map() -> None:
    visits = bent(PATH, turn_rad=0.0)
    there, back = visits
    # Half of what one keyframe of the way back saw stands elsewhere.
    moved = back.keyframes[4]
    points = moved.points_in_body.copy()
    points[: len(points) // 3] += np.float32(0.3)
    keyframes = [*back.keyframes[:4], replace(moved, points_in_body=points), *back.keyframes[5:]]
    _, after = smoothed([there, visit_of(1, keyframes, CONFIG)])
    assert errors_m(after, PATH).max() < 0.03


@pytest.mark.parametrize("seed", [0, 1])
def test_planar_poses_stay_planar_and_the_same_bytes_come_twice(seed: int) -> None:
    turn_rad = float(np.random.default_rng(seed).uniform(-0.01, 0.01))
    visits = bent(PATH, turn_rad=turn_rad)
    _, first = smoothed(visits)
    _, second = smoothed(visits)
    assert first.tobytes() == second.tobytes()
    assert not first[:, 2, [0, 1, 3]].any()


def test_a_visit_that_is_tied_by_its_alignment_alone_stays_where_that_says() -> None:
    there, back = bent(PATH, turn_rad=0.008)
    # Lost on the way to a room out of sight of the first: the motion says nothing, and is wrong.
    elsewhere = keyframes_along(ROOM, OUT[:4], first=len(PATH))
    lost = GaussianPose(planar_pose(3.0, 2.0, 0.5), motion_covariance(1.8, 25.0))
    far = visit_of(2, [replace(elsewhere[0], previous_from_body=lost), *elsewhere[1:]], CONFIG)
    place = GaussianPose(planar_pose(20.0, -5.0, 0.3), motion_covariance(0.01, 0.03))
    hypothesis = hypothesis_of([there, back])
    arc = Factor(1, 2, back.visit_from_keyframe[-1] @ lost)
    tied = hypothesis.extended(Assignment(2, 0, place), arc, hypothesis=1, log_weight=0.0)
    known = Visits([there, back, far])
    after = Smoother(CONFIG).smooth(tied, known)
    assert not np.array_equal(after, tied.keyframe_poses(known.values()))
    assert after[len(PATH)] == pytest.approx(place.mean, abs=0.01)
