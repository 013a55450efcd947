"""What is kept of visits, and how far they are from each other."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray, inverse, planar_pose
from hmt_service.core.stored import ScanLog
from hmt_service.core.submap import Visit
from hmt_service.core.visits import Visits, gaps_m, share_new
from tests.core.factories import ROOM, box, line, visit_along

START = planar_pose(-1.5, 0.2, 0.3)
PATH = line(START, length_m=2.0)
OTHER_ROOM = box(16.0, -2.0, 24.0, 2.0)
FAR = line(planar_pose(20.0, 0.0, 0.0), length_m=1.0)


def three() -> list[Visit]:
    return [
        visit_along(ROOM, PATH),
        visit_along(OTHER_ROOM, FAR, visit=1),
        visit_along(ROOM, PATH[::-1], visit=2),
    ]


def poses() -> FloatArray:
    return np.array([PATH[0], FAR[0], PATH[-1]])


def test_forgotten_visits_keep_their_path_and_nothing_else() -> None:
    visits, before = Visits(three()), three()[2]
    extents = visits.extents(3).copy()
    visits.forget(2)
    after = visits[2]
    assert [visits.is_forgotten(visit) for visit in visits] == [False, False, True]
    assert [visits.keyframes(visit) for visit in visits] == [5, 3, 5]
    assert len(before.points) > 0
    assert len(after.points) == sum(len(k.points_in_body) for k in after.keyframes) == 0
    assert (after.visit, after.first_keyframe, after.last_keyframe) == (2, 0, 4)
    for was, now in zip(before.keyframes, after.keyframes, strict=True):
        assert (was.index, was.stamp_s, was.failure) == (now.index, now.stamp_s, now.failure)
        motion, same = was.previous_from_body, now.previous_from_body
        assert same.mean == pytest.approx(motion.mean, abs=1e-6)
        assert same.covariance == pytest.approx(motion.covariance, rel=1e-5, abs=1e-7)
    poses = zip(before.visit_from_keyframe, after.visit_from_keyframe, strict=True)
    for pose, same in poses:
        assert same.mean == pytest.approx(pose.mean, abs=1e-5)
    # Where it was is still known, although nothing is left to find that out from.
    assert np.array_equal(visits.extents(3), extents)


def test_extents_follow_a_visit_that_becomes_longer() -> None:
    short, long = visit_along(ROOM, PATH[:2]), visit_along(ROOM, PATH)
    visits = Visits([short])
    assert visits.extents(1)[0, 3] == pytest.approx(short.radius_m)
    visits.put(long)
    assert visits.extents(1)[0].tolist() == [*long.centre, long.radius_m, long.reach_m]


def test_what_another_visit_has_seen_is_not_new() -> None:
    first, other, again = three()
    assert share_new(again, [first], poses()) < 0.1
    assert share_new(again, [other], poses()) == 1.0
    assert share_new(again, [], poses()) == 1.0
    # The same submap somewhere else would be new there.
    moved = poses()
    moved[0] = PATH[0] @ planar_pose(1.0, 1.0, 0.5)
    assert share_new(again, [first], moved) > 0.5


def test_gap_is_what_lies_between_the_paths() -> None:
    visits = Visits(three())
    placed = poses()
    gaps = gaps_m(visits[2], placed[2], placed[:2], visits.extents(2))
    apart = np.linalg.norm((FAR[0][:3, 3] + FAR[-1][:3, 3] - PATH[0][:3, 3] - PATH[-1][:3, 3]) / 2)
    assert gaps == pytest.approx([-2.0, apart - 1.5])


def test_scans_come_back_as_they_came() -> None:
    log = ScanLog()
    relative = [inverse(PATH[0]) @ pose for pose in PATH]
    for index, pose in enumerate(relative):
        log.append(0.1 * index, 7, pose)
    scans = list(log.scans())
    assert [scan.stamp_s for scan in scans] == [0.1 * index for index in range(len(PATH))]
    assert {scan.keyframe_index for scan in scans} == {7}
    for scan, pose in zip(scans, relative, strict=True):
        assert scan.keyframe_from_body == pytest.approx(pose, abs=1e-6)
    assert list(ScanLog().scans()) == []
