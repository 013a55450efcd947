"""What moved must not stay in a submap, and what stood still must."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import pytest

from hmt_service.core.config import Config, Preset, load_config
from hmt_service.core.geometry import (
    FloatArray,
    Pose,
    certain,
    exp,
    identity,
    inverse,
    planar_pose,
    transform_points,
)
from hmt_service.core.local_map import deskew
from hmt_service.core.submap import visit_of
from hmt_service.core.surfels import thin
from hmt_service.core.transients import without_transients
from hmt_service.core.types import Keyframe, Points, Scan
from hmt_service.sim.simulation import Instant, simulate
from hmt_service.sim.usual import USUAL_ROBOTS, preset_for
from hmt_service.sim.worlds.families import Family, draw
from tests.core.factories import ROOM, Walls, box, line, ranges_from

Mask = npt.NDArray[np.bool_]

PLANAR = load_config()
INDOOR = load_config(Preset.INDOOR)
HALL = box(-6.0, -1.2, 16.0, 1.2)
"""A corridor, closed at both ends."""
WAY = line(planar_pose(0.0, 0.1, 0.0), length_m=8.0)
BEARINGS = np.linspace(-np.pi, np.pi, 480, endpoint=False)
ROOM_M = np.array([[-2.0, -3.0, 0.0], [12.0, 3.0, 2.5]])
"""A room with floor and ceiling: its least and its greatest corner."""


def somebody(x_m: float, y_m: float) -> Walls:
    return box(x_m - 0.15, y_m - 0.15, x_m + 0.15, y_m + 0.15)


CROSSING = [somebody(7.0, 0.8 * (i - 5)) for i in range(len(WAY))]
"""Somebody who crosses the corridor, from and to behind its walls."""


def laser(walls: Walls, pose: Pose, noise_m: FloatArray | float = 0.0) -> FloatArray:
    """Return what a laser of four beams in three degrees sees within 30 m, shape (N, 3), m."""
    ranges = ranges_from(walls, pose, BEARINGS) + noise_m
    rays = np.stack([np.cos(BEARINGS), np.sin(BEARINGS), np.zeros(len(BEARINGS))], axis=1)
    is_return = ranges < 30.0
    return np.asarray(ranges[is_return, None] * rays[is_return])


def seen(scenes: Sequence[Walls], path: Sequence[Pose] = WAY) -> tuple[Keyframe, ...]:
    """Return a keyframe at each pose of a world that differs from pose to pose."""
    clouds = [laser(walls, pose) for walls, pose in zip(scenes, path, strict=True)]
    return keyframes_of(clouds, path)


def keyframes_of(
    clouds: Sequence[FloatArray], path: Sequence[Pose], sensor_m: FloatArray | None = None
) -> tuple[Keyframe, ...]:
    mount = np.zeros(3) if sensor_m is None else sensor_m
    return tuple(
        Keyframe(i, float(i), cloud.astype(np.float32), mount, certain(inverse(before) @ pose))
        for i, (cloud, before, pose) in enumerate(zip(clouds, [path[0], *path], path, strict=False))
    )


def is_in(points: FloatArray, walls: Walls) -> Mask:
    """Return which points are on a box of walls, shape (N,)."""
    low, high = walls[:, :2].min(axis=0) - 1e-3, walls[:, :2].max(axis=0) + 1e-3
    return np.asarray(((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1))


def split(
    keyframes: Sequence[Keyframe], movers: Sequence[Walls], path: Sequence[Pose] = WAY
) -> tuple[int, int, int, int]:
    """Return how many points of movers and of the rest there were, and how many of each stay."""
    stay = without_transients(keyframes, path, PLANAR)
    counts = np.zeros((2, 2), dtype=int)
    for keyframe, pose, cloud, mover in zip(keyframes, path, stay, movers, strict=True):
        before = transform_points(pose, keyframe.points_in_body)
        for row, points in enumerate((before, cloud)):
            counts[row] += is_in(points, mover).sum(), (~is_in(points, mover)).sum()
    (moving, standing), (moving_left, standing_left) = counts.tolist()
    return moving, standing, moving_left, standing_left


def test_person_who_crosses_the_corridor_goes_and_all_else_stays() -> None:
    people = CROSSING
    keyframes = seen([np.concatenate([HALL, person]) for person in people])
    moving, standing, moving_left, standing_left = split(keyframes, people)
    assert moving > 10
    assert moving_left == 0
    assert standing_left == standing


def test_person_who_stood_and_left_goes() -> None:
    person = somebody(5.0, 0.5)
    scenes = [np.concatenate([HALL, person]) if i < 4 else HALL for i in range(len(WAY))]
    moving, standing, moving_left, standing_left = split(seen(scenes), [person] * len(WAY))
    assert moving > 20
    assert moving_left == 0
    assert standing_left == standing


def test_person_who_follows_goes() -> None:
    people = [somebody(pose[0, 3] - 1.5, -0.1) for pose in WAY]
    keyframes = seen([np.concatenate([HALL, person]) for person in people])
    moving, standing, moving_left, standing_left = split(keyframes, people)
    assert moving > 100
    assert moving_left <= 0.2 * moving
    assert standing_left == standing


@pytest.mark.parametrize("walls", [HALL, ROOM])
def test_what_never_moves_stays_to_the_last_point(walls: Walls) -> None:
    path = WAY if walls is HALL else [planar_pose(0.2 * i - 1.5, 0.0, 0.3 * i) for i in range(15)]
    rng = np.random.default_rng(3)
    clouds = [laser(walls, pose, rng.normal(0.0, 0.01, len(BEARINGS))) for pose in path]
    keyframes = keyframes_of(clouds, path)
    stay = without_transients(keyframes, path, PLANAR)
    assert [len(cloud) for cloud in stay] == [len(each.points_in_body) for each in keyframes]


def test_walls_stay_though_the_poses_are_wrong() -> None:
    rng = np.random.default_rng(5)
    errors = rng.normal(0.0, [0.0, 0.0, 0.0087, 0.03, 0.03, 0.0], (len(WAY), 6))
    wrong = [pose @ exp(error) for pose, error in zip(WAY, errors, strict=True)]
    clouds = [laser(HALL, pose, rng.normal(0.0, 0.01, len(BEARINGS))) for pose in WAY]
    keyframes = keyframes_of(clouds, WAY)
    stay = without_transients(keyframes, wrong, PLANAR)
    lost = 1.0 - sum(map(len, stay)) / sum(len(each.points_in_body) for each in keyframes)
    assert lost < 0.01


@pytest.mark.parametrize("width_m", [0.03, 0.06, 0.1])
def test_poles_and_legs_stay(width_m: float) -> None:
    legs = [box(x, y, x + width_m, y + width_m) for x in (5.0, 5.8) for y in (0.3, 0.9)]
    keyframes = seen([np.concatenate([HALL, *legs])] * len(WAY))
    before = [transform_points(p, k.points_in_body) for p, k in zip(WAY, keyframes, strict=True)]
    stay = without_transients(keyframes, WAY, PLANAR)
    for leg in legs:
        there = sum(is_in(cloud, leg).sum() for cloud in before)
        assert there > 10
        assert sum(is_in(cloud, leg).sum() for cloud in stay) >= 0.95 * there


LEAF = box(10.0, -1.2, 10.05, 1.2)


@pytest.mark.parametrize(("shut", "is_kept"), [(4, False), (12, True)])
def test_door_is_what_it_was_for_most_of_the_time(shut: int, is_kept: bool) -> None:
    scenes = [np.concatenate([HALL, LEAF]) if i < shut else HALL for i in range(len(WAY))]
    keyframes = seen(scenes)
    before = [transform_points(p, k.points_in_body) for p, k in zip(WAY, keyframes, strict=True)]
    stay = without_transients(keyframes, WAY, PLANAR)
    # The rims of the leaf touch the walls, which look the same whether it is open or shut.
    middle = box(10.0, -0.8, 10.05, 0.8)
    there = sum(is_in(cloud, middle).sum() for cloud in before)
    left = sum(is_in(cloud, middle).sum() for cloud in stay)
    assert there > 20
    assert left >= 0.98 * there if is_kept else left == 0


def test_what_a_closing_door_hides_stays() -> None:
    scenes = [HALL if i < 4 else np.concatenate([HALL, LEAF]) for i in range(len(WAY))]
    keyframes = seen(scenes)
    behind = box(10.1, -1.2, 16.0, 1.2)
    stay = without_transients(keyframes, WAY, PLANAR)
    for pose, keyframe, cloud in zip(WAY[:4], keyframes[:4], stay[:4], strict=True):
        before = transform_points(pose, keyframe.points_in_body)
        assert is_in(before, behind).sum() > 5
        assert is_in(cloud, behind).sum() == is_in(before, behind).sum()


def test_direction_without_returns_says_nothing() -> None:
    # Nothing stands behind this person, so that nothing is seen when they have gone.
    wall = np.array([[-6.0, -1.2, 16.0, -1.2]])
    person = somebody(4.0, 2.0)
    scenes = [np.concatenate([wall, person]) if i < 3 else wall for i in range(len(WAY))]
    moving, standing, moving_left, standing_left = split(seen(scenes), [person] * len(WAY))
    assert moving >= 10
    assert (moving_left, standing_left) == (moving, standing)


@pytest.mark.parametrize("count", [1, 2])
def test_one_keyframe_or_two_are_no_majority(count: int) -> None:
    scenes = [np.concatenate([HALL, somebody(4.0, 0.5)]), HALL][:count]
    keyframes = seen(scenes, WAY[:count])
    stay = without_transients(keyframes, WAY[:count], PLANAR)
    assert [len(cloud) for cloud in stay] == [len(each.points_in_body) for each in keyframes]


def test_keyframe_without_points_says_nothing() -> None:
    clouds = [laser(HALL, pose) for pose in WAY[:3]]
    clouds[1] = np.zeros((0, 3))
    stay = without_transients(keyframes_of(clouds, WAY[:3]), WAY[:3], PLANAR)
    assert [len(cloud) for cloud in stay] == [len(cloud) for cloud in clouds]


def test_points_at_and_straight_above_the_sensor_do_no_harm() -> None:
    odd = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    stay = without_transients(keyframes_of([odd] * 4, [identity()] * 4), [identity()] * 4, INDOOR)
    assert [len(cloud) for cloud in stay] == [3] * 4


# ------------------------------------------------------------------ in space


def rows_from(boxes: Sequence[FloatArray], origin: FloatArray) -> FloatArray:
    """Return what 16 rows see in the room with boxes in it, from the sensor, shape (N, 3)."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 720, endpoint=False), np.radians(np.linspace(-15.0, 15.0, 16))
    )
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)
    rays = rays.reshape(-1, 3) + 1e-9
    ranges = np.maximum(*((corner - origin) / rays for corner in ROOM_M)).min(axis=1)
    for low, high in boxes:
        sides = np.sort([(low - origin) / rays, (high - origin) / rays], axis=0)
        enter, leave = sides[0].max(axis=1), sides[1].min(axis=1)
        ranges = np.where((enter < leave) & (enter > 0.0), np.minimum(ranges, enter), ranges)
    return np.asarray(ranges[:, None] * rays)


