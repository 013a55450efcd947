"""A stored map goes on in a new session: who wakes up anywhere in it finds out where that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hmt_service.core.awakening import is_anywhere
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import Pose, certain, identity, inverse, log, planar_pose, yaw_of
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredMap, StoredVisit
from hmt_service.core.types import EventKind, Keyframe, MapMethod, Scan, TrackingFailure
from hmt_service.errors import InvalidInput
from tests.core.factories import (
    BEAMS,
    BEARINGS,
    CORRIDOR,
    RING,
    ROOM,
    SQUARE,
    Walls,
    box,
    drive,
    gaussian,
    line,
    motion_covariance,
    processed,
    ring_path,
    shifted,
    trackings_of,
)
from tests.mapped import mapped

LATER_S = 1000.0
BENT = np.concatenate(
    [
        box(0.0, 0.0, 10.0, 8.0),
        [[0.0, 3.0, 7.0, 3.0], [7.0, 3.0, 7.0, 8.0]],
        box(0.0, 0.8, 0.6, 1.6),
        box(3.0, 2.4, 3.8, 3.0),
        box(7.0, 6.0, 7.5, 6.6),
    ]
)
"""A hall that goes on around a corner."""


def carried(before: Sequence[Pose], after: Sequence[Pose], settings: str = "") -> Engine:
    """Map a drive on which the wheels notice nothing of being lifted from one place to another."""
    config = load_config(text=settings)
    engine, odometry = Engine(config), Odometry(config)
    put_down = before[-1] @ inverse(after[0])
    wheels = [*before, *(put_down @ pose for pose in after)]
    noise = np.random.default_rng(2)
    for reading in drive(RING, [*before, *after], odometry=wheels, noise=noise):
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    return engine


def travelled(engine: Engine, walls: Walls, path: Sequence[Pose]) -> Engine:
    """Let an engine map a drive that begins with a new odometry."""
    odometry = Odometry(load_config())
    for reading in drive(walls, path, noise=np.random.default_rng(1)):
        tracking = odometry.process(replace(reading, stamp_s=reading.stamp_s + LATER_S))
        if tracking is not None:
            assert not engine.misses(tracking)
            engine.process(tracking)
    return engine


def _keyframes_of(stored: StoredMap, visit: StoredVisit) -> Sequence[Keyframe]:
    return stored.keyframes[visit.first_keyframe : visit.last_keyframe + 1]


@pytest.fixture(scope="module")
def ring() -> Engine:
    """Return one lap around a block of rooms that differ."""
    engine, odometry = Engine(load_config()), Odometry(load_config())
    for reading in drive(RING, ring_path(laps=1.2), noise=np.random.default_rng(0)):
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    engine.finish()
    return engine


def test_a_place_that_is_known_better_than_one_like_it_gains_nothing_by_that() -> None:
    # Two halls that are equal; of one the map knows what lies around the corner.
    ahead = line(planar_pose(1.5, 1.2, 0.0), length_m=3.0)
    turning = line(planar_pose(5.0, 1.4, 0.1), length_m=3.0)
    around = [*ahead, *turning, *line(planar_pose(8.4, 2.0, 1.5), length_m=4.0)]
    other, there = shifted(BENT, 60.0), planar_pose(60.0, 0.0, 0.0)
    motion = gaussian(inverse(around[-1]) @ there @ ahead[0], sigma_m=0.5)
    mapping = trackings_of(
        (BENT, around, certain(identity())), (other, [there @ pose for pose in ahead], motion)
    )
    engine = Engine.restored(processed(mapping)[0].stored())
    asleep = trackings_of((other, [there @ pose for pose in around], certain(identity())))
    for tracking in asleep:
        engine.process(tracking)
        hypotheses = engine.stored().hypotheses
        for area in (0, 1):
            inside = [h.log_weight for h in hypotheses if h.assignments[-1].area == area]
            assert np.sum(np.exp(inside)) > 0.25


def test_each_way_to_be_in_one_place_is_a_hypothesis_of_its_own() -> None:
    stay = line(identity(), length_m=2.0)
    engine, _ = processed(trackings_of((SQUARE, stay, certain(identity()))))
    again = Engine.restored(engine.stored())
    asleep = trackings_of((SQUARE, [planar_pose(0.5, 0.3, 0.3)], certain(identity())))
    processed(asleep, known=again)
    inside = [h for h in again.stored().hypotheses if h.assignments[-1].area == 0]
    # A square room looks the same after each quarter turn.
    turns = sorted(yaw_of(h.reference_from_visit[1]) for h in inside)
    assert np.diff(turns) == pytest.approx([np.pi / 2.0] * 3, abs=0.02)
    assert min(np.exp([h.log_weight for h in inside])) > 0.02


@pytest.mark.parametrize("name", ["ring", "flat"])
def test_a_restored_map_is_the_map(name: str, ring: Engine) -> None:
    engine = ring if name == "ring" else mapped()
    restored = Engine.restored(engine.stored())
    for method in MapMethod:
        was, now = (e.global_map(method) for e in (engine, restored))
        assert now.probability == pytest.approx(was.probability)
        assert [a.area for a in now.areas] == [a.area for a in was.areas]
        for one, two in zip(now.areas, was.areas, strict=True):
            assert (one.keyframes, one.visits) == (two.keyframes, two.visits)
            assert np.array_equal(one.points_in_area.shape, two.points_in_area.shape)
            gap = log(inverse(one.reference_from_area.mean) @ two.reference_from_area.mean)
            assert np.abs(gap).max() < 1e-3
            assert one.reference_from_area.covariance == pytest.approx(
                two.reference_from_area.covariance, rel=0.3, abs=1e-5
            )
    again, first = restored.stored(), engine.stored()
    assert again.visits == first.visits
    assert len(again.keyframes) == len(first.keyframes)
    assert len(again.scans) == len(first.scans)
    assert again.config_json == first.config_json
    assert [len(h.factors) for h in again.hypotheses] == [len(h.factors) for h in first.hypotheses]


def test_an_empty_map_is_nothing_to_go_on_with(ring: Engine) -> None:
    with pytest.raises(InvalidInput, match="0 hypotheses, 3 visits"):
        Engine.restored(replace(ring.stored(), hypotheses=()))


def test_who_wakes_up_in_a_known_place_knows_soon_where(ring: Engine) -> None:
    known = ring.stored()
    path = ring_path(laps=0.8)[20:60]
    engine = travelled(Engine.restored(known), RING, path)
    (lost, *_) = [e for e in engine.audit.events if e.kind is EventKind.LOST]
    assert "new session" in lost.message
    snapshot = engine.snapshot()
    assert snapshot is not None
    assert snapshot.posterior.hypotheses[0].probability > 0.95
    # The first lap began at the first pose of the path: it is the frame of the map.
    truth = inverse(ring_path(laps=0.8)[0]) @ path[-1]
    last = engine.trajectory()[-1].reference_from_body
    assert np.abs(log(inverse(truth) @ last)[3:]).max() < 0.1
    assert snapshot.reference_from_keyframe.sigma_m < 0.5
    stored = engine.stored()
    begun = stored.keyframes[len(known.keyframes)]
    assert begun.failure is TrackingFailure.NEW_SESSION
    assert [k.index for k in stored.keyframes] == list(range(len(stored.keyframes)))
    assert len(stored.scans) > len(known.scans)
    # It can be told how the new session lies beside the old one along arcs, too.
    shortest = engine.global_map(MapMethod.SHORTEST_PATH, with_points=False)
    assert all(not is_anywhere(area.reference_from_area) for area in shortest.areas)


def test_who_wakes_up_outside_is_in_a_part_of_its_own_until_a_known_place_comes(
    ring: Engine,
) -> None:
    other = np.concatenate([box(0.0, 0.0, 9.0, 5.0), box(3.0, 3.0, 4.5, 3.6), box(6, 0.8, 7, 1.4)])
    path = [planar_pose(1.5 + 0.1 * i, 2.0, 0.0) for i in range(40)]
    engine = travelled(Engine.restored(ring.stored()), other, path)
    snapshot = engine.snapshot()
    assert snapshot is not None
    assert is_anywhere(snapshot.reference_from_keyframe)
    assert snapshot.posterior.current_area.get(len(ring.stored().visits), 0.0) > 0.7
    # The next session wakes up in the old part, and may not take the new one for a neighbour.
    again = travelled(Engine.restored(engine.stored()), RING, ring_path(laps=0.8)[20:60])
    found = again.snapshot()
    assert found is not None
    assert found.posterior.current_area[found.posterior.hypotheses[0].current_area] > 0.95
    assert not is_anywhere(found.reference_from_keyframe)


@pytest.mark.parametrize("there", [130, 190])
def test_who_is_carried_away_finds_out_where_to(there: int) -> None:
    lap, after = ring_path(laps=1.2), ring_path(laps=1.6)[there : there + 70]
    engine = carried(lap, after)
    lost = [event for event in engine.audit.events if event.kind is EventKind.LOST]
    assert len(lost) == 1
    snapshot = engine.snapshot()
    assert snapshot is not None
    # The sides of the ring are alike.
    assert snapshot.localization.probability > 0.9
    assert snapshot.localization.entropy_nat < 0.5
    truth = inverse(lap[0]) @ after[-1]
    for _ in range(2):
        last = engine.trajectory()[-1].reference_from_body
        assert np.abs(log(inverse(truth) @ last)[3:]).max() < 0.15
        engine.finish()
    # The way that nobody drove is no arc.
    best = engine.global_map(MapMethod.CONSISTENT, with_points=False)
    shortest = engine.global_map(MapMethod.SHORTEST_PATH, with_points=False)
    for one, two in zip(best.areas, shortest.areas, strict=True):
        apart = inverse(one.reference_from_area.mean) @ two.reference_from_area.mean
        assert np.abs(log(apart)[3:]).max() < 0.3


@pytest.mark.parametrize("was_found", [False, True])
@pytest.mark.parametrize(("share", "is_carried"), [(0.0, True), (0.3, False)])
def test_new_rooms_may_look_like_known_ones(
    share: float, is_carried: bool, was_found: bool
) -> None:
    # The wheels lead on into a second room; the first scan there fails to be registered, and view
    # by view it is the first room.
    second = planar_pose(40.0, 0.0, 0.0)
    hall = line(planar_pose(-1.0, 0.0, 0.0), length_m=20.0)
    inside = line(planar_pose(-1.5, 0.0, 0.0), length_m=3.0, step_m=0.25)
    trackings = trackings_of(
        (ROOM, inside, certain(identity())),
        (CORRIDOR, hall, gaussian(planar_pose(6.0, 0.0, 0.0))),
        (shifted(ROOM, 40.0), [second @ pose for pose in inside], gaussian(planar_pose(6, 0, 0))),
    )
    at = len(inside) + len(hall)
    entered = trackings[at].keyframe
    assert entered is not None
    lost = replace(entered, failure=TrackingFailure.TOO_FEW_CORRESPONDENCES)
    trackings[at] = replace(trackings[at], keyframe=lost)
    config = load_config(text=f"transition: {{look_alike_share: {share}}}")
    engine = Engine(config)
    engine.process(trackings[0])
    found_long_ago(engine, was_found)
    # After the first view of the room nothing speaks for either: the room goes on to look the same.
    carried = []
    for number, tracking in enumerate(trackings[1:], start=1):
        engine.process(tracking)
        if number >= at:
            carried.append(carried_mass(engine))
    branched = [event for event in engine.audit.events if event.kind is EventKind.BRANCHED]
    # It was asked, and the first room explains all of it.
    assert max(e.numbers["log_factor"] for e in branched if "area 0 again" in e.message) > 4.0
    assert all(mass > 0.95 if is_carried else mass < 0.02 for mass in carried)
    assert is_carried or carried[-1] == pytest.approx(carried[0], abs=0.002)


@pytest.mark.parametrize("sigma_m", [1.0, 3.0])
def test_who_was_found_long_ago_closes_loops_like_anybody(sigma_m: float) -> None:
    inside = line(planar_pose(-1.5, 0.0, 0.0), length_m=3.0, step_m=0.25)
    hall = line(planar_pose(-1.0, 0.0, 0.0), length_m=12.0)
    back = gaussian(planar_pose(-14.0, 0.0, 0.0), sigma_m=sigma_m)
    trackings = trackings_of(
        (ROOM, inside, certain(identity())),
        (CORRIDOR, hall, gaussian(planar_pose(2.0, 0.0, 0.0))),
        (ROOM, inside, back),
    )
    beliefs = []
    for was_found in (False, True):
        engine = Engine(load_config())
        engine.process(trackings[0])
        found_long_ago(engine, was_found)
        for tracking in trackings[1:]:
            engine.process(tracking)
        beliefs.append([h.log_weight for h in engine._particles.hypotheses])
    assert beliefs[0] == beliefs[1]


def found_long_ago(engine: Engine, was_found: bool) -> None:
    """Let a robot have found its place by nothing but its looks, or not."""
    particles = engine._particles
    particles.replace([replace(h, is_found=was_found) for h in particles.hypotheses])


def carried_mass(engine: Engine) -> float:
    stored = engine.stored().hypotheses
    return float(sum(np.exp(h.log_weight) for h in stored if h.assignments[-1].is_carried))


@pytest.mark.parametrize(("most", "asked"), [(1, {0}), (32, {0, 1})])
def test_who_is_carried_is_looked_for_in_the_nearest_areas(most: int, asked: set[int]) -> None:
    lap, after = ring_path(laps=1.2), ring_path(laps=1.6)[130:145]
    engine = carried(lap, after, f"transition: {{max_carried_areas: {most}}}")
    (lost,) = [event for event in engine.audit.events if event.kind is EventKind.LOST]
    branched = [
        event
        for event in engine.audit.events
        if event.kind is EventKind.BRANCHED and event.stamp_s == lost.stamp_s
    ]
    known = {int(event.numbers["area"]) for event in branched if "again" in event.message}
    assert known == asked


def test_a_scan_that_does_not_fit_is_no_reason_to_be_elsewhere() -> None:
    lap = ring_path(laps=1.2)
    engine, odometry = Engine(load_config()), Odometry(load_config())
    readings = drive(RING, lap, odometry=lap, noise=np.random.default_rng(2))
    # A crowd stands around the laser for a while.
    rng = np.random.default_rng(0)
    for index, reading in enumerate(readings):
        if isinstance(reading, Scan) and 300 <= index < 320:
            crowd = rng.uniform(0.3, 1.2, BEAMS)
            points = np.stack([crowd * np.cos(BEARINGS), crowd * np.sin(BEARINGS), 0.0 * crowd])
            reading = replace(reading, points_in_body=points.T)
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    assert any(event.kind is EventKind.LOST for event in engine.audit.events)
    snapshot = engine.snapshot()
    assert snapshot is not None
    assert snapshot.localization.probability > 0.95
    truth = inverse(lap[0]) @ lap[-1]
    assert np.abs(log(inverse(truth) @ engine.trajectory()[-1].reference_from_body)[3:]).max() < 0.3


def test_it_is_told_how_sure_the_place_is(ring: Engine) -> None:
    known, path = ring.stored(), ring_path(laps=0.8)[20:60]
    before = Engine.restored(known).snapshot()
    woken, found = (
        travelled(Engine.restored(known), RING, way).snapshot() for way in (path[:2], path)
    )
    assert before is not None
    assert before.keyframe_index == -1
    assert woken is not None
    assert found is not None
    assert woken.localization.entropy_nat > found.localization.entropy_nat
    assert found.localization.probability > 0.95
    assert found.localization.evidence_stamp_s == pytest.approx(found.localization.stamp_s, abs=3.0)
    # Outside of all that is known there is no place in the map, however sure the area is.
    other = np.concatenate([box(0.0, 0.0, 9.0, 5.0), box(3.0, 3.0, 4.5, 3.6), box(6, 0.8, 7, 1.4)])
    lost = travelled(
        Engine.restored(known), other, [planar_pose(1.5 + 0.1 * i, 2.0, 0.0) for i in range(40)]
    ).snapshot()
    assert lost is not None
    assert lost.localization.probability < 0.3


def test_a_frozen_map_stays_as_it_is(ring: Engine) -> None:
    known, path = ring.stored(), ring_path(laps=8.0)[20:]
    engine = travelled(Engine.restored(known, is_frozen=True), RING, path)
    engine.finish()
    was, now = (e.global_map(MapMethod.CONSISTENT) for e in (ring, engine))
    assert [area.area for area in now.areas] == [area.area for area in was.areas]
    for one, two in zip(was.areas, now.areas, strict=True):
        apart = inverse(one.reference_from_area.mean) @ two.reference_from_area.mean
        assert np.abs(log(apart)).max() < 1e-4
    truth = inverse(ring_path(laps=1.0)[0]) @ path[-1]
    last = engine.trajectory()[-1].reference_from_body
    assert np.abs(log(inverse(truth) @ last)[3:]).max() < 0.1
    # Of the session no scans are kept but those of its last two visits; those of the first were
    # until it was beyond doubt that it was not somewhere that only looks like the ring.
    stored = engine.stored()
    gone, kept = stored.visits[len(known.visits) : -2], stored.visits[-2]
    assert gone
    for visit in gone:
        assert not any(len(k.points_in_body) for k in _keyframes_of(stored, visit))
    assert all(len(k.points_in_body) for k in _keyframes_of(stored, kept))


def test_the_same_map_log_and_seed_give_the_same_map(ring: Engine) -> None:
    stored, path = ring.stored(), ring_path(laps=0.8)[20:40]
    one, two = (travelled(Engine.restored(stored, seed=3), RING, path).stored() for _ in range(2))
    for first, second in zip(one.hypotheses, two.hypotheses, strict=True):
        assert first.log_weight == second.log_weight
        for visit, pose in first.reference_from_visit.items():
            assert np.array_equal(pose, second.reference_from_visit[visit])


def test_parts_that_nothing_ties_are_joined_where_an_arc_says() -> None:
    graph = PoseGraph(is_planar=True)
    graph.add_reference(0)
    step, anywhere = planar_pose(2.0, 0.0, 0.1), gaussian(identity(), sigma_m=1e4, sigma_rad=1.8)
    graph.add_factor(Factor(0, 1, gaussian(step)))
    assert graph.is_whole
    graph.add_factor(Factor(1, 2, anywhere))
    graph.add_factor(Factor(2, 3, gaussian(step)))
    assert not graph.is_whole
    assert graph.part_of(1) == {0, 1}
    assert graph.part_of(3) == {2, 3}
    # The new part is far away, and turned by nearly half a turn.
    truth = planar_pose(-40.0, 7.0, 3.0)
    tie = gaussian(truth, sigma_m=0.02)
    for joined in (graph.joined(Factor(1, 3, tie)), graph.joined(Factor(3, 1, tie.inverse()))):
        assert joined.part_of(0) == {0, 1, 2, 3}
        # The arc that says nothing pulls a little.
        assert joined.relative(1, 3).mean == pytest.approx(truth, abs=1e-3)
        assert joined.relative(2, 3).mean == pytest.approx(step, abs=1e-3)
        assert joined.relative(1, 3).covariance[2:5, 2:5] == pytest.approx(
            motion_covariance(0.01, 0.02)[2:5, 2:5], abs=1e-6
        )
        assert joined.pose(0) == pytest.approx(identity(), abs=1e-6)
    assert not graph.has_arc(1, 3)
