"""Worlds of straight walls, and what a laser sees in them in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hmt_service.core.config import Config, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    certain,
    exp,
    identity,
    inverse,
    planar_pose,
)
from hmt_service.core.submap import Visit, visit_of
from hmt_service.core.surfels import Indices, Surfels, _match, build_surfels, directions_of
from hmt_service.core.types import Keyframe, OdometryReading, Reading, Scan, Snapshot, Tracking

Walls = FloatArray
"""Wall segments x0, y0, x1, y1, shape (W, 4), m."""

BEAMS = 240
BEARINGS = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)


def box(x0: float, y0: float, x1: float, y1: float) -> Walls:
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    return np.array([[*a, *b] for a, b in pairwise(corners)])


def shifted(walls: Walls, x_m: float, y_m: float = 0.0) -> Walls:
    return np.asarray(walls + np.array([x_m, y_m, x_m, y_m]))


SQUARE = box(-4.0, -4.0, 4.0, 4.0)
"""Looks the same after every quarter turn."""
ROOM = np.concatenate(
    [
        box(-4.0, -3.0, 4.0, 3.0),
        [[-2.5, 1.5, -1.0, 1.5], [2.0, -3.0, 2.0, -1.5], [1.5, 2.2, 3.2, 1.2]],
        box(-3.2, -2.2, -2.4, -1.6),
    ]
)
"""Looks like itself from nowhere else and in no other direction."""
CORRIDOR = np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]])
"""No end within the range of the sensor."""


def ranges_from(walls: Walls, world_from_body: Pose, bearings_rad: FloatArray) -> FloatArray:
    """Return the distance to the nearest wall along every bearing; inf where there is none."""
    angles = np.arctan2(world_from_body[1, 0], world_from_body[0, 0]) + bearings_rad
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    starts = walls[:, :2] - world_from_body[:2, 3]
    along = walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        determinant = rays[..., 0] * along[:, 1] - rays[..., 1] * along[:, 0]
        ranges = (starts[:, 0] * along[:, 1] - starts[:, 1] * along[:, 0]) / determinant
        shares = (starts[:, 0] * rays[..., 1] - starts[:, 1] * rays[..., 0]) / determinant
    is_hit = (ranges > 0.0) & (shares >= 0.0) & (shares <= 1.0)
    return np.asarray(np.where(is_hit, ranges, np.inf).min(axis=1))


def points_from(
    walls: Walls, world_from_body: Pose, *, noise_m: FloatArray | float = 0.0
) -> FloatArray:
    """Return what the laser at the robot's centre sees, in the body frame, shape (N, 3), m."""
    ranges = ranges_from(walls, world_from_body, BEARINGS) + noise_m
    is_return = ranges < 30.0
    directions = np.stack([np.cos(BEARINGS), np.sin(BEARINGS), np.zeros(BEAMS)], axis=1)
    return np.asarray(ranges[is_return, None] * directions[is_return])


def cloud_of(walls: Walls, *, spacing_m: float = 0.05) -> FloatArray:
    """Return points along all walls, shape (N, 3), m."""
    clouds = []
    for x0, y0, x1, y1 in walls:
        count = int(np.hypot(x1 - x0, y1 - y0) / spacing_m) + 1
        share = (np.arange(count) + 0.5) / count
        clouds.append(
            np.stack([x0 + share * (x1 - x0), y0 + share * (y1 - y0), 0.0 * share], axis=1)
        )
    return np.concatenate(clouds)


def motion_covariance(sigma_rad: float, sigma_m: float) -> FloatArray:
    return np.diag([1e-8, 1e-8, sigma_rad**2, sigma_m**2, sigma_m**2, 1e-8])


def gaussian(mean: Pose, *, sigma_rad: float = 0.01, sigma_m: float = 0.05) -> GaussianPose:
    """Return a planar pose with the same uncertainty along both axes."""
    return GaussianPose(mean, motion_covariance(sigma_rad, sigma_m))


def keyframes_along(
    walls: Walls, path: Sequence[Pose], *, first: int = 0, noise: np.random.Generator | None = None
) -> tuple[Keyframe, ...]:
    """Return a keyframe at every pose, with the true motion between them, as good as a scan's."""
    result = []
    for index, pose in enumerate(path):
        error_m = noise.normal(0.0, 0.01, BEAMS) if noise is not None else 0.0
        motion = certain(pose)
        if index > 0:
            motion = gaussian(inverse(path[index - 1]) @ pose, sigma_rad=0.001, sigma_m=0.005)
        result.append(
            Keyframe(
                index=first + index,
                stamp_s=float(first + index),
                points_in_body=points_from(walls, pose, noise_m=error_m).astype(np.float32),
                sensor_in_body=np.zeros(3),
                previous_from_body=motion,
            )
        )
    return tuple(result)