def upright(x_m: float, y_m: float, width_m: float, height_m: float = 1.75) -> FloatArray:
    half = 0.5 * width_m
    return np.array([[x_m - half, y_m - half, 0.0], [x_m + half, y_m + half, height_m]])


def is_inside(points: FloatArray, bounds: FloatArray) -> Mask:
    return np.asarray(((points >= bounds[0] - 1e-3) & (points <= bounds[1] + 1e-3)).all(axis=1))


def thinned(points: FloatArray, config: Config) -> FloatArray:
    """Return what a keyframe keeps of the points of a LiDAR."""
    return np.asarray(points[thin(points, 0.5 * config.odometry.voxel_size_m)])


def test_lidar_forgets_who_walks_by_and_keeps_posts_and_walls() -> None:
    mount = np.array([0.0, 0.0, 0.8])
    path = [planar_pose(0.5 * i, 0.0, 0.0) for i in range(14)]
    post, table = upright(5.0, 1.5, 0.08, 2.5), upright(3.0, -2.0, 0.6, 0.7)
    people = [upright(8.0 - 0.4 * i, -1.0, 0.4) for i in range(len(path))]
    clouds = [
        thinned(rows_from([post, table, person], pose[:3, 3] + mount) + mount, INDOOR)
        for pose, person in zip(path, people, strict=True)
    ]
    stay = without_transients(keyframes_of(clouds, path, mount), path, INDOOR)
    before = [transform_points(pose, cloud) for pose, cloud in zip(path, clouds, strict=True)]
    moving = sum(is_inside(c, p).sum() for c, p in zip(before, people, strict=True))
    left = sum(is_inside(c, p).sum() for c, p in zip(stay, people, strict=True))
    assert moving > 300
    # Feet stay: the floor around them is as near as they are.
    assert left < 0.35 * moving
    for still in (post, table):
        there = sum(is_inside(cloud, still).sum() for cloud in before)
        assert there > 50
        assert sum(is_inside(cloud, still).sum() for cloud in stay) >= 0.98 * there
    rest = sum(map(len, before)) - moving
    assert sum(map(len, stay)) - left >= 0.998 * rest


