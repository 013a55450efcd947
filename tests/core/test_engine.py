"""The engine on a ring that is driven twice, and in a building of identical rooms."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pytest

from hmt_service.core.config import Config, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import GaussianPose, certain, identity, inverse, planar_pose
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import (
    Event,
    EventKind,
    MapMethod,
    Tracking,
    TrackingFailure,
)
from hmt_service.errors import NotFound, Unavailable
from hmt_service.io.map_file import read_map, write_map
from hmt_service.io.trajectory import write_tum
from tests.core.factories import (
    RING,
    ROOM,
    box,
    drifting,
    drive,
    keyframes_along,
    line,
    motion_covariance,
    processed,
    ring_path,
    shifted,
    trackings_of,
)

PATH = ring_path(laps=1.75)
WHEELS = drifting(PATH, scale=1.03, turn_rad_per_m=0.01)
RING_CONFIG = load_config(text="areas: {max_cut: 0.55}")


def run_ring() -> tuple[Engine, tuple[Event, ...]]:
    odometry, engine = Odometry(RING_CONFIG), Engine(RING_CONFIG, seed=0)
    events: tuple[Event, ...] = ()
    for reading in drive(RING, PATH, odometry=WHEELS, noise=np.random.default_rng(1)):
        tracking = odometry.process(reading)
        if tracking is not None:
            events += engine.process(tracking)
    return engine, events + engine.finish()


@cache
def ring() -> tuple[Engine, tuple[Event, ...]]:
    return run_ring()


TWIN_M = 12.0
OTHER_ROOM = shifted(
    np.concatenate([box(-3.0, -2.0, 6.0, 2.0), box(-2.0, -1.0, -1.0, 1.0), box(3, 0.5, 4, 1)]), 90.0
)
TWINS = np.concatenate([ROOM, shifted(ROOM, TWIN_M), OTHER_ROOM])
"""Two rooms that look the same and one that does not; every one of them is closed."""
STAY = line(planar_pose(-1.5, 0.3, 0.0), length_m=2.5)


def ambiguous(*, goes_on: bool = False) -> list[Tracking]:
    """Return stays in one twin, the other, a third room, and, after a blind trip, the first twin.

    The wheels say of that trip that it ended half way between the twins.

    Args:
        goes_on: Whether the second twin is visited once more, after a known trip.
    """
    in_twin = [planar_pose(TWIN_M, 0.0, 0.0) @ pose for pose in STAY]
    in_other = line(planar_pose(90.0, 0.0, 0.0), length_m=2.0)
    known = motion_covariance(0.02, 0.1)
    blind = motion_covariance(0.02, 6.0)
    between = planar_pose(0.5 * TWIN_M, 0.0, 0.0) @ STAY[0]
    to_twin = (TWINS, in_twin, GaussianPose(inverse(STAY[-1]) @ in_twin[0], known))
    return trackings_of(
        (TWINS, STAY, certain(identity())),
        to_twin,
        (TWINS, in_other, GaussianPose(inverse(in_twin[-1]) @ in_other[0], known)),
        (TWINS, STAY, GaussianPose(inverse(in_other[-1]) @ between, blind)),
        *([to_twin] if goes_on else []),
    )


def test_what_shows_nothing_new_of_a_known_area_is_not_kept(tmp_path: Path) -> None:
    config = load_config(text="areas: {max_cut: 0.55, max_views: 1, max_new_share: 0.4}")
    path = ring_path(laps=3.5)
    wheels = drifting(path, scale=1.03, turn_rad_per_m=0.01)
    odometry, engine = Odometry(config), Engine(config, seed=0)
    for reading in drive(RING, path, odometry=wheels, noise=np.random.default_rng(1)):
        tracking = odometry.process(reading)
        if tracking is not None:
            engine.process(tracking)
    engine.finish()
    stored = engine.stored()
    forgotten = [k.index for k in stored.keyframes if not len(k.points_in_body)]
    assert 0.2 < len(forgotten) / len(stored.keyframes) < 0.7
    # What founded an area is kept whole, and so is the path of everything else.
    founders = {a.visit for a in stored.hypotheses[0].assignments if a.area_from_visit is None}
    kept = [v for v in stored.visits if v.visit in founders]
    assert not any(
        v.first_keyframe <= index <= v.last_keyframe for v in kept for index in forgotten
    )
    first = inverse(path[0])
    errors_m = [
        np.linalg.norm((first @ truth)[:3, 3] - found.reference_from_body[:3, 3])
        for truth, found in zip(path, engine.trajectory(), strict=True)
    ]
    assert max(errors_m) < 0.15
    write_map(tmp_path / "map.hmt", stored)
    again = read_map(tmp_path / "map.hmt")
    assert [len(k.points_in_body) for k in again.keyframes] == [
        len(k.points_in_body) for k in stored.keyframes
    ]


def position_errors_m(engine: Engine) -> list[float]:
    first = inverse(PATH[0])
    return [
        float(np.linalg.norm((first @ truth)[:3, 3] - found.reference_from_body[:3, 3]))
        for truth, found in zip(PATH, engine.trajectory(), strict=True)
    ]


def test_ring_that_is_driven_twice_closes() -> None:
    engine, events = ring()
    snapshot = engine.snapshot()
    assert snapshot is not None
    best = snapshot.posterior.hypotheses[0]
    assert best.loop_closures >= 2
    assert best.areas == snapshot.areas < len(best.topological_path)
    entered = [event for event in events if event.kind is EventKind.AREA_ENTERED]
    # A visit that began in the unknown may have turned out to be one to a known area.
    numbers = [event.numbers for event in events if event.kind is EventKind.ACCEPTED]
    recognised = {int(n["visit"]): int(n["area"]) for n in numbers if "visit" in n}
    areas = [int(event.numbers["area"]) for event in entered]
    path = [area for area, _ in groupby(recognised.get(area, area) for area in areas)]
    assert path == list(best.topological_path)
    known = sum("known" in event.message for event in entered)
    assert known + len(recognised) == best.loop_closures


def test_visits_that_are_over_are_tied_to_all_that_they_overlap() -> None:
    (best, *_) = ring()[0].stored().hypotheses
    area_of = {assignment.visit: assignment.area for assignment in best.assignments}
    last = len(area_of) - 1
    # Neither a motion nor a loop closure: an overlap of two areas, found when a visit was over.
    ties = [
        (factor.visit_a, factor.visit_b)
        for factor in best.factors
        if factor.visit_b - factor.visit_a > 1 and factor.visit_a != area_of[factor.visit_b]
    ]
    assert [tie for tie in ties if tie[1] != last]


def test_trajectory_is_close_to_the_truth_where_the_wheels_are_not() -> None:
    engine, _ = ring()
    assert np.linalg.norm((inverse(PATH[0]) @ PATH[-1])[:2, 3] - WHEELS[-1][:2, 3]) > 3.0
    assert max(position_errors_m(engine)) < 0.15


def test_trajectory_has_every_scan_in_order() -> None:
    engine, _ = ring()
    stamps_s = [pose.stamp_s for pose in engine.trajectory()]
    assert stamps_s == pytest.approx([100.0 + 0.1 * i for i in range(len(PATH))])


def test_consistent_map_bears_the_loop_better_than_the_composed_one() -> None:
    engine, _ = ring()
    comparison = engine.compare()
    consistent = [arc.consistent_m for arc in comparison.arcs]
    composed = [arc.shortest_path_m for arc in comparison.arcs]
    areas = len(comparison.areas)
    # Arcs of the tree agree exactly; what the loop leaves is on the others.
    assert sum(residual < 1e-9 for residual in composed) == areas - 1
    assert len(composed) > areas - 1
    assert max(consistent) < 0.1
    assert max(consistent) < max(composed) + 0.02


def test_comparison_is_the_difference_of_both_maps() -> None:
    engine, _ = ring()
    reference = engine.global_map(MapMethod.CONSISTENT).areas[1].area
    comparison = engine.compare(reference_area=reference)
    consistent = engine.global_map(MapMethod.CONSISTENT, reference_area=reference)
    shortest = engine.global_map(MapMethod.SHORTEST_PATH, reference_area=reference)
    assert comparison.reference_area == reference
    for difference, a, b in zip(comparison.areas, consistent.areas, shortest.areas, strict=True):
        apart = a.reference_from_area.mean[:3, 3] - b.reference_from_area.mean[:3, 3]
        assert difference.area == a.area == b.area
        assert difference.translation_m == pytest.approx(float(np.linalg.norm(apart)))
        largest = np.linalg.eigvalsh(a.reference_from_area.covariance[3:, 3:])[-1]
        assert difference.sigma_consistent_m == pytest.approx(np.sqrt(largest))
        if a.area == reference:
            assert (difference.translation_m, difference.rotation_rad) == (0.0, 0.0)


@pytest.mark.parametrize("method", MapMethod)
def test_every_area_is_in_the_map_of_every_reference(method: MapMethod) -> None:
    engine, _ = ring()
    first = engine.global_map(method)
    identifiers = [placed.area for placed in first.areas]
    assert len(identifiers) >= 3
    for reference in identifiers:
        placed = engine.global_map(method, reference_area=reference, with_points=False)
        assert [each.area for each in placed.areas] == identifiers
        own = placed.areas[identifiers.index(reference)].reference_from_area
        assert own.mean == pytest.approx(identity(), abs=1e-12)
        assert not own.covariance.any()
        assert placed.reference_area == reference


def test_consistent_map_is_the_same_in_every_frame() -> None:
    engine, _ = ring()
    first = {
        p.area: p.reference_from_area.mean for p in engine.global_map(MapMethod.CONSISTENT).areas
    }
    for reference, pose in first.items():
        for placed in engine.global_map(MapMethod.CONSISTENT, reference_area=reference).areas:
            expected = inverse(pose) @ first[placed.area]
            assert placed.reference_from_area.mean == pytest.approx(expected, abs=1e-9)


def test_submaps_lie_on_the_walls() -> None:
    engine, _ = ring()
    for placed in engine.global_map(MapMethod.CONSISTENT).areas:
        world = PATH[0] @ placed.reference_from_area.mean
        points = placed.points_in_area @ world[:3, :3].T + world[:3, 3]
        gaps = [
            np.abs(points[:, axis] - border)
            for axis, borders in ((0, (0.0, 2.5, 17.5, 20.0)), (1, (0.0, 2.5, 11.5, 14.0)))
            for border in borders
        ]
        # All but the pillars' faces.
        assert np.mean(np.min(gaps, axis=0) < 0.1) > 0.85
        assert placed.points_in_area.dtype == np.float32


def test_maps_count_keyframes_and_visits() -> None:
    engine, _ = ring()
    snapshot, placed = engine.snapshot(), engine.global_map(MapMethod.CONSISTENT)
    assert snapshot is not None
    assert sum(area.keyframes for area in placed.areas) == snapshot.keyframes
    assert sum(area.visits for area in placed.areas) == (
        len(placed.areas) + snapshot.posterior.hypotheses[0].loop_closures
    )
    assert len(placed.arcs) == snapshot.arcs
    without = engine.global_map(MapMethod.CONSISTENT, with_points=False)
    assert all(not len(area.points_in_area) for area in without.areas)


def test_snapshot_is_the_pose_of_the_last_keyframe() -> None:
    engine, _ = ring()
    snapshot = engine.snapshot()
    assert snapshot is not None
    area = snapshot.posterior.hypotheses[0].current_area
    (placed,) = (a for a in engine.global_map(MapMethod.CONSISTENT).areas if a.area == area)
    composed = placed.reference_from_area.mean @ snapshot.area_from_keyframe.mean
    assert snapshot.reference_from_keyframe.mean == pytest.approx(composed, abs=1e-9)
    (pose,) = (p for p in engine.trajectory() if p.stamp_s == snapshot.posterior.stamp_s)
    assert pose.reference_from_body == pytest.approx(composed, abs=0.03)  # it is smoothed


def test_stored_map_covers_every_keyframe_and_scan() -> None:
    engine, _ = ring()
    stored, snapshot = engine.stored(), engine.snapshot()
    assert snapshot is not None
    assert [k.index for k in stored.keyframes] == list(range(snapshot.keyframes))
    borders = [(visit.first_keyframe, visit.last_keyframe) for visit in stored.visits]
    assert borders[0][0] == 0
    assert borders[-1][1] == snapshot.keyframes - 1
    assert all(b[0] == a[1] + 1 for a, b in pairwise(borders))
    assert len(stored.scans) == len(PATH)
    (best, *_) = stored.hypotheses
    assert [a.visit for a in best.assignments] == list(range(len(stored.visits)))
    assert set(best.reference_from_visit) == set(range(len(stored.visits)))
    assert Config.model_validate_json(stored.config_json) == RING_CONFIG


def test_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    engines = [ring()[0], run_ring()[0]]
    trajectories = [
        b"".join(pose.reference_from_body.tobytes() for pose in engine.trajectory())
        for engine in engines
    ]
    assert trajectories[0] == trajectories[1]
    files = []
    for number, engine in enumerate(engines):
        files.append(tmp_path / f"{number}.tum")
        write_tum(files[-1], engine.trajectory())
    assert files[0].read_bytes() == files[1].read_bytes()
    assert engines[0].compare() == engines[1].compare()


def test_hypotheses_live_side_by_side_until_evidence_decides() -> None:
    engine, snapshots = processed(ambiguous())
    posterior = snapshots[-1].posterior
    assert len(snapshots[-7].posterior.hypotheses) == 1
    assert {h.current_area for h in posterior.hypotheses} == {0, 1, 3}
    by_area = dict(posterior.current_area)
    # The twins look the same and are equally far from where the wheels ended; a third of the kind
    # is not excluded either.
    assert by_area[0] == pytest.approx(by_area[1], rel=0.3)
    assert by_area[0] + by_area[1] > 0.3
    assert posterior.effective_sample_size > 1.5
    for snapshot in snapshots:
        shares = [h.probability for h in snapshot.posterior.hypotheses]
        assert sum(shares) == pytest.approx(1.0)
        assert shares == sorted(shares, reverse=True)
        assert sum(snapshot.posterior.current_area.values()) == pytest.approx(1.0)
    # Each has its own graph: the robot is in one twin or in the other.
    robot_x_m = {
        stored.assignments[-1].area: stored.reference_from_visit[3][0, 3]
        for stored in engine.stored().hypotheses
    }
    assert robot_x_m[0] == pytest.approx(0.0, abs=0.3)
    assert robot_x_m[1] == pytest.approx(TWIN_M, abs=0.3)
    probabilities = [
        engine.global_map(
            MapMethod.CONSISTENT, hypothesis=h.hypothesis, with_points=False
        ).probability
        for h in posterior.hypotheses
    ]
    assert probabilities == pytest.approx([h.probability for h in posterior.hypotheses])


def test_next_room_settles_which_twin_it_was() -> None:
    # A known motion from the first twin leads to the second; from the second it leads to nowhere.
    _, snapshots = processed(ambiguous(goes_on=True))
    best = snapshots[-1].posterior.hypotheses[0]
    assert best.topological_path == (0, 1, 2, 0, 1)
    assert best.probability > 0.95


def lost_after_stay(count: int, motion: GaussianPose) -> list[tuple[int, int]]:
    """Return first and last keyframes of the visits when, after a stay, keyframes are lost."""
    trackings = trackings_of((ROOM, STAY, certain(identity())))
    for keyframe in keyframes_along(ROOM, [STAY[-1]] * count, first=len(STAY)):
        failure = TrackingFailure.TOO_FEW_CORRESPONDENCES
        lost = replace(keyframe, failure=failure, previous_from_body=motion)
        here = certain(identity())
        trackings.append(Tracking(lost.stamp_s, lost.index, here, lost, failure))
    engine, _ = processed(trackings)
    return [(visit.first_keyframe, visit.last_keyframe) for visit in engine.stored().visits]


def test_lost_scan_begins_another_visit_at_once() -> None:
    far = GaussianPose(identity(), motion_covariance(0.5, 5.0))
    assert lost_after_stay(1, far) == [(0, 5), (6, 6)]


def test_what_is_driven_blindly_on_good_wheels_is_one_visit() -> None:
    near = GaussianPose(identity(), motion_covariance(0.02, 0.05))
    far = GaussianPose(identity(), motion_covariance(0.5, 5.0))
    assert lost_after_stay(3, near) == [(0, 5), (6, 8)]
    assert lost_after_stay(3, far) == [(0, 5), (6, 6), (7, 7), (8, 8)]


def test_trackings_without_a_keyframe_change_nothing_but_the_trajectory() -> None:
    trackings = trackings_of((ROOM, STAY, certain(identity())))
    engine, snapshots = processed(trackings)
    ahead = planar_pose(0.1, 0.0, 0.0)
    assert engine.process(Tracking(99.0, 5, certain(ahead), None)) == ()
    snapshot = engine.snapshot()
    assert snapshot is not None
    assert snapshot.posterior == snapshots[-1].posterior
    last, added = engine.trajectory()[-2:]
    assert added.stamp_s == 99.0
    assert added.reference_from_body == pytest.approx(last.reference_from_body @ ahead)


def test_mapping_goes_on_after_finish() -> None:
    trackings = trackings_of((ROOM, STAY, certain(identity())))
    engine, _ = processed(trackings[:4])
    engine.finish()
    for tracking in trackings[4:]:
        engine.process(tracking)
    assert len(engine.trajectory()) == len(trackings)


def test_unknown_hypothesis_and_area_are_named() -> None:
    engine, _ = processed(trackings_of((ROOM, STAY, certain(identity()))))
    with pytest.raises(NotFound, match=r"hypothesis 7 is not one of \[0\]"):
        engine.global_map(MapMethod.CONSISTENT, hypothesis=7)
    with pytest.raises(NotFound, match=r"area 4 .* has 1 areas: \[0\]"):
        engine.global_map(MapMethod.SHORTEST_PATH, reference_area=4)
    with pytest.raises(NotFound, match="area 4"):
        engine.compare(reference_area=4)


def test_nothing_is_there_before_the_first_keyframe() -> None:
    engine = Engine(load_config())
    assert engine.snapshot() is None
    assert engine.trajectory() == ()
    assert engine.finish() == ()
    for ask in (lambda: engine.global_map(MapMethod.CONSISTENT), engine.compare):
        with pytest.raises(Unavailable, match="no keyframe"):
            ask()


def test_a_scan_whose_keyframe_never_came_is_recognised() -> None:
    odometry, engine = Odometry(load_config()), Engine(load_config())
    path = ring_path(laps=0.2)
    trackings = [t for r in drive(RING, path) if (t := odometry.process(r)) is not None]
    keyframes = [index for index, t in enumerate(trackings) if t.keyframe is not None]
    for tracking in trackings[: keyframes[2]]:
        assert not engine.misses(tracking)
        engine.process(tracking)
    # The next keyframe is lost on the way: what is relative to it cannot be placed.
    lost = keyframes[2]
    assert not engine.misses(trackings[lost])
    assert all(engine.misses(tracking) for tracking in trackings[lost + 1 :])
