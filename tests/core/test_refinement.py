"""Refinement: ties only where the hypothesis is sure of them."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.alignment import Aligner
from hmt_service.core.config import Config, load_config
from hmt_service.core.geometry import Pose, identity, inverse, log, planar_pose
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.refinement import Refinement
from hmt_service.core.submap import Visit
from hmt_service.core.visits import Visits, share_new
from tests.core.factories import ROOM, SQUARE, box, gaussian, line, visit_along

FAR = np.concatenate([box(40.0, -2.0, 48.0, 2.0), box(42.0, -1.0, 43.0, 1.0)])
WORLD = np.concatenate([ROOM, FAR])
STARTS = [planar_pose(-1.5, 0.2, 0.0), planar_pose(44.0, 0.0, 0.0), planar_pose(-1.2, 0.0, 0.1)]
"""Visits to a room, to another one far away, and to the first one again."""
VISITS = {
    i: visit_along(WORLD, line(start, length_m=1.5), visit=i) for i, start in enumerate(STARTS)
}
TRUTH = inverse(STARTS[0]) @ STARTS[2]


def believed(
    *,
    error: Pose | None = None,
    sigma_m: float = 0.1,
    sigma_rad: float = 0.002,
    loop: Pose | None = None,
) -> Hypothesis:
    """Return a hypothesis that the third visit is where the motion says, off by `error`.

    Args:
        error: Error of the last motion.
        sigma_m: Standard deviation of each motion.
        sigma_rad: Standard deviation of its heading; the rooms are 45 m apart.
        loop: Alignment with the first area; None: the third visit founded an area.
    """
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    end = STARTS[2] if error is None else STARTS[2] @ error
    for a, motion in enumerate((inverse(STARTS[0]) @ STARTS[1], inverse(STARTS[1]) @ end)):
        graph.add_factor(Factor(a, a + 1, gaussian(motion, sigma_m=sigma_m, sigma_rad=sigma_rad)))
    last = Assignment(2, 2, None)
    if loop is not None:
        aligned = gaussian(loop)
        graph.add_factor(Factor(0, 2, aligned))
        last = Assignment(2, 0, aligned)
    return Hypothesis(
        0, 0.0, Topology((Assignment(0, 0, None), Assignment(1, 1, None), last)), graph
    )


def is_tied(hypothesis: Hypothesis, visit_a: int, visit_b: int) -> bool:
    return (visit_a, visit_b) in [(f.visit_a, f.visit_b) for f in hypothesis.graph.factors]


def refined(
    hypothesis: Hypothesis, visits: dict[int, Visit] | None = None, config: Config | None = None
) -> Hypothesis:
    config = config or load_config()
    known = visits or VISITS
    return Refinement(config, Aligner(config)).refine(hypothesis, known[2], Visits(known.values()))


def test_overlapping_visits_are_tied_where_they_align() -> None:
    hypothesis = believed(error=planar_pose(0.05, -0.04, 0.005))
    result = refined(hypothesis)
    assert is_tied(result, 0, 2)
    (tie,) = (f for f in result.graph.factors if (f.visit_a, f.visit_b) == (0, 2))
    assert np.abs(log(inverse(TRUTH) @ tie.a_from_b.mean)).max() < 0.01
    found = result.graph.relative(0, 2)
    assert np.abs(log(inverse(TRUTH) @ found.mean)).max() < 0.015
    assert found.covariance[3, 3] < 0.1 * hypothesis.graph.relative(0, 2).covariance[3, 3]


def test_what_is_refined_is_not_changed() -> None:
    hypothesis = believed(error=planar_pose(0.05, 0.0, 0.0))
    before = hypothesis.graph.pose(2).tolist()
    assert refined(hypothesis) is not hypothesis
    assert not is_tied(hypothesis, 0, 2)
    assert hypothesis.graph.pose(2).tolist() == before


def test_visit_that_an_area_explains_was_to_that_area() -> None:
    hypothesis = believed()
    result = refined(hypothesis)
    assert is_tied(result, 0, 2)
    assert hypothesis.topology.path == (0, 1, 2)
    assert result.topology.path == (0, 1, 0)
    aligned = result.topology.assignments[2].area_from_visit
    assert aligned is not None
    assert np.abs(log(inverse(TRUTH) @ aligned.mean)).max() < 0.01
    assert result.log_weight == hypothesis.log_weight


def test_visit_that_sees_into_an_area_was_not_to_it() -> None:
    # Only the left and the lower wall are those of the small room.
    pillar = box(-2.5, 0.8, -1.8, 1.5)
    small = np.concatenate([box(-4.0, -2.0, 4.0, 2.0), pillar])
    large = np.concatenate([box(-4.0, -2.0, 9.0, 5.0), pillar])
    visits = {
        **VISITS,
        0: visit_along(small, line(STARTS[0], length_m=1.5), visit=0),
        2: visit_along(large, line(STARTS[2], length_m=1.5), visit=2),
    }
    result = refined(believed(), visits)
    assert is_tied(result, 0, 2)
    assert result.topology.path == (0, 1, 2)
    assert result.topology.assignments[2].area_from_visit is None


def test_visit_on_the_border_of_two_areas_is_not_to_a_third() -> None:
    # Each half has seen its walls only; who stands between them sees both.
    pillars = np.concatenate([box(-3.0, 0.8, -2.4, 1.5), box(2.0, -1.6, 2.8, -1.2)])
    left, right = np.array([-4.0, -2.0, 0.0, 2.0]), np.array([0.0, -2.0, 4.0, 2.0])
    halves = [
        np.concatenate([walls[np.abs(walls[:, [0, 2]]).max(axis=1) > 0.0], pillars[of]])
        for walls, of in ((box(*left), slice(4)), (box(*right), slice(4, 8)))
    ]
    both = np.concatenate([box(-4.0, -2.0, 4.0, 2.0), pillars])
    starts = [planar_pose(x, 0.0, 0.0) for x in (-2.5, 1.0, 44.0, -0.75)]
    worlds = [*halves, WORLD, both]
    visits = Visits(
        visit_along(world, line(start, length_m=1.5), visit=i)
        for i, (world, start) in enumerate(zip(worlds, starts, strict=True))
    )
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    for a in range(3):
        motion = gaussian(inverse(starts[a]) @ starts[a + 1], sigma_rad=0.002)
        graph.add_factor(Factor(a, a + 1, motion))
    all_new = Topology(tuple(Assignment(i, i, None) for i in range(4)))
    config = load_config()
    result = Refinement(config, Aligner(config)).refine(
        Hypothesis(0, 0.0, all_new, graph), visits[3], visits
    )
    assert is_tied(result, 0, 3)
    assert is_tied(result, 1, 3)
    assert result.topology.areas == (0, 1, 2)
    # Neither alone explains enough.
    for known in (0, 1):
        assert share_new(visits[3], [visits[known]], result.graph.poses()) > 0.4


def test_alignment_with_its_own_area_is_replaced_by_the_better_one() -> None:
    rough = TRUTH @ planar_pose(0.04, 0.03, 0.0)
    hypothesis = believed(loop=rough)
    result = refined(hypothesis)
    aligned = result.topology.assignments[2].area_from_visit
    assert aligned is not None
    assert np.abs(log(inverse(TRUTH) @ aligned.mean)).max() < 0.01
    assert len(result.graph.factors) == len(hypothesis.graph.factors) == 3
    assert result.topology.path == (0, 1, 0)


@pytest.mark.parametrize("sigma_m", [0.6, 2.0])
def test_uncertain_pairs_are_left_alone(sigma_m: float) -> None:
    hypothesis = believed(sigma_m=sigma_m)
    assert refined(hypothesis) is hypothesis


def test_match_that_contradicts_the_graph_is_refused() -> None:
    # The submaps say 0.1 m, the graph is sure to a few millimetres that they are wrong.
    hypothesis = believed(error=planar_pose(0.1, 0.0, 0.0), sigma_m=1e-3, sigma_rad=1e-5)
    assert refined(hypothesis) is hypothesis


def test_visit_just_before_is_not_tied_twice() -> None:
    starts = [STARTS[1], STARTS[0], STARTS[2]]
    visits = {
        i: visit_along(WORLD, line(start, length_m=1.5), visit=i) for i, start in enumerate(starts)
    }
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    for a in range(2):
        motion = gaussian(inverse(starts[a]) @ starts[a + 1], sigma_rad=0.002)
        graph.add_factor(Factor(a, a + 1, motion))
    before = graph.factors[1].a_from_b
    hypothesis = Hypothesis(
        0, 0.0, Topology(tuple(Assignment(i, i, None) for i in range(3))), graph
    )
    result = refined(hypothesis, visits)
    assert result is hypothesis
    assert result.graph.factors[1].a_from_b is before


def test_rooms_of_different_size_are_not_tied() -> None:
    small = visit_along(box(-1.2, -0.8, 1.5, 0.9), [identity()] * 3, visit=0)
    large = visit_along(SQUARE, [identity()] * 3, visit=2)
    hypothesis = believed()
    assert refined(hypothesis, {**VISITS, 0: small, 2: large}) is hypothesis


def test_number_of_ties_is_bounded() -> None:
    config = load_config(text="refinement: {max_neighbours: 0}")
    hypothesis = believed()
    assert refined(hypothesis, config=config) is hypothesis