# ------------------------------------------------------------------ simulated drives


def drive_of(family: Family, scans: int, people: int) -> tuple[list[Keyframe], list[Mask]]:
    """Return keyframes with the true motion, and which points of each are on people."""
    robot = USUAL_ROBOTS[family]
    config = load_config(preset_for(robot, family))
    keyframes: list[Keyframe] = []
    masks, last, before = [], identity(), identity()
    crowded, empty = (simulate(draw(family, 1), robot, 1, people=n) for n in (people, 0))
    for (pose, scan), (_, alone) in zip(
        scans_of(crowded, scans), scans_of(empty, scans), strict=True
    ):
        motion, before = inverse(before) @ pose, pose
        step = inverse(last) @ pose
        is_new = np.linalg.norm(step[:3, 3]) >= config.odometry.keyframe_distance_m
        if keyframes and not is_new and np.abs(step - identity())[:3, :3].max() < 0.3:
            continue
        points = scan.points_in_body
        # The noise is that of the empty world, so that what differs is a person.
        is_person = ~is_among(points, alone.points_in_body)
        if scan.point_times is not None:
            points = deskew(points, scan.point_times, motion)
            people_in_body = points[is_person]
            points = thinned(points, config)
            is_person = is_among(points, people_in_body)
        mean = certain(step if keyframes else identity())
        stored: Points = points.astype(np.float32)
        keyframes.append(Keyframe(len(keyframes), scan.stamp_s, stored, scan.sensor_in_body, mean))
        masks.append(is_person)
        last = pose
    return keyframes, masks


