"""Errors over short relations of hand-made trajectories, which follow from how they are made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.short_steps import step_errors
from hmt_service.core.geometry import planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.io.relations import Relations

SECONDS = 20


def drive(steps: dict[int, float] | None = None) -> list[StampedPose]:
    """Return a drive of 1 m/s along x that jumps ahead by so much at some seconds."""
    jumps = np.zeros(SECONDS)
    for second, metres in (steps or {}).items():
        jumps[second] = metres
    at_m = np.arange(SECONDS) + jumps.cumsum()
    return [StampedPose(float(t), planar_pose(x, 0.0, 0.0)) for t, x in enumerate(at_m)]


def relations(pairs: Sequence[tuple[float, float]]) -> Relations:
    true = [planar_pose(second - first, 0.0, 0.0) for first, second in pairs]
    return Relations(np.array(pairs, dtype=np.float64), np.array(true))


EVERY_SECOND = relations([(float(t), float(t + 1)) for t in range(SECONDS - 1)])


def test_the_worst_step_is_told_with_what_the_wheels_say_of_it() -> None:
    errors = step_errors(drive({5: 0.1, 12: -0.4}), drive({5: 0.9, 12: 0.05}), EVERY_SECOND)
    assert errors.relations == SECONDS - 1
    assert errors.worst_m == pytest.approx(0.4)
    assert (errors.worst_from_s, errors.worst_to_s) == (11.0, 12.0)
    assert errors.worst_raw_m == pytest.approx(0.05)
    assert errors.worst_ours_vs_raw_m == pytest.approx(0.45)
    # 18 of 19 errors are 0.1 at most: of the 99 % of the way from the first to the last one, 0.82
    # lie between these two.
    assert errors.p99_m == pytest.approx(0.1 + 0.82 * 0.3)


def test_a_wrong_relation_shows_as_wheels_that_agree_with_us() -> None:
    wrong = relations([(0.0, 1.0), (1.0, 2.0)])
    wrong.first_from_second[1] = planar_pose(3.0, 0.0, 0.0)
    errors = step_errors(drive(), drive(), wrong)
    assert (errors.worst_m, errors.worst_raw_m) == pytest.approx((2.0, 2.0))
    assert errors.worst_ours_vs_raw_m == pytest.approx(0.0)


def test_relations_over_five_seconds_and_more_do_not_count() -> None:
    pairs = relations([(0.0, 5.0), (6.0, 1.0), (4.0, 6.0), (9.0, 7.0)])
    errors = step_errors(drive({8: 0.2}), drive(), pairs)
    assert errors.relations == 2
    assert errors.worst_m == pytest.approx(0.2)


def test_relations_beyond_either_trajectory_do_not_count() -> None:
    pairs = relations([(0.0, 1.0), (9.0, 11.0), (12.0, 13.5), (18.0, 21.0)])
    assert step_errors(drive()[:11], drive(), pairs).relations == 1
    assert step_errors(drive(), drive()[5:], pairs).relations == 1


def test_a_log_without_short_relations_cannot_be_judged() -> None:
    with pytest.raises(InvalidInput, match="none of 0 relations of less than 5 s is covered by"):
        step_errors(drive(), drive(), relations([(0.0, 9.0)]))
