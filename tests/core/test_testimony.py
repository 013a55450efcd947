"""What somebody says of two areas: exact on hypotheses built by hand, and in an engine."""

from __future__ import annotations

import math
from itertools import count

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hmt_service.core.awakening import anywhere
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import GaussianPose, Pose, inverse, log, planar_pose
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.odometry import Odometry
from hmt_service.core.testimony import Statement, hear, unhear
from hmt_service.core.types import EventKind, MapMethod
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from tests.core.factories import RING, drive, gaussian, ring_path

SIGMA_M, SIGMA_RAD = 0.1, 0.02
SETTINGS = "areas: {max_cut: 0.8}"
"""Makes six areas of a lap that is not closed."""


def hypothesis(identifier: int, mass: float, *steps: GaussianPose) -> Hypothesis:
    """Return one whose visits are all to new areas, a step from each other."""
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    for visit, step in enumerate(steps):
        graph.fuse_factor(Factor(visit, visit + 1, step))
    topology = Topology(tuple(Assignment(v, v, None) for v in range(len(steps) + 1)))
    return Hypothesis(identifier, math.log(mass), topology, graph)


def step(x: float, y: float, yaw: float, *, sigma_m: float = 0.2) -> GaussianPose:
    return gaussian(planar_pose(x, y, yaw), sigma_m=sigma_m, sigma_rad=SIGMA_RAD)


def said(pose: Pose, probability: float, *, area_b: int = 2) -> Statement:
    told = gaussian(pose, sigma_m=SIGMA_M, sigma_rad=SIGMA_RAD)
    return Statement.of(0, 0, area_b, told, probability, is_planar=True)


def masses(hypotheses: list[Hypothesis]) -> dict[int, float]:
    weights = np.exp([h.log_weight for h in hypotheses])
    return dict(zip([h.hypothesis for h in hypotheses], weights / weights.sum(), strict=True))


def likelihood(hypothesis: Hypothesis, statement: Statement) -> float:
    predicted = hypothesis.graph.relative(statement.area_a, statement.area_b)
    xi = log(inverse(statement.a_from_b.mean) @ predicted.mean)[[2, 3, 4]]
    covariance = (predicted.covariance + statement.a_from_b.covariance)[2:5, 2:5]
    return float(multivariate_normal(cov=covariance).pdf(xi))


def children(hypotheses: list[Hypothesis], *statements: Statement) -> list[Hypothesis]:
    identifiers = count(100)
    for statement in statements:
        heard = hear(hypotheses, statement, identifiers.__next__)
        hypotheses = [child for _, child in heard]
    return hypotheses


def taken_back(hypotheses: list[Hypothesis], *statements: Statement) -> list[Hypothesis]:
    for statement in statements:
        hypotheses = [child for _, child in unhear(hypotheses, statement)]
    return hypotheses


def test_hypotheses_weigh_what_they_predicted() -> None:
    one = hypothesis(0, 0.3, step(4.0, 0.0, 0.0), step(4.0, 0.0, 0.0))
    other = hypothesis(1, 0.7, step(4.0, 0.0, 0.0), step(4.0, 0.6, 0.05))
    statement = said(planar_pose(8.0, 0.1, 0.0), 0.9)
    volume = (2 * 10.0 + 8.0) * (2 * 10.0 + 0.6) * 2.0 * math.pi
    of_one, of_other = likelihood(one, statement), likelihood(other, statement)
    of_wrong = 0.5 / volume + 0.5 * (0.3 * of_one + 0.7 * of_other)
    expected = {
        100: 0.7 * 0.9 * of_other,
        1: 0.7 * 0.1 * of_wrong,
        101: 0.3 * 0.9 * of_one,
        0: 0.3 * 0.1 * of_wrong,
    }
    total = sum(expected.values())
    heard = masses(children([other, one], statement))
    assert heard == pytest.approx({k: v / total for k, v in expected.items()}, rel=1e-4)


def test_nobody_is_believed_more_than_he_believes_himself() -> None:
    right = hypothesis(0, 0.5, step(4.0, 0.0, 0.0, sigma_m=0.02), step(4.0, 0.0, 0.0))
    rival = hypothesis(1, 0.5, step(4.0, 0.0, 0.0, sigma_m=0.02), step(4.0, 2.0, 0.0))
    exactly = Statement.of(
        0, 0, 2, gaussian(planar_pose(8.0, 0.0, 0.0), sigma_m=1e-3), 0.9, is_planar=True
    )
    heard = masses(children([right, rival], exactly))
    # The rival keeps what is left for the author to be wrong, half of it or less.
    assert 0.02 < heard[1] < 0.1
    assert sum(heard[h] for h in (0, 1)) > 0.05


