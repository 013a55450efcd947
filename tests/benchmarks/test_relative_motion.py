"""Relative errors of hand-made trajectories, whose numbers follow from how they are made."""

from __future__ import annotations

import math

import pytest

from benchmarks.relative_motion import motion_errors
from hmt_service.core.geometry import Pose, planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput

ANYWHERE = planar_pose(30.0, -4.0, 2.0)


def line(*, scale: float = 1.0, turn_rad: float = 0.0, start: Pose = ANYWHERE) -> list[StampedPose]:
    """Return 40 m along x in steps of 0.5 m, the robot turned by so much from 20 m on."""
    return [
        StampedPose(
            0.1 * step, start @ planar_pose(0.5 * step * scale, 0.0, turn_rad * (step > 40))
        )
        for step in range(81)
    ]


def test_the_same_line_elsewhere_has_no_error() -> None:
    errors = motion_errors(line(start=planar_pose(0.0, 0.0, 0.0)), line())
    assert errors.translation_m == pytest.approx(0.0, abs=1e-9)
    assert errors.rotation_deg == pytest.approx(0.0, abs=1e-4)


def test_two_percent_are_twenty_centimetres_over_ten_metres() -> None:
    # Of 62 stretches the last one has 19 steps, 9.5 m: within a tenth of 10 m it counts.
    expected_m = (61 * 0.2 + 0.19) / 62
    assert motion_errors(line(scale=1.02), line()).translation_m == pytest.approx(expected_m)


def test_a_turn_shows_in_the_stretches_across_it_and_the_way_askew_after_it() -> None:
    errors = motion_errors(line(turn_rad=math.radians(6.0)), line())
    # Of the 62 stretches, those that begin at step 21 to 40.
    assert errors.rotation_deg == pytest.approx(6.0 * 20 / 62, rel=1e-6)
    # Those that begin later, 20 of 10 m and one of 9.5 m, are driven askew.
    askew = 2.0 * math.sin(math.radians(3.0))
    assert errors.translation_m == pytest.approx(askew * (20 * 10.0 + 9.5) / 62, rel=1e-6)


def test_a_path_that_is_too_short_cannot_be_judged() -> None:
    with pytest.raises(InvalidInput, match="10 true poses have no two 10 m of path apart"):
        motion_errors(line()[:10], line()[:10])
