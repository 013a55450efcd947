"""The chain on a ring: decisions, verdicts and errors against a truth that the test chooses."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest

from benchmarks.calibration import consistency, score
from benchmarks.scoring import Placement
from benchmarks.world_belief import WorldBelief, as_result, believe, from_result
from hmt_service.core.config import load_config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Reading, StampedPose
from hmt_service.sim.simulation import Instant
from tests.core.factories import RING, drifting, drive, ring_path

PATH = ring_path(laps=1.5)
LAP = len(ring_path(laps=1.0))
CONFIG = load_config(text="areas: {max_cut: 0.55}")


def instants(*, floors_m: float) -> Iterator[Instant]:
    """Yield a lap and a half around a block; the truth says that the last 3/4 lap is higher."""
    wheels = drifting(PATH, scale=1.03, turn_rad_per_m=0.01)
    readings = drive(RING, PATH, odometry=wheels, noise=np.random.default_rng(1))
    for index, pose in enumerate(PATH):
        truth, place = pose.copy(), int(pose[0, 3] // 4.0) + 10 * int(pose[1, 3] // 4.0)
        if floors_m and index >= LAP * 3 // 4:
            truth[2, 3] += floors_m
            place += 100
        stamp_s = readings[2 * index].stamp_s
        yield Instant(
            StampedPose(stamp_s, truth), place, tuple(readings[2 * index : 2 * index + 2])
        )


class AllKnowing:
    """A peer that was told where the robot is, and how many readings came before it was asked."""

    def __init__(self) -> None:
        self.truth = {i.truth.stamp_s: i.truth for i in instants(floors_m=0.0)}
        self.taken: list[Reading] = []

    def take(self, reading: Reading) -> None:
        self.taken.append(reading)

    def poses(self, stamps_s: FloatArray) -> FloatArray:
        assert len(self.taken) == 2 * len(PATH)
        return np.array([self.truth[stamp_s].reference_from_body for stamp_s in stamps_s])


@cache
def closed_ring() -> WorldBelief:
    return believe(instants(floors_m=0.0), CONFIG, peer=AllKnowing())


def test_a_ring_that_is_closed_is_right() -> None:
    belief = closed_ring()
    assert belief.is_map_right
    assert belief.p_true > 0.99
    # Nothing here is ambiguous for long: one hypothesis finds it too.
    assert belief.alone.is_map_right
    assert belief.alone.engine_s > 0.0
    assert belief.alone.engine_alone_s > 0.0
    assert belief.true_returns >= 2
    assert len(belief.decisions) == len(belief.decisions_always_new) == belief.visits - 1
    assert score(belief.decisions).log_loss < 0.01
    always_new = score(belief.decisions_always_new)
    assert always_new.brier == pytest.approx(belief.true_returns / (belief.visits - 1))


def test_the_map_places_what_returns_and_drifting_motions_alone_do_worse() -> None:
    placed, chained = closed_ring().placement, closed_ring().placement_odometry
    assert placed == Placement(placed.returning, placed.returning)
    assert chained.returning == placed.returning > 20
    assert chained.right <= placed.right
    assert closed_ring().placement_greedy == closed_ring().placement_peer == placed


def test_poses_of_a_right_map_are_about_as_wrong_as_they_say() -> None:
    belief = closed_ring()
    assert belief.is_planar
    assert len(belief.odometry_errors) > 100
    # The readings are without noise: less wrong than they may be, and never more.
    assert 0.1 < consistency(belief.odometry_errors, is_planar=True).mean < 1.2
    for errors in (belief.arc_errors, belief.area_errors):
        assert 0.005 < consistency(errors, is_planar=True).mean < 1.2


def test_the_same_loops_are_false_if_the_truth_is_on_another_floor() -> None:
    belief = believe(instants(floors_m=3.0), CONFIG)
    assert belief.true_returns == 0
    assert belief.false_loops >= 2
    assert belief.missed_loops == 0
    assert belief.p_true < 0.01
    assert belief.arc_errors == belief.area_errors == ()
    assert score(belief.decisions).log_loss > 1.0
    assert score(belief.decisions_always_new).brier == 0.0
    assert belief.placement.returning == 0
    assert belief.placement_peer is None


def test_a_belief_survives_json() -> None:
    belief = closed_ring()
    assert from_result(json.loads(json.dumps(as_result(belief)))) == belief
