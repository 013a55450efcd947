"""The observation model: what a scan says for a place, and against it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import (
    FloatArray,
    Pose,
    identity,
    inverse,
    planar_pose,
    transform_points,
)
from hmt_service.core.local_map import SeenPoints
from hmt_service.core.observation import BackgroundDensity, ObservationModel
from hmt_service.core.types import Keyframe
from tests.core.factories import ROOM, SQUARE, cloud_of, keyframes_along, visit_along

CONFIG = load_config()


def seen(points: FloatArray, pose: Pose) -> SeenPoints:
    """Return points as a sensor at a pose sees them."""
    directions = pose[:3, 3] - points
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    return SeenPoints(points, directions / np.maximum(lengths, 1e-9))


TRUTH = planar_pose(0.5, -0.4, 0.4)
SUBMAP = seen(cloud_of(ROOM, spacing_m=0.03), TRUTH)
(KEYFRAME,) = keyframes_along(ROOM, [TRUTH])
ANGLES = np.linspace(-np.pi, np.pi, 720, endpoint=False) + 0.004


def model_of(*learned: Keyframe) -> ObservationModel:
    model = ObservationModel(CONFIG.observation, CONFIG.sensor)
    for keyframe in learned:
        model.learn(keyframe)
    return model


@given(
    ranges=st.lists(st.floats(0.0, 60.0), max_size=50),
    max_range_m=st.floats(1.0, 50.0),
)
def test_background_density_integrates_to_one(ranges: list[float], max_range_m: float) -> None:
    background = BackgroundDensity(max_range_m)
    background.learn(np.array(ranges))
    bins = int(np.ceil(max_range_m / 0.25))
    middles = np.asarray((np.arange(bins) + 0.5) * 0.25, dtype=np.float64)
    assert np.sum(background.density(middles)) * 0.25 == pytest.approx(1.0)
    assert background.density(middles).min() > 0.0


def test_background_density_has_known_values() -> None:
    background = BackgroundDensity(10.0)
    assert background.density(np.array([0.1, 9.9])) == pytest.approx([0.1, 0.1])
    background.learn(np.full(60, 5.1))
    # 40 bins of one reading each and 60 more in one of them, 0.25 m wide.
    assert background.density(np.array([5.2, 1.0])) == pytest.approx([61 / 25, 1 / 25])


def test_longer_ranges_than_the_sensor_has_count_as_its_longest() -> None:
    background = BackgroundDensity(10.0)
    background.learn(np.array([50.0]))
    assert background.density(np.array([9.9]))[0] == pytest.approx(2 / 41 / 0.25)


def test_ratio_of_a_perfect_match_has_the_closed_form() -> None:
    # A circle of 2 m: every beam expects what it reads, p0 is uniform over 40 m.
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    circle = 2.0 * np.stack([np.cos(angles), np.sin(angles), np.zeros(720)], axis=1)
    keyframe = replace(KEYFRAME, points_in_body=circle.astype(np.float32))
    sigma, hit = CONFIG.observation.hit_sigma_m, CONFIG.observation.hit_weight
    per_beam = np.log(hit / (np.sqrt(2.0 * np.pi) * sigma) * 40.0 + 1.0 - hit)
    beams = CONFIG.observation.independent_beams
    assert model_of().log_ratio(keyframe, seen(circle, identity()), identity()) == pytest.approx(
        per_beam * beams, rel=1e-4
    )
    # A circle that is larger by two standard deviations.
    larger = circle * (1.0 + 2.0 * sigma / 2.0)
    off = np.log(hit * np.exp(-2.0) / (np.sqrt(2.0 * np.pi) * sigma) * 40.0 + 1.0 - hit)
    assert model_of().log_ratio(keyframe, seen(larger, identity()), identity()) == pytest.approx(
        off * beams, rel=1e-4
    )


def test_true_pose_is_likelier_than_the_background_and_than_any_wrong_one() -> None:
    model = model_of(KEYFRAME)
    right = model.log_ratio(KEYFRAME, SUBMAP, TRUTH)
    assert right > 3.0
    for offset in [(0.7, 0.0, 0.0), (0.0, 0.7, 0.0), (0.0, 0.0, 0.5), (0.0, 0.0, np.pi)]:
        assert model.log_ratio(KEYFRAME, SUBMAP, TRUTH @ planar_pose(*offset)) < right - 3.0


def test_unknown_space_says_nothing() -> None:
    model = model_of(KEYFRAME)
    assert model.log_ratio(KEYFRAME, seen(np.zeros((0, 3)), TRUTH), TRUTH) == 0.0
    empty = replace(KEYFRAME, points_in_body=np.zeros((0, 3), dtype=np.float32))
    assert model.log_ratio(empty, SUBMAP, TRUTH) == 0.0


def test_half_of_the_beams_say_as_much_as_all() -> None:
    # How much of a place was seen through a door is no difference between two places.
    keyframe = replace(
        KEYFRAME,
        points_in_body=np.array([[2.0, 0.0, 0.0], [-3.0, 0.0, 0.0]], dtype=np.float32),
    )
    front = [[2.0, y, 0.0] for y in np.linspace(-0.2, 0.2, 41)]
    back = [[-3.0, y, 0.0] for y in np.linspace(-0.2, 0.2, 41)]
    model = model_of()
    one, both = (
        model.log_ratio(keyframe, seen(np.array(walls), identity()), identity())
        for walls in (front, front + back)
    )
    assert one == pytest.approx(both)
    assert one > 1.0


def test_few_beams_into_known_space_say_little() -> None:
    points = 2.0 * np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(len(ANGLES))], axis=1)
    keyframe = replace(KEYFRAME, points_in_body=points.astype(np.float32))
    model, arc = model_of(), seen(points, identity())
    whole = model.log_ratio(keyframe, arc, identity())
    for share, counted in ((0.5, 1.0), (0.25, 0.5), (0.1, 0.2)):
        part = SeenPoints(*(a[: int(share * len(points))] for a in (arc.points, arc.directions)))
        ratio = model.log_ratio(keyframe, part, identity())
        assert ratio == pytest.approx(counted * whole, rel=0.03)


def test_the_other_side_of_a_wall_says_nothing() -> None:
    # Seen from the corridor, the room behind the wall is no nearer and no farther than the wall.
    wall = np.array([[2.0, y, 0.0] for y in np.linspace(-3.0, 3.0, 601)])
    nearer = (wall[::10] - [0.4, 0.0, 0.0]).astype(np.float32)
    keyframe = replace(KEYFRAME, points_in_body=nearer)
    here, there = (np.tile([x, 0.0, 0.0], (601, 1)) for x in (-1.0, 1.0))
    model = model_of()
    assert model.log_ratio(keyframe, SeenPoints(wall, there), identity()) == 0.0
    assert model.log_ratio(keyframe, SeenPoints(wall, here), identity()) < -1.0


def test_twice_the_beams_are_not_twice_the_evidence() -> None:
    twice = replace(KEYFRAME, points_in_body=np.repeat(KEYFRAME.points_in_body, 2, axis=0))
    model = model_of(KEYFRAME)
    assert model.log_ratio(twice, SUBMAP, TRUTH) == pytest.approx(
        model.log_ratio(KEYFRAME, SUBMAP, TRUTH)
    )


def test_fewer_beams_than_are_independent_count_in_full() -> None:
    model = model_of()
    points = np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-2.0, 0.0, 0.0]], dtype=np.float32)
    cloud = cloud_of(np.array([[2.0, -1, 2, 1], [-1, 2, 1, 2], [-2, -1, -2, 1]], dtype=float))
    walls = seen(cloud, identity())
    ratios = [
        model.log_ratio(replace(KEYFRAME, points_in_body=points[:n]), walls, identity())
        for n in (1, 2, 3)
    ]
    assert np.diff([0.0, *ratios]) == pytest.approx(np.full(3, ratios[0]), rel=0.01)


def test_what_is_seen_everywhere_says_less_for_a_place() -> None:
    """A building of identical rooms raises its own bar."""
    unlearned = model_of().log_ratio(KEYFRAME, SUBMAP, TRUTH)
    learned = model_of(*[KEYFRAME] * 50).log_ratio(KEYFRAME, SUBMAP, TRUTH)
    assert 0.0 < learned < 0.8 * unlearned


def test_hit_density_integrates_to_one_at_any_angle() -> None:
    # The wall is seen from straight ahead to grazing: neighbouring cells differ by metres.
    model = model_of(KEYFRAME)
    wall = np.array([[x, 1.0, 0.0] for x in np.linspace(-20.0, 20.0, 4001)])
    ranges = np.arange(0.0, 40.0, 0.01)
    for bearing in np.radians([90.0, 45.0, 10.0, 4.0]):
        rays = np.tile([np.cos(bearing), np.sin(bearing), 0.0], (len(ranges), 1))
        density = model._hit_density(ranges, model._expectations(wall, -wall, rays))
        assert density.sum() * 0.01 == pytest.approx(1.0, abs=0.01)


@given(x=st.floats(-20, 20), y=st.floats(-20, 20), yaw=st.floats(-3, 3))
def test_ratio_does_not_depend_on_the_frame_of_the_submap(x: float, y: float, yaw: float) -> None:
    moved = planar_pose(x, y, yaw)
    model = model_of(KEYFRAME)
    submap = seen(transform_points(moved, SUBMAP.points), moved @ TRUTH)
    found = model.log_ratio(KEYFRAME, submap, moved @ TRUTH)
    # A point on the border between two cells of the grid may fall to the other side.
    assert found == pytest.approx(model.log_ratio(KEYFRAME, SUBMAP, TRUTH), rel=0.02)


def test_other_rooms_are_told_apart() -> None:
    model = model_of(KEYFRAME)
    visit = visit_along(SQUARE, [identity()])
    assert model.log_ratio(KEYFRAME, visit.seen, identity()) < 0.5 * model.log_ratio(
        KEYFRAME, SUBMAP, TRUTH
    )


def sphere(count: int, radius_m: float) -> FloatArray:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(count, 3))
    return np.asarray(radius_m * directions / np.linalg.norm(directions, axis=1, keepdims=True))


def test_beams_in_space_are_told_apart_by_elevation() -> None:
    config = load_config(Preset.OUTDOOR)
    model = ObservationModel(config.observation, config.sensor)
    points = sphere(4000, 10.0)
    points[:, 2] *= np.where(points[:, 2] > 0.0, 1.0, 0.3)  # a flattened lower half
    pose = planar_pose(3.0, 1.0, 0.5)
    keyframe = replace(KEYFRAME, points_in_body=points.astype(np.float32))
    right, wrong = (
        model.log_ratio(keyframe, seen(transform_points(pose, cloud), pose), pose)
        for cloud in (points, points * [1.0, 1.0, -1.0])
    )
    assert right > 3.0
    assert wrong < 0.7 * right


def test_sensor_away_from_the_centre_is_where_the_rays_start() -> None:
    mounted = np.array([0.3, 0.1, 0.0])
    seen_from = TRUTH @ planar_pose(0.3, 0.1, 0.0)
    (at_sensor,) = keyframes_along(ROOM, [seen_from])
    keyframe = replace(
        at_sensor,
        points_in_body=(at_sensor.points_in_body + mounted).astype(np.float32),
        sensor_in_body=mounted,
    )
    model = model_of(KEYFRAME)
    assert model.log_ratio(keyframe, SUBMAP, TRUTH) == pytest.approx(
        model.log_ratio(at_sensor, SUBMAP, seen_from), rel=0.02
    )
    assert inverse(TRUTH) @ seen_from == pytest.approx(planar_pose(0.3, 0.1, 0.0))
