"""What is kept of visits, and how far they are from each other."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.footprint import footprint_bytes
from hmt_service.core.geometry import FloatArray, inverse, planar_pose
from hmt_service.core.stored import ScanLog
from hmt_service.core.submap import Visit
from hmt_service.core.visits import MemoryBudget, Visits, gaps_m, share_new
from hmt_service.errors import InvalidInput
from hmt_service.io.shelf import DiskShelf
from tests.core.budgets import tiny
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


def test_what_was_used_longest_ago_is_on_the_shelf_and_comes_back() -> None:
    whole = [*three(), visit_along(ROOM, PATH, visit=3), visit_along(ROOM, PATH[::-1], visit=4)]
    sizes = [footprint_bytes(visit) for visit in whole]
    budget = tiny(sum(sizes) - sizes[1] // 2)
    visits = Visits(whole, budget=budget)
    assert visits.usage is not None
    assert visits.usage.shelf_bytes > 0
    # The first one gave way; asked for, it pushes out the next.
    assert visits[0] is not whole[0]
    assert visits[0] is visits[0]
    assert visits[4] is whole[4]
    assert [visits.keyframes(visit) for visit in visits] == [len(v.keyframes) for v in whole]
    for visit, before in zip(visits.values(), whole, strict=True):
        assert np.array_equal(visit.points, before.points)
        assert all(map(np.array_equal, visit.cells, before.cells))
    stored = [keyframe.stamp_s for keyframe in visits.all_keyframes()]
    assert stored == [keyframe.stamp_s for visit in whole for keyframe in visit.keyframes]


def test_no_more_than_the_budget_is_in_memory_whatever_is_asked_for() -> None:
    whole = [*three(), *(visit_along(ROOM, PATH, visit=3 + more) for more in range(5))]
    largest = max(footprint_bytes(visit) for visit in whole)
    visits = Visits(whole, budget=tiny(4 * largest))
    for visit in (0, 1, 5, 2, 0, 7, 3, 6):
        assert len(visits[visit].points)
        assert visits[visit].local_map is not None
        visits.put(visits[7])
        assert visits.usage is not None
        assert visits.usage.held_bytes <= 4 * largest + footprint_bytes(visits[visit])
    visits.forget(1)
    assert visits.is_forgotten(1)
    assert not len(visits[1].points)


def full(shelf: DiskShelf) -> int:
    """Let a shelf take no more, as a full disk does, and return how much it could before."""
    database = shelf._opened()
    (most,) = database.execute("PRAGMA max_page_count").fetchone()
    (pages,) = database.execute("PRAGMA page_count").fetchone()
    database.execute(f"PRAGMA max_page_count = {pages}")
    return int(most)


def test_what_the_shelf_does_not_take_stays_in_memory() -> None:
    whole = [*three(), visit_along(ROOM, PATH, visit=3), visit_along(ROOM, PATH, visit=4)]
    shelf = DiskShelf()
    visits = Visits(whole[:3], budget=tiny(1, shelf))
    assert visits.failure is None
    most = full(shelf)
    for visit in whole[3:]:
        visits.put(visit)
    assert visits.failure is not None
    assert "do not fit" in visits.failure
    assert visits.usage is not None
    assert visits.usage.held_bytes > sum(footprint_bytes(visit) for visit in whole[1:]) * 0.9
    for number, before in enumerate(whole):
        assert np.array_equal(visits[number].points, before.points)
    # As soon as there is room again the budget holds.
    shelf._opened().execute(f"PRAGMA max_page_count = {most}")
    visits.put(visits[4])
    assert visits.failure is None
    assert visits.usage.held_bytes < sum(footprint_bytes(visit) for visit in whole[2:]) * 1.1


def test_a_budget_that_is_too_small_says_so() -> None:
    with pytest.raises(InvalidInput, match="of 5 MB is too small"):
        MemoryBudget(5_000_000, DiskShelf())


def test_footprint_counts_each_array_once_and_what_views_are_of() -> None:
    numbers = np.zeros(100_000)
    alone = footprint_bytes(numbers)
    assert alone == pytest.approx(numbers.nbytes, abs=300)
    assert footprint_bytes((numbers, numbers, numbers[::2])) == pytest.approx(alone, abs=600)
    assert footprint_bytes(numbers[:1]) == pytest.approx(alone, abs=300)
