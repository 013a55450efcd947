"""Moving objects: points that other keyframes of the same visit look through.

Rays without return are unknown here, so that only returns behind a point speak against it. Each
keyframe that sees a point's direction says one of three things: something is there, everything
there is farther away (the place was empty), or nothing (the direction is hidden or unseen).

References:
    Pomerleau et al., Long-term 3D map maintenance in dynamic environments, ICRA 2014 (visibility).
    Kim and Kim, Remove, then revert, IROS 2020 (range images; in doubt, a point stays).
    The vote, and the tube that has to be empty, are our own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numba import njit

from hmt_service.core.config import Config
from hmt_service.core.geometry import FloatArray, Pose, certain, identity, transform_points
from hmt_service.core.types import Keyframe

# A keyframe is compared with so many before it and as many after it, which bounds the cost.
_NEIGHBOURS = 10
# Of keyframes so near in time; the walls of a submap must not be eaten because of it.
_POSE_ERROR_M = 0.05
# How much denser the columns of a LiDAR are than its rows, which the angular resolution allows for.
_COLUMNS_PER_ROW = 4.0
# The keyframe that saw the point is a vote for it: more than that and one other have to be against.
_MIN_MAJORITY = 2
_TINY_M = 1e-6

_SEEN_THROUGH, _UNDECIDED, _CONFIRMED = 1, 0, -1


def without_transients(
    keyframes: Sequence[Keyframe], frame_from_keyframe: Sequence[Pose], config: Config
) -> list[FloatArray]:
    """Return the points of each keyframe that no majority of the others near in time looks through.

    Args:
        keyframes: In time order, at least one.
        frame_from_keyframe: Pose of each in one frame, shape (4, 4).
        config: Settings of all stages.

    Returns:
        What stays of each keyframe in that frame, in the order of its points, shape (M, 3) each, m.
    """
    placed = list(zip(frame_from_keyframe, keyframes, strict=True))
    clouds = [transform_points(pose, keyframe.points_in_body) for pose, keyframe in placed]
    starts = np.cumsum([0, *(len(cloud) for cloud in clouds)])
    # Nothing can be nearer to a point than the submap resolves.
    spacing_m = 0.5 * config.odometry.voxel_size_m
    resolution = config.observation.angular_resolution_rad
    is_planar = config.sensor.is_planar
    limits = np.array(
        [
            config.observation.hit_sigma_m,
            spacing_m,
            spacing_m + _POSE_ERROR_M,
            resolution if is_planar else resolution / _COLUMNS_PER_ROW,
            resolution,
        ]
    )
    majorities = _majorities(
        np.concatenate(clouds),
        starts,
        np.array([_sensor_at(pose, keyframe) for pose, keyframe in placed]),
        1 if is_planar else int(np.ceil(np.pi / resolution)),
        int(np.ceil(2.0 * np.pi / resolution)),
        limits,
    )
    stays = np.split(majorities < _MIN_MAJORITY, starts[1:-1])
    return [cloud[stay] for cloud, stay in zip(clouds, stays, strict=True)]


def compile_kernels(config: Config) -> None:
    """Compile what the votes need, or load it: not while the first area is left."""
    points = np.random.default_rng(0).uniform(1.0, 2.0, (10, 3)).astype(np.float32)
    seen = Keyframe(0, 0.0, points, np.zeros(3), certain(identity()))
    without_transients([seen, seen], [identity()] * 2, config)


def _sensor_at(frame_from_body: Pose, keyframe: Keyframe) -> Pose:
    """Return the pose of the sensor, whose axes are those of the body."""
    pose = frame_from_body.copy()
    pose[:3, 3] = transform_points(frame_from_body, keyframe.sensor_in_body[None])[0]
    return pose


@njit(cache=True)
def _majorities(
    points: FloatArray,
    starts: npt.NDArray[np.int64],
    frame_from_sensor: FloatArray,
    rows: int,
    columns: int,
    limits: FloatArray,
) -> npt.NDArray[np.int64]:
    """Return by how many votes each point is seen through rather than confirmed, shape (N,)."""
    result = np.zeros(len(points), dtype=np.int64)
    count = len(starts) - 1
    for viewer in range(count):
        own, end = starts[viewer], starts[viewer + 1]
        pose = frame_from_sensor[viewer]
        nearest, ends, rays = _view(points[own:end], pose, rows, columns)
        first = starts[max(0, viewer - _NEIGHBOURS)]
        last = starts[min(count, viewer + _NEIGHBOURS + 1)]
        for i in range(first, last):
            if i < own or i >= end:
                x, y, z = _seen_from(pose, points, i)
                result[i] += _verdict(x, y, z, nearest, ends, rays, limits)
    return result


@njit(cache=True)
def _view(
    points: FloatArray, pose: FloatArray, rows: int, columns: int
) -> tuple[FloatArray, npt.NDArray[np.int64], FloatArray]:
    """Return what a keyframe sees, by cells of direction.

    Returns:
        The least range in each cell, shape (rows, columns), infinite where there is none; where the
        rays of each cell end, shape (rows * columns,); the rays sorted by cell: direction and
        range, shape (N, 4).
    """
    nearest = np.full((rows, columns), np.inf)
    # The last entry stays zero: it is what index -1 finds, where the rays of the first cell start.
    ends = np.zeros(rows * columns + 2, dtype=np.int64)
    cells = np.zeros(len(points), dtype=np.int64)
    unsorted = np.zeros((len(points), 4))
    for i in range(len(points)):
        x, y, z = _seen_from(pose, points, i)
        level = np.sqrt(x * x + y * y)
        # Straight above or below the sensor, or in it, there is no column.
        distance = max(np.sqrt(level * level + z * z), _TINY_M)
        row = _inside(_row_at(level, z, rows), rows)
        column = _inside(_column_at(x, y, columns), columns)
        nearest[row, column] = min(nearest[row, column], distance)
        cells[i] = row * columns + column
        ends[cells[i] + 1] += 1
        unsorted[i, 0], unsorted[i, 1] = x / distance, y / distance
        unsorted[i, 2], unsorted[i, 3] = z / distance, distance
    for cell in range(rows * columns):
        ends[cell + 1] += ends[cell]
    rays = np.zeros((len(points), 4))
    for i in range(len(points)):
        # Until all rays are placed, an end is where the next ray of its cell belongs.
        rays[ends[cells[i]]] = unsorted[i]
        ends[cells[i]] += 1
    return nearest, ends, rays


@njit(cache=True)
def _verdict(
    x: float,
    y: float,
    z: float,
    nearest: FloatArray,
    ends: npt.NDArray[np.int64],
    rays: FloatArray,
    limits: FloatArray,
) -> int:
    """Return what one keyframe says of one point.

    Args:
        x: Of the point, in the sensor's frame, like the next two.
        y: See there.
        z: See there.
        nearest: What the keyframe sees, as `_view` returns it, like the next two.
        ends: See there.
        rays: See there.
        limits: How much farther is clearly farther; how near to the point a ray must pass to speak
            against it; half the width of the tube at the sensor; by how much that grows with the
            range aside and above. In m, but for the last two, shape (5,).
    """
    margin, beside = limits[0], limits[1]
    level = np.sqrt(x * x + y * y)
    if level < _TINY_M:
        return _UNDECIDED
    distance = np.sqrt(level * level + z * z)
    rows, columns = nearest.shape
    v, u = _row_at(level, z, rows), _column_at(x, y, columns)
    row, column = _inside(v, rows), _inside(u, columns)
    least = nearest[row, column]
    if least <= distance + margin:
        return _CONFIRMED if least >= distance - margin else _UNDECIDED
    # All that this cell holds is clearly farther. Only a ray that passes close to the point counts:
    # one that passes a hand's breadth away may have missed a table leg.
    cell = row * columns + column
    for i in range(ends[cell - 1], ends[cell]):
        aside, above = _offsets(rays, i, x, y, z, level, distance)
        if aside * aside + above * above <= beside * beside:
            return _around(x, y, z, u, v, nearest, ends, rays, limits)
    return _UNDECIDED


@njit(cache=True)
def _around(
    x: float,
    y: float,
    z: float,
    u: float,
    v: float,
    nearest: FloatArray,
    ends: npt.NDArray[np.int64],
    rays: FloatArray,
    limits: FloatArray,
) -> int:
    """Return whether all in the tube around the ray to a point is clearly farther as well.

    On a wall seen at a grazing angle, and on the ground between two rows of a LiDAR, the next
    return is far behind the point, but the one before it is not.
    """
    level = np.sqrt(x * x + y * y)
    distance = np.sqrt(level * level + z * z)
    rows, columns = nearest.shape
    near, far = distance - limits[0], distance + limits[0]
    width, height = limits[2] + limits[3] * distance, limits[2] + limits[4] * distance
    du, dv = 0.25 * columns * width / level, 0.5 * rows * height / distance
    left, right = int(np.floor(u - du)), int(np.floor(u + du))
    if right - left >= columns:
        left, right = 0, columns - 1
    result = _SEEN_THROUGH
    for row in range(_inside(v - dv, rows), _inside(v + dv, rows) + 1):
        for turned in range(left, right + 1):
            column = turned % columns
            if nearest[row, column] > far:
                continue
            cell = row * columns + column
            for i in range(ends[cell - 1], ends[cell]):
                if rays[i, 3] > far or not _is_in_tube(
                    rays, i, x, y, z, level, distance, width, height
                ):
                    continue
                if rays[i, 3] >= near:
                    return _CONFIRMED
                result = _UNDECIDED
    return result


@njit(cache=True)
def _seen_from(pose: FloatArray, points: FloatArray, i: int) -> tuple[float, float, float]:
    """Return one of the points in the frame of the sensor."""
    dx, dy, dz = points[i, 0] - pose[0, 3], points[i, 1] - pose[1, 3], points[i, 2] - pose[2, 3]
    return (
        pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz,
        pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz,
        pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz,
    )


@njit(cache=True)
def _column_at(x: float, y: float, columns: int) -> float:
    """Return the azimuth in columns: that on a square instead of a circle, which needs no arctan.

    A step of an angle, in rad, is never more than a quarter of the columns times that angle.
    """
    share = x / max(abs(x) + abs(y), _TINY_M)
    return 0.25 * columns * (1.0 - share if y >= 0.0 else 3.0 + share)


@njit(cache=True)
def _row_at(level: float, z: float, rows: int) -> float:
    """Return the elevation in rows, in the same way, from straight below to straight above."""
    return 0.5 * rows * (1.0 + z / max(abs(z) + level, _TINY_M))


@njit(cache=True)
def _inside(at: float, count: int) -> int:
    """Return the number of the row or column, of so many, that is nearest."""
    return max(0, min(count - 1, int(at)))


@njit(cache=True)
def _offsets(
    rays: FloatArray, i: int, x: float, y: float, z: float, level: float, distance: float
) -> tuple[float, float]:
    """Return how far a ray passes aside of and above a point of the sensor's frame."""
    aside = (x * rays[i, 1] - y * rays[i, 0]) * distance / level
    above = level * rays[i, 2] - z * (x * rays[i, 0] + y * rays[i, 1]) / level
    return aside, above


@njit(cache=True)
def _is_in_tube(
    rays: FloatArray,
    i: int,
    x: float,
    y: float,
    z: float,
    level: float,
    distance: float,
    width: float,
    height: float,
) -> bool:
    aside, above = _offsets(rays, i, x, y, z, level, distance)
    ahead = x * rays[i, 0] + y * rays[i, 1] + z * rays[i, 2]
    return bool(ahead > 0.0 and abs(aside) <= width and abs(above) <= height)