def test_who_knows_nothing_believes_as_much_as_is_said() -> None:
    apart = hypothesis(0, 1.0, step(4.0, 0.0, 0.0), anywhere(is_planar=True))
    there = planar_pose(2.0, 7.0, 1.0)
    right, wrong = children([apart], said(there, 0.8))
    assert masses([right, wrong]) == pytest.approx({100: 0.8, 0: 0.2})
    assert right.graph.part_of(0) == {0, 1, 2}
    np.testing.assert_allclose(right.graph.pose(2), there, atol=1e-3)
    assert right.graph.relative(0, 2).sigma_m < 2.0 * SIGMA_M
    assert wrong.graph.part_of(0) == {0, 1}
    (again,) = {h.graph.part_of(0) for h in taken_back([right, wrong], said(there, 0.8))}
    assert again == {0, 1}


SIGMAS = [(0.1, 0.02), (0.02, 0.2), (1e-4, 1e-5), (100.0, 1.0)]


@pytest.mark.parametrize("area_b", [1, 2])
@pytest.mark.parametrize(("sigma_m", "sigma_rad"), SIGMAS)
def test_what_is_taken_back_leaves_nothing(area_b: int, sigma_m: float, sigma_rad: float) -> None:
    before = hypothesis(0, 1.0, step(4.0, 0.0, 0.0), step(4.0, 0.0, 0.5))
    told = gaussian(planar_pose(4.0 * area_b, 0.3, 0.2), sigma_m=sigma_m, sigma_rad=sigma_rad)
    statement = Statement.of(5, 0, area_b, told, 0.99, is_planar=True)
    heard = children([before], statement)
    assert not np.allclose(heard[0].graph.poses(), before.graph.poses(), rtol=1e-9, atol=1e-9)
    assert len(heard[0].graph.factors) == 3 if area_b == 2 else 2
    for child in taken_back(heard, statement):
        assert child.told == ()
        np.testing.assert_allclose(child.graph.poses(), before.graph.poses(), atol=1e-5)
        np.testing.assert_allclose(
            child.graph.relative(0, 2).covariance,
            before.graph.relative(0, 2).covariance,
            rtol=1e-3,
            atol=1e-10,
        )
    assert taken_back([before], statement) == [before]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_statements_of_one_pair_are_taken_back_in_any_order(order: tuple[int, int]) -> None:
    one = hypothesis(0, 0.5, step(4.0, 0.0, 0.0), step(4.0, 0.0, 0.0))
    other = hypothesis(1, 0.5, step(4.0, 0.0, 0.0), step(4.0, 0.5, 0.0))
    both = [
        Statement.of(
            number, 0, 2, gaussian(planar_pose(8.0, 0.1, yaw), sigma_m=0.05), 0.9, is_planar=True
        )
        for number, yaw in enumerate((0.0, 0.2))
    ]
    after = taken_back(children([one, other], *both), *(both[i] for i in order))
    # What was one hypothesis is one map again, with its mass.
    for before in (one, other):
        same = [h for h in after if h.is_same_map(before)]
        assert len(same) == 4
        total = sum(math.exp(h.log_weight) for h in same)
        assert total == pytest.approx(0.5, rel=1e-9)


def test_the_stored_map_has_one_arc_per_pair() -> None:
    graph = children(
        [hypothesis(0, 1.0, step(4.0, 0.0, 0.0))], said(planar_pose(4.1, 0.0, 0.0), 0.9, area_b=1)
    )[0].graph
    (factor,) = graph.factors
    assert factor.a_from_b.sigma_m < SIGMA_M
    assert 4.0 < factor.a_from_b.mean[0, 3] < 4.1


@pytest.fixture
def ring() -> Engine:
    engine, odometry = Engine(load_config(text=SETTINGS)), Odometry(load_config(text=SETTINGS))
    for reading in drive(RING, ring_path(laps=0.8), noise=np.random.default_rng(0)):
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    return engine


def placed(engine: Engine) -> dict[int, GaussianPose]:
    consistent = engine.global_map(MapMethod.CONSISTENT, with_points=False)
    return {area.area: area.reference_from_area for area in consistent.areas}


def left(engine: Engine) -> tuple[int, int]:
    """Return the first area, and the last one that the robot has left."""
    areas = sorted(placed(engine))
    return areas[0], areas[-2]


def test_a_true_statement_is_believed_and_makes_the_map_better(ring: Engine) -> None:
    first, last = left(ring)
    before = placed(ring)[last]
    told = gaussian(before.mean, sigma_m=0.01, sigma_rad=0.002)
    effect = ring.assert_arc(first, last, told, probability=0.9)
    assert sum(h.after for h in effect.hypotheses if h.is_right) > 0.9
    assert max(h.distance for h in effect.hypotheses if h.distance is not None) < 2.0
    after = placed(ring)[last]
    assert after.sigma_m < 0.5 * before.sigma_m
    (event,) = [e for e in ring.untold() if e.kind is EventKind.ARC_ASSERTED]
    assert event.numbers["probability"] > 0.9
    assert ring.untold() == ()