def scans_of(instants: Iterator[Instant], count: int) -> Iterator[tuple[Pose, Scan]]:
    for _, instant in zip(range(count), instants, strict=False):
        (scan,) = (each for each in instant.readings if isinstance(each, Scan))
        yield instant.truth.reference_from_body, scan


def is_among(points: FloatArray, others: FloatArray) -> Mask:
    """Return which points are, to the bit, among others, shape (N,)."""
    row = np.dtype((np.void, 24))
    known, asked = (np.ascontiguousarray(each).view(row).ravel() for each in (others, points))
    return np.isin(asked, known)


@pytest.mark.parametrize(
    ("family", "scans", "people", "most_left"),
    [
        (Family.OFFICE, 350, 15, 0.2),
        (Family.WAREHOUSE, 350, 15, 0.2),
        # Sparse rows, feet next to the floor, and a visit that ends before everybody has left.
        (Family.GARAGE, 160, 20, 0.3),
    ],
)
def test_people_of_a_drive_go_and_the_world_stays(
    family: Family, scans: int, people: int, most_left: float
) -> None:
    keyframes, masks = drive_of(family, scans, people)
    config = load_config(preset_for(USUAL_ROBOTS[family], family))
    visit = visit_of(0, keyframes, config)
    poses = [pose.mean for pose in visit.visit_from_keyframe]
    stay = without_transients(keyframes, poses, config)
    moving, moving_left, rest, rest_left = 0, 0, 0, 0
    for keyframe, pose, mask, cloud in zip(keyframes, poses, masks, stay, strict=True):
        placed = transform_points(pose, keyframe.points_in_body)
        of_people = is_among(cloud, placed[mask]).sum()
        moving, moving_left = moving + mask.sum(), moving_left + of_people
        rest, rest_left = rest + (~mask).sum(), rest_left + len(cloud) - of_people
    assert moving > 300
    assert moving_left <= most_left * moving
    assert rest_left >= 0.995 * rest


def test_same_keyframes_give_the_same_submap_to_the_bit() -> None:
    people = CROSSING
    keyframes = seen([np.concatenate([HALL, person]) for person in people])
    first, second = (visit_of(0, keyframes, PLANAR).points for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_submap_holds_what_stays_and_keyframes_keep_what_they_saw() -> None:
    people = CROSSING
    keyframes = seen([np.concatenate([HALL, person]) for person in people])
    before = [each.points_in_body.copy() for each in keyframes]
    visit = visit_of(0, keyframes, PLANAR)
    in_world = visit.points_in(WAY[0])
    inside = box(6.8, -1.0, 7.2, 1.0)
    clouds = [transform_points(pose, cloud) for pose, cloud in zip(WAY, before, strict=True)]
    assert is_in(np.concatenate(clouds), inside).sum() > 10
    assert is_in(in_world, inside).sum() == 0
    for keyframe, points in zip(visit.keyframes, before, strict=True):
        assert np.array_equal(keyframe.points_in_body, points)