def visit_along(
    walls: Walls, path: Sequence[Pose], *, visit: int = 0, config: Config | None = None
) -> Visit:
    return visit_of(visit, keyframes_along(walls, path), config or load_config())


def trackings_of(
    *stays: tuple[Walls, Sequence[Pose], GaussianPose], noise: np.random.Generator | None = None
) -> list[Tracking]:
    """Return a tracking per keyframe of some stays, each entered by an uncertain motion."""
    result: list[Tracking] = []
    for walls, path, motion in stays:
        keyframes = keyframes_along(walls, path, first=len(result), noise=noise)
        entered = replace(keyframes[0], previous_from_body=motion)
        result += [
            Tracking(k.stamp_s, k.index, certain(identity()), k) for k in (entered, *keyframes[1:])
        ]
    return result


def processed(
    trackings: Sequence[Tracking], config: Config | None = None, *, known: Engine | None = None
) -> tuple[Engine, list[Snapshot]]:
    """Return an engine that has taken some trackings, and its state after each.

    Args:
        trackings: What it takes.
        config: Its settings; None for those of a planar laser.
        known: An engine that is to go on; None for a new one.
    """
    engine = known or Engine(config or load_config(), seed=3)
    snapshots = []
    for tracking in trackings:
        engine.process(tracking)
        snapshot = engine.snapshot()
        assert snapshot is not None
        snapshots.append(snapshot)
    return engine, snapshots


def line(start: Pose, *, length_m: float, step_m: float = 0.5) -> list[Pose]:
    """Return poses straight ahead from `start`, both ends included."""
    steps = round(length_m / step_m)
    return [start @ planar_pose(i * step_m, 0.0, 0.0) for i in range(steps + 1)]


def drive(
    walls: Walls,
    path: Sequence[Pose],
    *,
    odometry: Sequence[Pose] | None = None,
    noise: np.random.Generator | None = None,
    period_s: float = 0.1,
) -> list[Reading]:
    """Return a scan at every pose, each after what the wheels say of it, if they say anything."""
    result: list[Reading] = []
    for index, pose in enumerate(path):
        stamp_s = 100.0 + index * period_s
        if odometry is not None:
            result.append(OdometryReading(stamp_s, odometry[index]))
        error_m = noise.normal(0.0, 0.01, BEAMS) if noise is not None else 0.0
        result.append(Scan(stamp_s, points_from(walls, pose, noise_m=error_m), np.zeros(3)))
    return result


def drifting(path: Sequence[Pose], *, scale: float, turn_rad_per_m: float) -> list[Pose]:
    """Return what wheels of the wrong size say of a path."""
    result = [np.eye(4)]
    for before, now in pairwise(path):
        step = inverse(before) @ now
        travelled_m = float(np.linalg.norm(step[:3, 3]))
        wrong = step @ planar_pose(0.0, 0.0, turn_rad_per_m * travelled_m)
        wrong[:2, 3] *= scale
        result.append(result[-1] @ wrong)
    return result


HALL = np.array([-5.0, -4.0, -1.0, 6.0, 4.0, 2.5])
"""Inside of a room: x0, y0, z0, x1, y1, z1, shape (6,), m."""
PILLARS = np.array(
    [
        [2.0, 1.5, -1.0, 2.6, 2.3, 2.5],
        [-3.0, -2.6, -1.0, -1.8, -2.0, 0.2],
        [-1.0, 2.2, 0.6, 0.5, 3.0, 1.4],
    ]
)
"""Boxes that stand in it, shape (P, 6), m: it looks like itself from nowhere else."""
TUNNEL = np.array([-500.0, -2.0, -1.0, 500.0, 2.0, 1.5])
"""No end within the range of the sensor."""
FLOOR = np.array([-500.0, -500.0, -1.2, 500.0, 500.0, 500.0])
"""Nothing but a floor within the range of the sensor."""
NO_PILLARS = np.zeros((0, 6))
COLUMNS = 360
RINGS = np.linspace(-0.5, 0.5, 24)


