"""The particle layer: weights, their number, and resampling that is not biased."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import FloatArray, identity, planar_pose
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import (
    Assignment,
    Hypothesis,
    ParticleLayer,
    Topology,
    optimal_resampling,
)
from hmt_service.core.types import DropReason
from tests.core.factories import gaussian


def hypothesis_of(identifier: int, weight: float) -> Hypothesis:
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    return Hypothesis(identifier, math.log(weight), Topology((Assignment(0, 0, None),)), graph)


def layer_of(
    *weights: float, budget: int = 15, negligible_mass: float = 1e-6, seed: int = 0
) -> ParticleLayer:
    layer = ParticleLayer(
        budget=budget, negligible_mass=negligible_mass, rng=np.random.default_rng(seed)
    )
    layer.replace([hypothesis_of(i, weight) for i, weight in enumerate(weights)])
    return layer


def weights_strategy(*, min_size: int = 3) -> st.SearchStrategy[FloatArray]:
    return (
        st.lists(st.floats(-12.0, 0.0), min_size=min_size, max_size=30)
        .map(lambda logs: np.exp(np.array(logs)))
        .map(lambda weights: weights / weights.sum())
    )


@given(weights=weights_strategy(), scale=st.floats(-300.0, 300.0), budget=st.integers(1, 10))
def test_weights_sum_to_one_in_falling_order(
    weights: FloatArray, scale: float, budget: int
) -> None:
    layer = ParticleLayer(budget=budget, negligible_mass=1e-9, rng=np.random.default_rng(1))
    layer.replace(
        [
            replace(hypothesis_of(i, 1.0), log_weight=math.log(weight) + scale)
            for i, weight in enumerate(weights)
        ]
    )
    probabilities = layer.probabilities
    assert len(probabilities) <= budget
    assert probabilities.sum() == pytest.approx(1.0)
    assert np.all(np.diff(probabilities) <= 0.0)
    assert 1.0 <= layer.effective_sample_size <= len(probabilities) + 1e-9
    assert layer.best is layer.hypotheses[0]
    assert [s.probability for s in layer.summaries()] == probabilities.tolist()


@pytest.mark.parametrize(
    ("weights", "expected"),
    [((1.0,), 1.0), ((2.0, 2.0, 2.0, 2.0), 4.0), ((0.5, 0.25, 0.25), 8 / 3)],
)
def test_effective_sample_size_has_known_values(
    weights: tuple[float, ...], expected: float
) -> None:
    assert layer_of(*weights).effective_sample_size == pytest.approx(expected)


def test_reweighting_is_bayes_rule() -> None:
    layer = layer_of(0.5, 0.3, 0.2)
    likelihood = {0: 0.1, 1: 0.4, 2: 0.2}
    layer.reweight(lambda h: math.log(likelihood[h.hypothesis]) - 1000.0)
    assert [h.hypothesis for h in layer.hypotheses] == [1, 0, 2]
    assert layer.probabilities == pytest.approx(np.array([0.12, 0.05, 0.04]) / 0.21)


def test_negligible_hypotheses_are_dropped_and_reported() -> None:
    layer = layer_of(0.6, 0.4, negligible_mass=1e-3)
    layer.replace([hypothesis_of(0, 0.6), hypothesis_of(1, 0.4), hypothesis_of(2, 0.9e-3)])
    (dropped,) = layer.take_dropped()
    assert (dropped.hypothesis, dropped.reason) == (2, DropReason.NEGLIGIBLE)
    assert dropped.limit == 1e-3
    assert math.exp(dropped.log_weight) == pytest.approx(0.9e-3 / 1.0009)
    assert layer.probabilities == pytest.approx([0.6, 0.4])
    layer.replace([hypothesis_of(0, 0.6), hypothesis_of(1, 1.1e-3)])
    assert layer.take_dropped() == ()


def test_budget_is_kept_and_what_is_lost_is_reported() -> None:
    layer = layer_of(1.0, budget=3)
    layer.replace([hypothesis_of(i, 1.0) for i in range(8)])
    dropped = layer.take_dropped()
    assert len(layer.hypotheses) == 3
    assert {(d.reason, d.limit) for d in dropped} == {(DropReason.RESAMPLED, 3)}
    assert sorted([h.hypothesis for h in layer.hypotheses] + [d.hypothesis for d in dropped]) == (
        list(range(8))
    )
    assert layer.probabilities == pytest.approx(np.full(3, 1 / 3))


@given(weights=weights_strategy(min_size=6), budget=st.integers(1, 5), seed=st.integers(0, 999))
def test_resampling_keeps_the_budget_and_the_heavy_ones_exactly(
    weights: FloatArray, budget: int, seed: int
) -> None:
    survivors = optimal_resampling(weights, budget, np.random.default_rng(seed))
    indices = [i for i, _ in survivors]
    assert len(set(indices)) == len(survivors) == budget
    assert indices == sorted(indices)
    assert sum(weight for _, weight in survivors) == pytest.approx(1.0)
    lightest = min(weight for _, weight in survivors)
    for i, weight in survivors:
        assert weight == pytest.approx(max(weights[i], lightest))
    # Whatever was lost is not heavier than what any survivor of the lottery now weighs.
    lost = [float(weights[i]) for i in range(len(weights)) if i not in indices]
    assert max(lost) <= lightest * (1.0 + 1e-9)


@given(seed=st.integers(0, 99))
def test_who_may_keep_only_one_keeps_the_best(seed: int) -> None:
    layer = layer_of(0.3, 0.5, 0.2, budget=1, seed=seed)
    assert [h.hypothesis for h in layer.hypotheses] == [1]
    assert layer.probabilities == pytest.approx([1.0])


def test_where_a_visit_is_in_the_area_just_left_adds_to_how_the_robot_went() -> None:
    before = travelled()
    visit = before.current.visit
    motion = Factor(visit, visit + 1, gaussian(planar_pose(1.0, 0.0, 0.0), sigma_m=0.4))
    place = gaussian(planar_pose(1.4, 0.0, 0.0), sigma_m=0.4)
    after = before.extended(
        Assignment(visit + 1, visit, place), motion, hypothesis=9, log_weight=0.0
    )
    found = after.graph.relative(visit, visit + 1)
    assert found.mean[0, 3] == pytest.approx(1.2, abs=1e-3)
    assert found.sigma_m == pytest.approx(0.4 / np.sqrt(2.0), rel=0.01)


def test_threshold_has_a_known_value() -> None:
    # sum(min(w / k, 1)) = 2 for k = 0.4: only the first is heavier, the rest are worth 0.4 / 0.4.
    weights = np.array([0.6, 0.2, 0.1, 0.1])
    for seed in range(20):
        survivors = dict(optimal_resampling(weights, 2, np.random.default_rng(seed)))
        assert survivors.pop(0) == 0.6
        assert list(survivors.values()) == pytest.approx([0.4])


def test_resampling_is_unbiased() -> None:
    weights = np.array([0.4, 0.15, 0.12, 0.1, 0.08, 0.06, 0.05, 0.04])
    runs, rng = 4000, np.random.default_rng(7)
    mean = np.zeros(len(weights))
    for _ in range(runs):
        for i, weight in optimal_resampling(weights, 4, rng):
            mean[i] += weight / runs
    # A light one of weight w survives with probability w / 0.2 as 0.2: deviation of the mean below
    # sqrt(0.2 * 0.2 / 4 / 4000) = 0.0016; five of them.
    assert mean == pytest.approx(weights, abs=0.008)
    assert mean[0] == pytest.approx(0.4, abs=1e-12)


def test_same_seed_gives_the_same_survivors() -> None:
    weights = np.full(40, 1 / 40)
    runs = [optimal_resampling(weights, 15, np.random.default_rng(3)) for _ in range(2)]
    assert runs[0] == runs[1]
    assert runs[0] != optimal_resampling(weights, 15, np.random.default_rng(4))


def travelled() -> Hypothesis:
    """Return a hypothesis that went 0, 1, and back to 0."""
    step = gaussian(planar_pose(5.0, 0.0, 0.0))
    hypothesis = hypothesis_of(0, 1.0).extended(
        Assignment(1, 1, None), Factor(0, 1, step), hypothesis=1, log_weight=-1.0
    )
    return hypothesis.extended(
        Assignment(2, 0, gaussian(planar_pose(0.4, 0.0, 0.0))),
        Factor(1, 2, gaussian(planar_pose(-5.0, 0.0, 0.0))),
        hypothesis=2,
        log_weight=-2.0,
    )


def test_loop_closure_is_counted_and_ties_the_graph() -> None:
    hypothesis = travelled()
    assert hypothesis.topology.path == (0, 1, 0)
    assert hypothesis.topology.areas == (0, 1)
    assert hypothesis.topology.visits_to[0] == (0, 2)
    assert [(f.visit_a, f.visit_b) for f in hypothesis.graph.factors] == [(0, 1), (0, 2), (1, 2)]
    layer = ParticleLayer(budget=2, negligible_mass=1e-6, rng=np.random.default_rng(0))
    layer.replace([hypothesis])
    (summary,) = layer.summaries()
    assert (summary.areas, summary.loop_closures, summary.current_area) == (2, 1, 0)
    # The chain says 0 m with variance 2, the alignment 0.4 m with variance 1.
    assert hypothesis.area_from_visit(2).mean[0, 3] == pytest.approx(0.4 * 2 / 3, abs=1e-3)
    assert hypothesis.area_from_visit(1).mean == pytest.approx(identity())
    assert not hypothesis.area_from_visit(1).covariance.any()


def test_successors_leave_their_parent_as_it_was() -> None:
    parent = travelled()
    before = [parent.graph.pose(visit).tolist() for visit in parent.graph.visits]
    arc = Factor(2, 3, gaussian(planar_pose(5.0, 0.0, 0.0)))
    new = parent.extended(Assignment(3, 3, None), arc, hypothesis=3, log_weight=0.0)
    known = parent.extended(
        Assignment(3, 1, gaussian(planar_pose(0.5, 0.0, 0.0))), arc, hypothesis=4, log_weight=0.0
    )
    assert new.graph is not known.graph
    assert new.graph.pose(3)[0, 3] != pytest.approx(known.graph.pose(3)[0, 3], abs=0.01)
    assert parent.graph.visits == (0, 1, 2)
    assert [parent.graph.pose(visit).tolist() for visit in parent.graph.visits] == before
    assert (new.topology.areas, known.topology.areas) == ((0, 1, 3), (0, 1))


def test_staying_in_an_area_does_not_lengthen_the_topological_path() -> None:
    stayed = travelled().extended(
        Assignment(3, 0, gaussian(planar_pose(0.5, 0.0, 0.0))),
        Factor(2, 3, gaussian(planar_pose(0.1, 0.0, 0.0))),
        hypothesis=3,
        log_weight=0.0,
    )
    assert stayed.topology.path == (0, 1, 0)
    assert stayed.topology.visits_to[0] == (0, 2, 3)


def with_place(hypothesis: Hypothesis, area: int, x_m: float, *, identifier: int) -> Hypothesis:
    """Return the same but that the last visit was to an area, `x_m` from its founder."""
    place = gaussian(planar_pose(x_m, 0.0, 0.0), sigma_m=0.001, sigma_rad=0.001)
    graph = hypothesis.graph.copy()
    graph.add_factor(Factor(area, hypothesis.current.visit, place))
    topology = hypothesis.topology.with_visit(Assignment(hypothesis.current.visit, area, place))
    return replace(hypothesis, hypothesis=identifier, topology=topology, graph=graph)


def test_two_names_of_one_place_are_one_hypothesis() -> None:
    base = travelled()
    first = with_place(base, 0, 0.4, identifier=10)
    other_name = Assignment(2, 1, first.graph.relative(1, 2))
    second = replace(first, hypothesis=11, topology=base.topology.with_visit(other_name))
    elsewhere = with_place(base, 0, 1.4, identifier=12)
    layer = ParticleLayer(budget=9, negligible_mass=1e-9, rng=np.random.default_rng(0))
    layer.replace(
        [
            replace(hypothesis, log_weight=math.log(weight))
            for hypothesis, weight in ((first, 0.5), (second, 0.3), (elsewhere, 0.2))
        ]
    )
    layer.merge()
    (merged,) = layer.take_dropped()
    assert (merged.hypothesis, merged.reason, merged.limit) == (11, DropReason.SAME_MAP, 10)
    assert [h.hypothesis for h in layer.hypotheses] == [10, 12]
    assert layer.probabilities == pytest.approx([0.8, 0.2])


def test_a_new_area_where_a_known_one_is_stays_another_hypothesis() -> None:
    base = travelled()
    known = with_place(base, 0, 0.4, identifier=10)
    new = replace(known, hypothesis=11, topology=base.topology.with_visit(Assignment(2, 2, None)))
    layer = ParticleLayer(budget=9, negligible_mass=1e-9, rng=np.random.default_rng(0))
    layer.replace([known, new])
    layer.merge()
    assert layer.take_dropped() == ()
    assert len(layer.hypotheses) == 2


def test_what_stays_unlikely_is_forgotten_and_what_recovers_is_not() -> None:
    layer = layer_of(0.9, 0.0999, 1e-4)
    for _ in range(3):
        layer.forget(unlikely_mass=1e-3, patience=3)
    # It becomes likely once: the count begins again.
    layer.reweight(lambda h: 6.0 if h.hypothesis == 2 else 0.0)
    layer.forget(unlikely_mass=1e-3, patience=3)
    layer.reweight(lambda h: -6.0 if h.hypothesis == 2 else 0.0)
    for _ in range(3):
        layer.forget(unlikely_mass=1e-3, patience=3)
    assert layer.take_dropped() == ()
    layer.forget(unlikely_mass=1e-3, patience=3)
    (dropped,) = layer.take_dropped()
    assert (dropped.hypothesis, dropped.reason) == (2, DropReason.UNLIKELY)
    assert layer.probabilities == pytest.approx([0.9, 0.1], abs=1e-3)


@pytest.mark.parametrize("is_same_area", [False, True])
def test_recognised_visit_is_tied_and_may_keep_its_area(is_same_area: bool) -> None:
    arc = Factor(2, 3, gaussian(planar_pose(5.0, 0.0, 0.0), sigma_m=1.0))
    new = travelled().extended(Assignment(3, 3, None), arc, hypothesis=3, log_weight=0.0)
    place = gaussian(planar_pose(0.7, 0.0, 0.0), sigma_m=0.01)
    known = new.recognising(
        1, place, is_same_area=is_same_area, is_found=True, hypothesis=4, log_weight=-1.0
    )
    assert known.topology.areas == ((0, 1) if is_same_area else (0, 1, 3))
    assert known.graph.relative(1, 3).mean[0, 3] == pytest.approx(0.7, abs=0.01)
    assert new.graph.relative(1, 3).mean[0, 3] != pytest.approx(0.7, abs=0.05)
    # What it goes on to see there is held against what it sees into, until it enters another area.
    assert new.sees is None
    assert known.sees == (None if is_same_area else 1)
    onward = Factor(3, 4, gaussian(planar_pose(5.0, 0.0, 0.0)))
    entered = known.extended(Assignment(4, 4, None), onward, hypothesis=5, log_weight=0.0)
    assert entered.sees is None
    # Nobody need be told the same again.
    assert known.has_recognised(new, 1, place.mean)
    assert not new.has_recognised(new, 1, place.mean)
    assert not known.has_recognised(new, 1, planar_pose(2.7, 0.0, 0.0))


def test_a_new_area_may_look_like_a_known_one() -> None:
    arc = Factor(2, 3, gaussian(planar_pose(5.0, 0.0, 0.0), sigma_m=1.0))
    new = travelled().extended(Assignment(3, 3, None), arc, hypothesis=3, log_weight=-1.0)
    assert new.resembling(5.0).log_weight == -1.0
    new = replace(new, look_alike_share=0.3)
    told = new.resembling(5.0)
    assert told.log_weight == pytest.approx(-1.0 + math.log(0.7 + 0.3 * math.exp(5.0)))
    assert told.log_weight_of_unlike == pytest.approx(-1.0)
    # Another place that it may look like is one more reason.
    more = told.resembling(5.0)
    assert more.log_weight == pytest.approx(-1.0 + math.log(0.7 + 0.6 * math.exp(5.0)))
    assert more.log_weight_of_unlike == pytest.approx(-1.0)
    # What it sees next is predicted by both: exactly what one by one predicts.
    gained = more.log_likelihood_of_like(2.0)
    after = more.weighed(gained)
    assert after.log_weight == pytest.approx(-1.0 + math.log(0.7 + 0.6 * math.exp(7.0)))
    assert after.log_weight_of_unlike == pytest.approx(-1.0)
    back = after.weighed(-gained)
    assert back.log_weight == pytest.approx(more.log_weight)
    assert back.log_weight_of_unlike == pytest.approx(-1.0)
    # Nobody has looked in the next area yet.
    onward = Factor(3, 4, gaussian(planar_pose(5.0, 0.0, 0.0)))
    entered = after.extended(Assignment(4, 4, None), onward, hypothesis=5, log_weight=0.0)
    assert entered.log_likelihood_of_like(9.0) == 0.0


@pytest.mark.parametrize("log_resemblance", [-1e4, 1e4])
def test_what_resembles_nothing_or_all_is_no_overflow(log_resemblance: float) -> None:
    arc = Factor(2, 3, gaussian(planar_pose(5.0, 0.0, 0.0), sigma_m=1.0))
    new = travelled().extended(Assignment(3, 3, None), arc, hypothesis=3, log_weight=-1.0)
    told = replace(new, look_alike_share=0.3).resembling(log_resemblance)
    assert told.log_weight_of_unlike == pytest.approx(-1.0, abs=1e-9)
    assert told.log_likelihood_of_like(-3.0) == pytest.approx(-3.0 if log_resemblance > 0 else 0.0)
