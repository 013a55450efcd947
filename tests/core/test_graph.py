"""The metric graph of a hypothesis, with composition and closed forms of loops as judges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmt_service.core.geometry import (
    PLANAR_AXES,
    GaussianPose,
    exp,
    identity,
    inverse,
    isotropic_covariance,
    log,
    planar_covariance,
    planar_pose,
)
from hmt_service.core.graph import Factor, PoseGraph
from tests.core.factories import gaussian, motion_covariance

PLANE = np.ix_(PLANAR_AXES, PLANAR_AXES)


def chain(*steps: GaussianPose, is_planar: bool = True) -> PoseGraph:
    graph = PoseGraph(is_planar=is_planar)
    graph.add_reference(0)
    for visit, step in enumerate(steps):
        graph.add_factor(Factor(visit, visit + 1, step))
    return graph


def bent_loop(*, sides: int, excess_rad: float) -> PoseGraph:
    """Return a closed polygon of equal arcs that together turn `excess_rad` too far."""
    step = gaussian(planar_pose(2.0, 0.0, (2.0 * math.pi + excess_rad) / sides))
    graph = chain(*[step] * (sides - 1))
    graph.add_factor(Factor(sides - 1, 0, step))
    return graph


@given(
    steps=st.lists(
        st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3)), min_size=1, max_size=6
    ),
    sigma_m=st.floats(0.01, 0.5),
)
@settings(max_examples=30, deadline=None)
def test_chain_is_the_composition_of_its_arcs(
    steps: list[tuple[float, float, float]], sigma_m: float
) -> None:
    arcs = [gaussian(planar_pose(*step), sigma_m=sigma_m) for step in steps]
    graph = chain(*arcs)
    for start in range(len(arcs)):
        composed = arcs[start]
        for end in range(start + 1, len(arcs) + 1):
            relative = graph.relative(start, end)
            assert relative.mean == pytest.approx(composed.mean, abs=1e-6)
            assert relative.covariance[PLANE] == pytest.approx(
                composed.covariance[PLANE], rel=1e-3, abs=1e-8
            )
            if end < len(arcs):
                composed = composed @ arcs[end]


def test_relative_backwards_is_the_inverse() -> None:
    graph = chain(*[gaussian(planar_pose(1.0, 0.2 * i, 0.3)) for i in range(4)])
    forwards, backwards = graph.relative(1, 3), graph.relative(3, 1)
    assert backwards.mean == pytest.approx(inverse(forwards.mean), abs=1e-9)
    assert backwards.covariance[PLANE] == pytest.approx(
        forwards.inverse().covariance[PLANE], abs=1e-9
    )


def test_loop_at_the_end_of_a_kilometre_leaves_the_graph_solvable() -> None:
    step = GaussianPose(
        planar_pose(7.0, 0.0, 0.0),
        planar_covariance(isotropic_covariance(sigma_rad=0.002, sigma_m=0.005)),
    )
    graph = chain(*[step] * 130)
    back = planar_pose(-7.0 * 37, 0.05, 0.0)
    graph.add_factor(Factor(127, 90, GaussianPose(back, step.covariance)))
    straight = math.sqrt(sum((0.002 * 7.0 * i) ** 2 + 0.005**2 for i in range(130)))
    assert graph.relative(0, 130).sigma_m == pytest.approx(straight, rel=0.05)


def test_relative_to_itself_is_certain() -> None:
    graph = chain(gaussian(planar_pose(1.0, 0.0, 0.0)))
    same = graph.relative(1, 1)
    assert same.mean == pytest.approx(identity())
    assert not same.covariance.any()


def test_chain_in_space_is_the_composition_of_its_arcs() -> None:
    rng = np.random.default_rng(2)
    arcs = [
        GaussianPose(exp(rng.normal(0.0, 1.0, 6)), 1e-4 * (root @ root.T + np.eye(6)))
        for root in rng.normal(size=(4, 6, 6))
    ]
    composed = arcs[0] @ arcs[1] @ arcs[2] @ arcs[3]
    relative = chain(*arcs, is_planar=False).relative(0, 4)
    assert relative.mean == pytest.approx(composed.mean, abs=1e-6)
    assert relative.covariance == pytest.approx(composed.covariance, rel=1e-3, abs=1e-7)


def test_loop_without_contradiction_is_the_polygon() -> None:
    graph = bent_loop(sides=6, excess_rad=0.0)
    step = planar_pose(2.0, 0.0, math.pi / 3)
    for visit in range(6):
        assert graph.pose(visit) == pytest.approx(np.linalg.matrix_power(step, visit), abs=1e-6)


@pytest.mark.parametrize("sides", [3, 4, 8])
def test_loop_of_equal_arcs_bears_the_gap_in_equal_parts(sides: int) -> None:
    graph = bent_loop(sides=sides, excess_rad=0.2)
    # No arc differs from another, so neither do their residuals; closed, they turn 2 pi.
    residuals = [
        log(inverse(f.a_from_b.mean) @ inverse(graph.pose(f.visit_a)) @ graph.pose(f.visit_b))
        for f in graph.factors
    ]
    for residual in residuals:
        assert residual == pytest.approx(residuals[0], abs=1e-6)
        assert residual[2] == pytest.approx(-0.2 / sides, abs=1e-6)


def test_loop_on_a_line_bears_the_gap_in_equal_parts() -> None:
    # Without rotation the problem is linear: three arcs of 1 m there, one of 2.6 m that skips them.
    graph = chain(*[gaussian(planar_pose(1.0, 0.0, 0.0)) for _ in range(3)])
    graph.add_factor(Factor(0, 3, gaussian(planar_pose(2.6, 0.0, 0.0))))
    # The gap of 0.4 m over four arcs of equal variance is 0.1 m each.
    for visit in range(4):
        assert graph.pose(visit) == pytest.approx(planar_pose(0.9 * visit, 0.0, 0.0), abs=1e-6)


def test_loop_is_better_known_than_the_chain_by_the_closed_form() -> None:
    # Along x: chain of 3 variances against one of 1: 1 / (1/3 + 1).
    step = GaussianPose(planar_pose(1.0, 0.0, 0.0), motion_covariance(1e-4, 0.1))
    graph = chain(step, step, step)
    assert graph.relative(0, 3).covariance[3, 3] == pytest.approx(0.03, rel=1e-3)
    graph.add_factor(
        Factor(0, 3, GaussianPose(planar_pose(3.0, 0.0, 0.0), motion_covariance(1e-4, 0.1)))
    )
    assert graph.relative(0, 3).covariance[3, 3] == pytest.approx(0.0075, rel=1e-3)


def test_arcs_weigh_by_their_information() -> None:
    graph = chain(gaussian(planar_pose(1.0, 0.0, 0.0), sigma_m=0.1))
    graph.add_factor(Factor(1, 2, gaussian(planar_pose(1.0, 0.0, 0.0), sigma_m=0.2)))
    graph.add_factor(Factor(0, 2, gaussian(planar_pose(2.5, 0.0, 0.0), sigma_m=1e-3)))
    # The gap of 0.5 m goes to the arcs by their variances, 1 : 4.
    assert graph.pose(1)[0, 3] == pytest.approx(1.1, abs=1e-3)


def test_copy_is_independent() -> None:
    graph = chain(gaussian(planar_pose(1.0, 0.0, 0.0)), gaussian(planar_pose(1.0, 0.0, 0.0)))
    before = [graph.pose(visit).copy() for visit in graph.visits]
    sigma = graph.relative(0, 2).covariance.copy()
    other = graph.copy()
    other.add_factor(Factor(0, 2, gaussian(planar_pose(2.4, 0.0, 0.0))))
    other.add_factor(Factor(2, 3, gaussian(planar_pose(1.0, 0.0, 0.0))))
    assert other.pose(2)[0, 3] > 2.1
    assert graph.visits == (0, 1, 2)
    assert len(graph.factors) == 2
    assert [graph.pose(visit).tolist() for visit in graph.visits] == [p.tolist() for p in before]
    assert np.array_equal(graph.relative(0, 2).covariance, sigma)


def test_arc_between_the_same_visits_is_replaced() -> None:
    graph = chain(gaussian(planar_pose(1.0, 0.0, 0.0)))
    graph.add_factor(Factor(0, 1, gaussian(planar_pose(1.4, 0.0, 0.0))))
    graph.add_factor(Factor(1, 0, gaussian(planar_pose(-1.2, 0.0, 0.0), sigma_m=0.2)))
    assert len(graph.factors) == 1
    assert graph.pose(1)[0, 3] == pytest.approx(1.2, abs=1e-6)
    assert math.sqrt(graph.relative(1, 0).covariance[3, 3]) == pytest.approx(0.2, rel=1e-3)


def test_a_visit_between_two_others_is_eliminated_without_loss() -> None:
    graph = chain(*[gaussian(planar_pose(1.0, 0.2, 0.3))] * 3)
    graph.add_factor(Factor(0, 3, gaussian(planar_pose(2.0, 1.5, 1.0), sigma_m=0.2)))
    before, other = [graph.relative(0, visit) for visit in (1, 3)], graph.copy()
    placed = graph.poses()
    graph.eliminate(2, 1)
    assert [(f.visit_a, f.visit_b) for f in graph.factors] == [(0, 1), (0, 3), (1, 3)]
    for visit, known in zip((1, 3), before, strict=True):
        relative = graph.relative(0, visit)
        # But for what is not linear.
        assert np.abs(log(inverse(known.mean) @ relative.mean)).max() < 1e-3
        assert relative.covariance[PLANE] == pytest.approx(
            known.covariance[PLANE], rel=0.02, abs=1e-5
        )
    # It keeps its place beside its anchor, in the order of the visits, and does not come back.
    assert graph.poses() == pytest.approx(placed, abs=1e-3)
    assert graph.pose(2) == pytest.approx(graph.poses()[2], abs=1e-12)
    graph.add_factor(Factor(3, 4, gaussian(planar_pose(1.0, 0.0, 0.0))))
    assert len(graph.poses()) == 5
    assert graph.visits == (0, 1, 2, 3, 4)
    # A copy from before knows nothing of it.
    assert len(other.factors) == 4
    assert np.array_equal(other.poses(), placed)


def test_traversals_that_are_eliminated_are_fused_into_one_arc() -> None:
    # Out and back and out again between two areas, 0 and 1: Eq. (10).
    motion, tie = gaussian(planar_pose(3.0, 0.0, 0.0)), gaussian(identity(), sigma_m=0.01)
    graph = chain(motion, motion.inverse(), motion, motion.inverse(), motion)
    for visit in (2, 3, 4, 5):
        graph.add_factor(Factor(visit % 2, visit, tie))
    before = graph.relative(0, 1)
    for visit in (2, 3, 4):
        graph.eliminate(visit, visit % 2)
    assert [(f.visit_a, f.visit_b) for f in graph.factors] == [(0, 1), (0, 5), (1, 5)]
    after = graph.relative(0, 1)
    assert after.mean == pytest.approx(before.mean, abs=1e-4)
    # What an alignment says is shared out: never surer than all together, and little less sure.
    ratio = np.diag(after.covariance[PLANE]) / np.diag(before.covariance[PLANE])
    assert np.all((ratio > 0.999) & (ratio < 1.3))


def test_what_the_arcs_of_an_eliminated_visit_share_counts_once() -> None:
    # Three areas know each other only by one visit that saw them all.
    graph = chain(gaussian(planar_pose(50.0, 0.0, 0.0), sigma_m=30.0), gaussian(identity()))
    graph.add_factor(Factor(2, 3, gaussian(identity())))
    graph.add_factor(Factor(0, 3, gaussian(planar_pose(1.0, 0.0, 0.0))))
    graph.add_factor(Factor(1, 3, gaussian(planar_pose(-1.0, 0.0, 0.0))))
    before = graph.relative(0, 1).sigma_m
    graph.eliminate(3, 0)
    assert before <= graph.relative(0, 1).sigma_m < 2.0 * before


def test_factors_come_in_the_order_of_their_visits() -> None:
    graph = chain(*[gaussian(planar_pose(1.0, 0.0, 0.0))] * 2)
    assert [(f.visit_a, f.visit_b) for f in graph.factors] == [(0, 1), (1, 2)]


def test_planar_poses_are_planar_exactly() -> None:
    graph = bent_loop(sides=5, excess_rad=0.1)
    # Rounding of long products leaves the plane; the poses must not.
    graph.add_factor(Factor(0, 2, gaussian(graph.pose(2) @ exp(np.full(6, 1e-6)))))
    for visit in graph.visits:
        pose = graph.pose(visit)
        assert pose[2].tolist() == [0.0, 0.0, 1.0, 0.0]
        assert pose[:2, 2].tolist() == [0.0, 0.0]
        assert pose[3].tolist() == [0.0, 0.0, 0.0, 1.0]
