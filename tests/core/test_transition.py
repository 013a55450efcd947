"""The topological transition: what a robot may have entered, and how likely that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hmt_service.core.alignment import Aligner, Mode
from hmt_service.core.awakening import put_down
from hmt_service.core.config import load_config
from hmt_service.core.geometry import GaussianPose, Pose, identity, inverse, log, planar_pose
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.observation import ObservationModel
from hmt_service.core.submap import Visit
from hmt_service.core.transition import Successor, Transition
from hmt_service.core.visits import Visits
from tests.core.factories import ROOM, Walls, box, gaussian, line, visit_along

CONFIG = load_config()
SAMPLES = CONFIG.transition.prior_samples
OTHER_ROOM = np.concatenate(
    [box(16.0, -2.0, 24.0, 2.0), box(18.0, -1.0, 19.0, 1.0), box(22.0, 0.5, 23.0, 1.0)]
)
WORLD: Walls = np.concatenate([ROOM, OTHER_ROOM])
IN_ROOM = line(planar_pose(-1.5, 0.2, 0.0), length_m=2.0)
IN_OTHER = line(planar_pose(20.0, 0.0, 0.0), length_m=1.0)


def explored(*paths: Sequence[Pose], sigma_m: float = 0.1) -> tuple[Hypothesis, dict[int, Visit]]:
    """Return a hypothesis that each of these paths was an area of its own, and the visits."""
    visits = {i: visit_along(WORLD, path, visit=i) for i, path in enumerate(paths)}
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    for i in range(1, len(paths)):
        step = inverse(paths[i - 1][0]) @ paths[i][0]
        graph.add_factor(Factor(i - 1, i, gaussian(step, sigma_m=sigma_m, sigma_rad=0.02)))
    assignments = tuple(Assignment(i, i, None) for i in visits)
    return Hypothesis(0, 0.0, Topology(assignments), graph), visits


def successors_of(
    hypothesis: Hypothesis,
    visits: dict[int, Visit],
    path: Sequence[Pose],
    motion: Pose,
    *,
    sigma_m: float = 0.1,
    seed: int = 0,
    aligner: Aligner | None = None,
) -> tuple[Successor, ...]:
    """Return the successors for one more visit along `path`, believed to be `motion` further."""
    observation = ObservationModel(CONFIG.observation, CONFIG.sensor)
    visit = visit_along(WORLD, path, visit=len(visits))
    for known in [*visits.values(), visit]:
        for keyframe in known.keyframes:
            observation.learn(keyframe)
    rng = np.random.default_rng(seed)
    transition = Transition(CONFIG, aligner or Aligner(CONFIG), observation, rng)
    arc = Factor(len(visits) - 1, len(visits), gaussian(motion, sigma_m=sigma_m, sigma_rad=0.02))
    return transition.successors(hypothesis, visit, arc, Visits(visits.values())).successors


class NoAligner(Aligner):
    """Fails when it is asked: work is bounded by never asking for what is far away."""

    def modes(self, visit: Visit, target: Visit, prior: GaussianPose) -> tuple[Mode, ...]:
        raise AssertionError(f"visit {visit.visit} was compared with {target.visit}")


def test_far_from_everything_is_a_new_area_only() -> None:
    hypothesis, visits = explored(IN_ROOM, IN_OTHER)
    (new,) = successors_of(
        hypothesis, visits, IN_ROOM, planar_pose(50.0, 0.0, 0.0), aligner=NoAligner(CONFIG)
    )
    assert new.area is None
    assert new.area_from_visit is None
    assert new.log_factor == pytest.approx(math.log(SAMPLES / (SAMPLES + 1)))


def test_room_that_was_left_and_entered_again_closes_the_loop() -> None:
    hypothesis, visits = explored(IN_ROOM, IN_OTHER)
    back = [pose @ planar_pose(0.3, -0.2, 0.1) for pose in IN_ROOM]
    true_motion = inverse(IN_OTHER[0]) @ back[0]
    drifted = true_motion @ planar_pose(0.3, 0.2, 0.03)
    new, loop = successors_of(hypothesis, visits, back, drifted, sigma_m=0.3)
    assert new.area is None
    assert loop.area == 0
    # Odds of over a hundred to one, from what amounts to one look at one room.
    assert loop.log_factor > new.log_factor + math.log(100.0)
    assert loop.area_from_visit is not None
    error = log(inverse(planar_pose(0.3, -0.2, 0.1)) @ loop.area_from_visit.mean)
    assert np.abs(error).max() < 0.02


def test_other_room_at_the_same_place_is_not_taken_for_the_known_one() -> None:
    # The wheels say that the robot is back in the first room; the laser sees the other one.
    hypothesis, visits = explored(IN_ROOM, line(planar_pose(60.0, 0.0, 0.0), length_m=1.0))
    motion = inverse(planar_pose(60.0, 0.0, 0.0)) @ IN_ROOM[0]
    found = successors_of(hypothesis, visits, IN_OTHER, motion, sigma_m=0.3)
    assert all(each.log_factor < found[0].log_factor for each in found[1:])


def test_current_area_is_no_candidate() -> None:
    hypothesis, visits = explored(IN_OTHER, IN_ROOM)
    found = successors_of(hypothesis, visits, IN_ROOM, identity())
    assert [each.area for each in found] == [None]


def test_areas_far_away_are_no_candidates_however_alike_they_look() -> None:
    hypothesis, visits = explored(IN_ROOM, IN_OTHER, line(planar_pose(60, 0, 0), length_m=1.0))
    # It is IN_ROOM that is seen, 40 m beyond it.
    motion = inverse(planar_pose(60.0, 0.0, 0.0)) @ planar_pose(40.0, 0.2, 0.0)
    near = successors_of(hypothesis, visits, IN_ROOM, motion, sigma_m=0.1)
    assert [each.area for each in near] == [None]
    lost = successors_of(hypothesis, visits, IN_ROOM, motion, sigma_m=20.0)
    assert 0 in [each.area for each in lost]


@pytest.mark.parametrize(
    ("ahead_m", "expected", "tolerance"),
    [(0.0, 1.0 / (SAMPLES + 1), 1e-9), (1.55, 0.5, 0.15), (3.0, SAMPLES / (SAMPLES + 1), 1e-9)],
    ids=["inside", "on the border", "outside"],
)
def test_mass_of_a_new_area_is_what_the_prior_leaves_outside(
    ahead_m: float, expected: float, tolerance: float
) -> None:
    # One known position; with 1.5 m of presence the border cuts the prior in halves.
    hypothesis, visits = explored([identity()], line(planar_pose(20, 0, 0), length_m=1.0))
    motion = inverse(planar_pose(20.0, 0.0, 0.0)) @ planar_pose(0.0, ahead_m, 0.0)
    found = successors_of(hypothesis, visits, [planar_pose(0.0, ahead_m, 0.0)], motion)
    assert math.exp(found[0].log_factor) == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("sigma_m", [0.01, 0.3, 3.0, 30.0])
def test_mass_of_a_new_area_is_never_nothing_and_never_all(sigma_m: float) -> None:
    hypothesis, visits = explored(IN_ROOM, IN_ROOM, IN_OTHER)
    motion = inverse(IN_OTHER[0]) @ IN_ROOM[0]
    found = successors_of(hypothesis, visits, IN_ROOM, motion, sigma_m=sigma_m)
    assert 0.0 < math.exp(found[0].log_factor) < 1.0


def test_unlikely_pose_counts_less() -> None:
    hypothesis, visits = explored(IN_ROOM, IN_OTHER)
    motion, gap_m = inverse(IN_OTHER[0]) @ IN_ROOM[0], 0.6
    likely, unlikely = (
        successors_of(hypothesis, visits, IN_ROOM, motion @ planar_pose(x, 0, 0), sigma_m=0.3)[1]
        for x in (0.0, gap_m)
    )
    assert likely.area_from_visit is not None
    # The rest is the same: only the prior's exponent differs. The variance along x is that of both
    # arcs, of how far the submaps are bent, and of the likelihood: the registration's, widened to
    # what `independent_beams` ranges say that are good to `hit_sigma_m`.
    visit = visit_along(WORLD, IN_ROOM, visit=2)
    observed, points = CONFIG.observation, len(visit.sweep.points)
    mode = Aligner(CONFIG).modes(visit, visits[0], GaussianPose(identity(), 0.1 * np.eye(6)))[0]
    readings = observed.independent_beams * sum(news.share for news in visit.news)
    wider = points / readings * (observed.hit_sigma_m / CONFIG.covariance.sigma_submap_m) ** 2
    bend = mode.target_from_visit.covariance - mode.width
    together = (0.3**2 + 0.1**2) + bend[3, 3] + wider * mode.width[3, 3]
    expected = 0.5 * gap_m**2 / together
    assert likely.log_factor - unlikely.log_factor == pytest.approx(expected, rel=0.05)


def test_same_seed_gives_the_same_factors() -> None:
    hypothesis, visits = explored(IN_ROOM, IN_OTHER)
    motion = inverse(IN_OTHER[0]) @ IN_ROOM[0] @ planar_pose(0.0, 1.5, 0.0)
    runs = [
        [
            s.log_factor
            for s in successors_of(hypothesis, visits, IN_ROOM, motion, sigma_m=0.5, seed=seed)
        ]
        for seed in (1, 1, 2)
    ]
    assert runs[0] == runs[1]
    assert runs[0][0] != runs[2][0]


def recognitions_of(sigma_m: float, path: Sequence[Pose]) -> tuple[Successor, ...]:
    """Return what a finished visit along `path`, to a new area, is recognised as."""
    hypothesis, visits = explored(IN_ROOM, IN_OTHER)
    observation = ObservationModel(CONFIG.observation, CONFIG.sensor)
    visit = visit_along(WORLD, path, visit=2)
    for known in [*visits.values(), visit]:
        for keyframe in known.keyframes:
            observation.learn(keyframe)
    back = inverse(IN_OTHER[0]) @ path[0] @ planar_pose(0.4, 0.3, 0.02)
    arc = Factor(1, 2, gaussian(back, sigma_m=sigma_m, sigma_rad=0.02))
    hypothesis = hypothesis.extended(Assignment(2, 2, None), arc, hypothesis=1, log_weight=0.0)
    transition = Transition(CONFIG, Aligner(CONFIG), observation, np.random.default_rng(0))
    return transition.recognitions(hypothesis, visit, Visits([*visits.values(), visit])).successors


def test_finished_visit_is_recognised_where_its_place_is_in_doubt() -> None:
    path = line(planar_pose(0.5, -0.5, 1.0), length_m=1.0)
    (match,) = recognitions_of(1.5, path)
    truth = inverse(IN_ROOM[0]) @ path[0]
    assert match.area == 0
    assert match.area_from_visit is not None
    assert match.area_from_visit.mean == pytest.approx(truth, abs=0.02)
    assert match.overlap > 0.9
    # Of what is expected almost anywhere, being here tells less.
    (less,) = recognitions_of(3.0, path)
    assert less.log_factor < match.log_factor - 0.5


def test_finished_visit_whose_place_is_known_is_left_to_refinement() -> None:
    path = line(planar_pose(0.5, -0.5, 1.0), length_m=1.0)
    assert recognitions_of(0.05, path) == ()


def beside_a_known_row(*, has_returned: bool) -> float:
    """Return the probability of a new area in a row beside another one, which is not well known.

    Args:
        has_returned: Whether the visit before was to the row that is known.
    """
    row = line(planar_pose(100.0, 0.0, 0.0), length_m=12.0)
    back = line(planar_pose(110.0, 5.0, math.pi), length_m=5.0)
    hypothesis, visits = explored(row, back, sigma_m=4.0)
    if has_returned:
        there = hypothesis.graph.relative(0, 1)
        topology = Topology((Assignment(0, 0, None), Assignment(1, 0, there)))
        hypothesis = replace(hypothesis, topology=topology)
    further = line(planar_pose(105.0, 5.0, math.pi), length_m=2.0)
    found = successors_of(hypothesis, visits, further, inverse(back[0]) @ further[0])
    return math.exp(found[0].log_factor)


def test_who_was_outside_has_not_moved_in_where_he_would_have_been_in_before() -> None:
    assert beside_a_known_row(has_returned=True) < 0.93
    assert beside_a_known_row(has_returned=False) > 0.96


def test_what_is_unlikely_is_not_compared_with_what_is_vaguely_near() -> None:
    hypothesis, visits = explored(IN_ROOM, line(planar_pose(30.0, 0.0, 0.0), length_m=1.0))
    motion = inverse(planar_pose(30.0, 0.0, 0.0)) @ planar_pose(20.0, 0.2, 0.0)
    unlikely = replace(hypothesis, log_weight=math.log(1e-5))
    (new,) = successors_of(
        unlikely, visits, IN_ROOM, motion, sigma_m=10.0, aligner=NoAligner(CONFIG)
    )
    assert new.area is None
    with pytest.raises(AssertionError, match="visit 2 was compared"):
        successors_of(hypothesis, visits, IN_ROOM, motion, sigma_m=10.0, aligner=NoAligner(CONFIG))


@pytest.mark.parametrize(("visits", "odds"), [(1, 9.0), (2, 0.9), (3, 0.1), (4, 0.1)])
def test_who_was_not_recognised_for_long_is_outside(visits: int, odds: float) -> None:
    path = line(planar_pose(60.0, 0.0, 0.0), length_m=1.0)
    hypothesis, known = explored(IN_ROOM)
    for number in range(1, visits + 1):
        known[number] = visit_along(WORLD, path, visit=number)
        arc = Factor(number - 1, number, gaussian(identity(), sigma_m=0.1))
        if number == 1:
            arc = put_down(arc, is_planar=True)
        hypothesis = hypothesis.extended(
            Assignment(number, number, None), arc, hypothesis=0, log_weight=0.0
        )
    observation = ObservationModel(CONFIG.observation, CONFIG.sensor)
    transition = Transition(CONFIG, Aligner(CONFIG), observation, np.random.default_rng(0))
    places = transition.recognitions(hypothesis, known[visits], Visits(known.values()))
    assert math.exp(places.log_searched) == pytest.approx(odds)
