"""Arcs and shortest paths, with closed forms, first-order composition and networkx as judges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hmt_service.core.composition import arcs_of, compose_shortest_paths, residual_m
from hmt_service.core.geometry import GaussianPose, Pose, certain, identity, inverse, planar_pose
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.types import Arc
from tests.core.factories import gaussian


def travelled(*steps: tuple[int, GaussianPose | None]) -> Hypothesis:
    """Return a hypothesis of visits to these areas; the graph plays no part."""
    assignments = tuple(Assignment(i, area, pose) for i, (area, pose) in enumerate(steps))
    return Hypothesis(0, 0.0, Topology(assignments), PoseGraph(is_planar=True))


def arc(area_a: int, area_b: int, mean: Pose, *, sigma_m: float = 0.05) -> Arc:
    return Arc(area_a, area_b, gaussian(mean, sigma_m=sigma_m), 1)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def means(poses: dict[int, GaussianPose]) -> dict[int, Pose]:
    return {area: pose.mean for area, pose in poses.items()}


def square(*, gap_m: float) -> list[Arc]:
    """Return four arcs around a square, the worst of which is wrong by `gap_m`."""
    corner = planar_pose(4.0, 0.0, math.pi / 2)
    wrong = corner @ planar_pose(0.0, gap_m, 0.0)
    return [
        arc(0, 1, corner),
        arc(1, 2, corner),
        arc(2, 3, corner),
        Arc(0, 3, gaussian(wrong, sigma_m=0.5).inverse(), 1),
    ]


def test_one_traversal_is_the_motion() -> None:
    motion = gaussian(planar_pose(3.0, 1.0, 0.5))
    (found,) = arcs_of(travelled((0, None), (1, None)), [Factor(0, 1, motion)])
    assert (found.area_a, found.area_b, found.traversals) == (0, 1, 1)
    assert found.a_from_b.mean == pytest.approx(motion.mean)
    assert found.a_from_b.covariance == pytest.approx(motion.covariance)


def test_two_traversals_are_fused_by_their_information() -> None:
    # Eq. (10). From 0 to 1 and, aligned exactly with both, from 0 to 1 again: without rotation the
    # product of Gaussians is the weighted mean.
    exact = gaussian(identity(), sigma_m=1e-9, sigma_rad=1e-9)
    motions = [
        Factor(0, 1, gaussian(planar_pose(5.0, 0.0, 0.0), sigma_m=0.1)),
        Factor(1, 2, gaussian(planar_pose(9.0, 9.0, 2.0), sigma_m=0.1)),
        Factor(2, 3, gaussian(planar_pose(0.0, 3.0, 0.0), sigma_m=0.1)),
        Factor(3, 4, gaussian(planar_pose(5.3, 0.0, 0.0), sigma_m=0.2)),
    ]
    hypothesis = travelled((0, None), (1, None), (2, None), (0, exact), (1, exact))
    arcs = arcs_of(hypothesis, motions)
    assert [(a.area_a, a.area_b, a.traversals) for a in arcs] == [(0, 1, 2), (0, 2, 1), (1, 2, 1)]
    fused = arcs[0].a_from_b
    assert fused.mean == pytest.approx(planar_pose(5.06, 0.0, 0.0), abs=1e-5)
    assert fused.covariance[3, 3] == pytest.approx(1.0 / (1.0 / 0.01 + 1.0 / 0.04), rel=1e-4)


def test_traversal_back_is_the_same_arc() -> None:
    there = planar_pose(5.0, 1.0, 0.7)
    back = Factor(1, 2, gaussian(inverse(there)))
    hypothesis = travelled((0, None), (1, None), (0, gaussian(identity(), sigma_m=1e-9)))
    (found,) = arcs_of(hypothesis, [Factor(0, 1, gaussian(there)), back])
    assert (found.area_a, found.area_b, found.traversals) == (0, 1, 2)
    assert found.a_from_b.mean == pytest.approx(there, abs=1e-6)


def test_alignment_of_both_ends_enters_the_arc() -> None:
    # area_a <- visit_a <- visit_b <- area_b, with the uncertainty of all three.
    start, end = gaussian(planar_pose(0.3, 0.1, 0.2)), gaussian(planar_pose(-0.2, 0.4, -0.1))
    motion = gaussian(planar_pose(4.0, 0.0, 1.0))
    hypothesis = travelled((0, None), (1, None), (0, start), (1, end))
    other = gaussian(planar_pose(7.0, 0.0, 0.0))
    motions = [Factor(0, 1, other), Factor(1, 2, other), Factor(2, 3, motion)]
    expected = start @ motion @ end.inverse()
    alone = arcs_of(hypothesis, motions[2:])[0].a_from_b
    assert alone.mean == pytest.approx(expected.mean)
    assert alone.covariance == pytest.approx(expected.covariance)


def test_motion_inside_one_area_is_no_arc() -> None:
    hypothesis = travelled((0, None), (0, gaussian(identity())))
    assert arcs_of(hypothesis, [Factor(0, 1, gaussian(planar_pose(1.0, 0.0, 0.0)))]) == ()


def test_path_takes_the_better_known_of_two_routes() -> None:
    direct = arc(0, 2, planar_pose(2.5, 0.0, 0.0), sigma_m=0.5)
    around = [arc(0, 1, planar_pose(1.0, 0.0, 0.0)), arc(1, 2, planar_pose(1.0, 0.0, 0.0))]
    poses = compose_shortest_paths([direct, *around], 0, rng())
    assert poses[2].mean == pytest.approx(planar_pose(2.0, 0.0, 0.0))
    direct = arc(0, 2, planar_pose(2.5, 0.0, 0.0), sigma_m=0.01)
    poses = compose_shortest_paths([direct, *around], 0, rng())
    assert poses[2].mean == pytest.approx(planar_pose(2.5, 0.0, 0.0))
    # To 1, too, it is shorter to go directly (0.05 against 0.05 and 0.01).
    assert poses[1].mean == pytest.approx(planar_pose(1.0, 0.0, 0.0))


@given(
    steps=st.lists(
        st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3)), min_size=1, max_size=4
    )
)
@settings(max_examples=10)
def test_sampled_covariance_agrees_with_first_order(
    steps: list[tuple[float, float, float]],
) -> None:
    arcs = [
        Arc(i, i + 1, gaussian(planar_pose(*step), sigma_m=0.05), 1) for i, step in enumerate(steps)
    ]
    poses = compose_shortest_paths(arcs, 0, rng())
    judge = certain(identity())
    for each in arcs:
        judge = judge @ each.a_from_b
        found = poses[each.area_b]
        assert found.mean == pytest.approx(judge.mean)
        sigma = np.sqrt(np.diag(judge.covariance))
        # Of 2,000 samples a correlation is known to 0.022: five of those.
        error = np.abs(found.covariance - judge.covariance) / np.outer(sigma, sigma)
        assert error.max() < 0.12


def test_arc_backwards_is_the_inverse() -> None:
    step = planar_pose(2.0, 1.0, 0.5)
    poses = compose_shortest_paths([arc(0, 1, step)], 1, rng())
    assert poses[0].mean == pytest.approx(inverse(step))


def test_arcs_of_the_tree_agree_and_the_arc_that_closes_the_loop_bears_the_gap() -> None:
    arcs = square(gap_m=0.6)
    poses = means(compose_shortest_paths(arcs, 0, rng()))
    assert [residual_m(each, poses) for each in arcs] == pytest.approx([0.0, 0.0, 0.0, 0.6])


def test_reference_decides_which_arc_bears_the_gap() -> None:
    # From 3, the worst arc leads to 0 only: 3 -> 2 -> 1 -> 0 is better known.
    arcs = square(gap_m=0.6)
    for reference in range(4):
        poses = compose_shortest_paths(arcs, reference, rng())
        assert poses[reference].mean == pytest.approx(identity())
        assert not poses[reference].covariance.any()
        residuals = [residual_m(each, means(poses)) for each in arcs]
        assert residuals == pytest.approx([0.0, 0.0, 0.0, 0.6])


def test_loop_without_a_gap_has_no_residual() -> None:
    arcs = square(gap_m=0.0)
    poses = means(compose_shortest_paths(arcs, 0, rng()))
    assert max(residual_m(each, poses) for each in arcs) == pytest.approx(0.0, abs=1e-9)


def test_areas_that_no_arc_leads_to_are_left_out() -> None:
    poses = compose_shortest_paths([arc(3, 4, planar_pose(1.0, 0.0, 0.0))], 0, rng())
    assert list(poses) == [0]


def test_same_seed_gives_the_same_bytes() -> None:
    first, second = (compose_shortest_paths(square(gap_m=0.1), 0, rng()) for _ in range(2))
    for area, pose in first.items():
        assert pose.covariance.tobytes() == second[area].covariance.tobytes()
