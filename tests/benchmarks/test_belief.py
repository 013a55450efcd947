"""From hypotheses to the report: numbers by hand, and figures that are drawn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from benchmarks.belief import report_of
from benchmarks.calibration import score
from benchmarks.scoring import Decision, Option, Placement, always_new, decide
from benchmarks.world_belief import Alone, WorldBelief
from tests.benchmarks.test_scoring import ALL_NEW, RING, TRUTH, topology

VISITS = range(1, 6)


def right(p: float = 1.0, *, is_return: bool = True) -> Decision:
    """Return a decision for what is right, with this probability."""
    options = [Option(p, is_known=is_return, is_right=True)]
    if p < 1.0:
        options.append(Option(1.0 - p, is_known=not is_return, is_right=False))
    return Decision(tuple(options), is_return)


def wrong(p: float) -> Decision:
    """Return a decision for what is wrong, with this probability; the rest is for what is right."""
    options = Option(p, is_known=False, is_right=False), Option(1 - p, is_known=True, is_right=True)
    return Decision(options, is_return=True)


def world(
    decisions: Sequence[Decision],
    *,
    p_true: float,
    false_loops: int = 0,
    missed_loops: int = 0,
    is_planar: bool = True,
) -> WorldBelief:
    is_right = not false_loops and not missed_loops
    returns = sum(decision.is_return for decision in decisions)
    return WorldBelief(
        is_planar=is_planar,
        p_true=p_true,
        visits=len(decisions) + 1,
        true_returns=returns,
        false_loops=false_loops,
        missed_loops=missed_loops,
        alone=Alone(
            false_loops=0,
            missed_loops=1,
            placement=Placement(10, 3),
            engine_s=3.0,
            engine_alone_s=2.0,
        ),
        placement=Placement(10, 10 if is_right else 4),
        placement_odometry=Placement(10, 5),
        placement_greedy=Placement(10, 2) if is_planar else None,
        placement_peer=None if is_planar else Placement(10, 10),
        decisions=tuple(decisions),
        decisions_always_new=tuple(
            Decision(
                (Option(1.0, is_known=False, is_right=not decision.is_return),), decision.is_return
            )
            for decision in decisions
        ),
        odometry_errors=(1.0, 2.0),
        arc_errors=(0.5,) if is_right else (),
        area_errors=(4.0,) if is_right else (),
    )


NEW = right(is_return=False)
GOOD = world([NEW, NEW, right(), right(0.8)], p_true=0.8)
BAD = world([NEW, right(), wrong(0.9)], p_true=0.1, missed_loops=1)


def test_a_perfect_posterior() -> None:
    scores = score([decide(RING, [topology(RING, TRUTH)], visit) for visit in VISITS])
    assert (scores.brier, scores.log_loss, scores.expected_calibration_error) == (0.0, 0.0, 0.0)


def test_an_over_confident_wrong_posterior() -> None:
    """0.9 on new areas everywhere: wrong about two visits of five."""
    posterior = [topology(RING, ALL_NEW, 0.9), topology(RING, TRUTH, 0.1)]
    scores = score([decide(RING, posterior, visit) for visit in VISITS])
    assert scores.brier == pytest.approx(2 * 0.81 / 5)
    assert scores.log_loss == pytest.approx(2 * 2.302585 / 5)
    assert scores.expected_calibration_error == pytest.approx((3 + 2 * 0.9) / 5 - 3 / 5)


def test_an_under_confident_right_posterior() -> None:
    """0.6 on the truth: right about all five visits, in doubt about two."""
    posterior = [topology(RING, ALL_NEW, 0.4), topology(RING, TRUTH, 0.6)]
    scores = score([decide(RING, posterior, visit) for visit in VISITS])
    assert scores.brier == pytest.approx(2 * 0.16 / 5)
    assert scores.log_loss == pytest.approx(2 * 0.510826 / 5)
    assert scores.expected_calibration_error == pytest.approx(2 * 0.4 / 5)


def test_a_filter_that_always_says_new() -> None:
    scores = score([always_new(RING, visit) for visit in VISITS])
    assert scores.brier == pytest.approx(2 / 5)
    assert scores.log_loss == pytest.approx(2 * 13.815511 / 5)
    assert scores.expected_calibration_error == pytest.approx(2 / 5)


def test_the_numbers_of_a_report(tmp_path: Path) -> None:
    report = report_of({"office": [GOOD], "aliased": [BAD]}, tmp_path)
    values = {metric.key: metric.value for metric in report.metrics}
    assert values["all/worlds"] == 2
    assert values["all/p_true"] == pytest.approx(0.45)
    assert values["all/map_right"] == 0.5
    assert values["all/map_right_alone"] == 0.0
    assert values["all/cost_over_alone"] == pytest.approx(1.5)
    assert values["all/true_returns"] == 4
    assert values["all/missed_loops"] == 1
    assert values["all/missed_loops_per_return"] == 0.25
    assert values["all/false_loops"] == 0
    assert values["all/placed_right"] == pytest.approx(0.7)
    assert values["all/all_placed_right"] == 0.5
    assert values["all/alone/placed_right"] == pytest.approx(0.3)
    assert values["all/alone/all_placed_right"] == 0.0
    assert values["all/greedy/placed_right"] == pytest.approx(0.2)
    assert values["all/greedy/all_placed_right"] == 0.0
    assert "all/kiss_slam/placed_right" not in values
    assert values["all/decisions"] == 7
    assert values["all/brier"] == pytest.approx((0.04 + 0.81) / 7)
    assert values["all/contested/decisions"] == 4
    assert values["all/contested/brier"] == pytest.approx((0.04 + 0.81) / 4)
    # 0.8 is right; of 1, 1 and 0.9, which share a bin, two are.
    assert values["all/contested/calibration_error"] == pytest.approx((0.2 + 0.9) / 4)
    assert values["all/contested/calibration"] == pytest.approx(1.0 - 1.1 / 4)
    assert values["all/contested/p_right"] == pytest.approx((0.8 * 0.1) ** 0.25)
    assert values["all/brier_skill"] == pytest.approx(1.0 - 0.85 / 4)
    assert values["all/log_skill"] == pytest.approx(1.0 + math.log(0.08) / (4 * 13.815511))
    assert values["always_new/map_right"] == 0.0
    assert values["always_new/brier"] == pytest.approx(4 / 7)
    assert values["always_new/placed_right"] == 0.5
    assert values["office/map_right"] == 1.0
    assert values["aliased/map_right"] == 0.0
    assert values["nees_2d/odometry/mean"] == 1.5
    assert values["nees_2d/areas/count"] == 1
    assert values["nees_2d/areas/coverage"] == 0.0  # 3 * 4 is beyond 7.81
    assert not [key for key in values if key.startswith("nees_3d")]
    assert report.skipped == ()


def test_what_has_no_value_is_said(tmp_path: Path) -> None:
    lost = world([NEW], p_true=0.0, false_loops=1, is_planar=False)
    report = report_of({"garage": [lost]}, tmp_path)
    assert report.skipped == (
        "all/contested: none of 1 decisions is",
        "nees_3d/arcs: 1 maps, none of them right",
        "nees_3d/areas: 1 maps, none of them right",
    )
    values = {metric.key: metric.value for metric in report.metrics}
    assert "nees_3d/odometry/mean" in values
    assert values["garage/kiss_slam/all_placed_right"] == 1.0
    assert "garage/greedy/placed_right" not in values


def test_figures_are_drawn(tmp_path: Path) -> None:
    report = report_of({"office": [GOOD, GOOD], "aliased": [BAD]}, tmp_path)
    assert [path.name for path in report.figures] == ["reliability.png", "p_true.png"]
    for path in report.figures:
        image = imread(path)
        assert image.shape[0] > 300
        assert image.shape[1] > 500
        assert np.unique(image.reshape(-1, image.shape[2]), axis=0).shape[0] > 10