def sweep_from(
    world_from_start: Pose,
    motion: FloatArray,
    *,
    hall: FloatArray = HALL,
    pillars: FloatArray = PILLARS,
    rings_rad: FloatArray = RINGS,
    noise: np.random.Generator | None = None,
    noise_m: float = 0.01,
) -> tuple[FloatArray, FloatArray]:
    """Return what a LiDAR sees in a hall, column by column while the robot moves.

    Args:
        world_from_start: Where the robot is at the start of the sweep.
        motion: Tangent vector of its motion during the sweep, shape (6,).
        hall: Inside of the room.
        pillars: What stands in it.
        rings_rad: Elevations of the beams.
        noise: Source of the noise of the ranges, none by default.
        noise_m: Standard deviation of that noise.

    Returns:
        Points, each in the body frame when it was taken, shape (N, 3), m; and when that was, as a
        share of the sweep, shape (N,).
    """
    times = np.repeat(np.linspace(0.0, 1.0, COLUMNS), len(rings_rad))
    azimuths = np.repeat(np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False), len(rings_rad))
    elevations = np.tile(rings_rad, COLUMNS)
    rays = np.stack(
        [
            np.cos(elevations) * np.cos(azimuths),
            np.cos(elevations) * np.sin(azimuths),
            np.sin(elevations),
        ],
        axis=1,
    )
    poses = world_from_start @ exp(times[:, None] * motion)
    starts, along = poses[:, :3, 3], np.einsum("nij,nj->ni", poses[:, :3, :3], rays)
    along = np.where(along == 0.0, 1e-12, along)
    ranges = ((np.where(along > 0.0, hall[3:], hall[:3]) - starts) / along).min(axis=1)
    for pillar in pillars:
        crossings = [(corner - starts) / along for corner in (pillar[:3], pillar[3:])]
        near, far = np.minimum(*crossings).max(axis=1), np.maximum(*crossings).min(axis=1)
        ranges = np.where((near > 0.0) & (near < far), np.minimum(ranges, near), ranges)
    if noise is not None:
        ranges = ranges + noise.normal(0.0, noise_m, len(ranges))
    is_return = ranges < 40.0
    return ranges[is_return, None] * rays[is_return], times[is_return]


RING = np.concatenate(
    [
        box(0.0, 0.0, 20.0, 14.0),
        box(2.5, 2.5, 17.5, 11.5),
        box(4.0, 0.0, 4.6, 0.5),
        box(9.0, 0.0, 9.4, 0.7),
        box(14.0, 0.0, 15.5, 0.3),
        box(19.5, 5.0, 20.0, 6.5),
        box(19.3, 9.0, 20.0, 9.3),
        box(12.0, 13.4, 12.5, 14.0),
        box(6.0, 13.7, 8.0, 14.0),
        box(0.0, 7.0, 0.6, 7.4),
        box(0.0, 4.0, 0.3, 5.5),
    ]
)
"""A corridor around a block, 2.5 m wide, with pillars that make every side of it different."""


def ring_path(*, laps: float, step_m: float = 0.25) -> list[Pose]:
    """Return poses along the middle of the ring, which turn in steps at its corners."""
    path = []
    pose = planar_pose(1.25, 1.25, 0.0)
    for side in range(round(4 * laps)):
        length_m = 17.5 if side % 2 == 0 else 11.5
        path += line(pose, length_m=length_m, step_m=step_m)[:-1]
        corner = pose @ planar_pose(length_m, 0.0, 0.0)
        path += [corner @ planar_pose(0.0, 0.0, 0.1 * np.pi * i) for i in range(5)]
        pose = corner @ planar_pose(0.0, 0.0, 0.5 * np.pi)
    return path


def unpacked(six: FloatArray) -> FloatArray:
    """Return the symmetric matrix of its upper triangle, shape (3, 3)."""
    matrix = np.zeros((3, 3))
    matrix[np.triu_indices(3)] = six
    return matrix + np.triu(matrix, 1).T


def built(points: FloatArray, directions: FloatArray, *, cell_m: float, is_planar: bool) -> Surfels:
    return build_surfels(
        points,
        directions,
        cell_m=cell_m,
        sigma_m=0.014,
        is_planar=is_planar,
    )


def surfels_of(points: FloatArray, sensor: FloatArray, *, cell_m: float = 0.25) -> Surfels:
    directions = directions_of(points, sensor, (cell_m, 4 * cell_m), is_planar=False)
    return built(points, directions, cell_m=cell_m, is_planar=False)


def matches_of(surfels: Surfels, points: FloatArray, views: FloatArray) -> Indices:
    """Return the surfel that each point lies on, -1 for none: only these are known to be fitted."""
    found = [_match(surfels, p[0], p[1], p[2], v) for p, v in zip(points, views, strict=True)]
    return np.array(found, dtype=np.int64)