def test_a_false_statement_is_not_believed(ring: Engine) -> None:
    first, last = left(ring)
    before = placed(ring)
    wrong = gaussian(before[last].mean @ planar_pose(5.0, 0.0, 0.0), sigma_m=0.1, sigma_rad=0.01)
    effect = ring.assert_arc(first, last, wrong, probability=0.99)
    assert sum(h.after for h in effect.hypotheses if h.is_right) < 0.01
    assert effect.hypotheses[0].apart_m == pytest.approx(5.0, abs=0.01)
    for area, pose in placed(ring).items():
        np.testing.assert_allclose(pose.mean, before[area].mean, atol=1e-6)


def test_a_statement_is_taken_back(ring: Engine) -> None:
    first, last = left(ring)
    before, belief = placed(ring), ring.snapshot()
    moved = before[last].mean @ planar_pose(0.05, 0.0, 0.01)
    effect = ring.assert_arc(
        first, last, gaussian(moved, sigma_m=0.02, sigma_rad=0.01), probability=0.95
    )
    assert not np.allclose(placed(ring)[last].mean, before[last].mean, atol=1e-3)
    undone = ring.retract_arc(effect.statement)
    assert undone.revision == effect.revision + 1
    for area, pose in placed(ring).items():
        np.testing.assert_allclose(pose.mean, before[area].mean, atol=1e-6)
        assert pose.sigma_m == pytest.approx(before[area].sigma_m, rel=1e-3, abs=1e-9)
    now = ring.snapshot()
    assert belief is not None
    assert now is not None
    assert now.posterior.current_area == pytest.approx(belief.posterior.current_area, abs=1e-6)
    assert [e.kind for e in ring.untold()][-1] is not EventKind.ARC_ASSERTED
    with pytest.raises(NotFound, match="is not one of this run"):
        ring.retract_arc(effect.statement)


def test_a_map_goes_on_after_a_statement(ring: Engine) -> None:
    first, last = left(ring)
    told = gaussian(placed(ring)[last].mean, sigma_m=0.02, sigma_rad=0.005)
    effect = ring.assert_arc(first, last, told, probability=0.9)
    odometry = Odometry(load_config(text=SETTINGS))
    path = ring_path(laps=1.2)
    expected, again = Engine(load_config(text=SETTINGS)), Engine.restored(ring.stored())
    for reading in drive(RING, path, noise=np.random.default_rng(0)):
        if (tracking := odometry.process(reading)) is None:
            continue
        expected.process(tracking)
        if not ring.misses(tracking) and tracking.stamp_s > stamp_of(ring):
            ring.process(tracking)
    ring.retract_arc(effect.statement)
    theirs = placed(expected)
    for area, pose in placed(ring).items():
        np.testing.assert_allclose(pose.mean[:2, 3], theirs[area].mean[:2, 3], atol=0.05)
    # What was said stays in a map that is stored, and can no longer be taken back.
    assert placed(again)[last].sigma_m < 0.05
    with pytest.raises(NotFound):
        again.retract_arc(effect.statement)


def stamp_of(engine: Engine) -> float:
    return engine.trajectory()[-1].stamp_s


def test_what_makes_no_sense_is_refused(ring: Engine) -> None:
    first, last = left(ring)
    pose = placed(ring)[last].mean
    now = sorted(placed(ring))[-1]
    good = gaussian(pose, sigma_m=0.1, sigma_rad=0.01)
    revision = ring.stored().revision
    with pytest.raises(NotFound, match="area 4711 is not in"):
        ring.assert_arc(first, 4711, good, probability=0.9)
    with pytest.raises(InvalidInput, match="twice"):
        ring.assert_arc(first, first, good, probability=0.9)
    for probability in (0.0, 1.0, math.nan):
        with pytest.raises(InvalidInput, match="probability"):
            ring.assert_arc(first, last, good, probability=probability)
    with pytest.raises(InvalidInput, match="standard deviations"):
        ring.assert_arc(first, last, gaussian(pose, sigma_m=0.0, sigma_rad=0.01), probability=0.9)
    far = gaussian(planar_pose(1e9, 0.0, 0.0), sigma_m=0.1, sigma_rad=0.01)
    with pytest.raises(InvalidInput, match="away"):
        ring.assert_arc(first, last, far, probability=0.9)
    with pytest.raises(Unavailable, match="left it"):
        ring.assert_arc(first, now, good, probability=0.9)
    with pytest.raises(Unavailable, match="no keyframe"):
        Engine(load_config(text=SETTINGS)).assert_arc(0, 1, good, probability=0.9)
    assert ring.stored().revision == revision
