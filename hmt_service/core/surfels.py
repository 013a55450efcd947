"""Surfels: flat pieces of surface, each seen from one side, and what a scan says of its pose there.

A map of surfels is made of the points of some keyframes. Space is divided into cells; the points in
a cell and its neighbours that were seen from the same side make one surfel: a plane where they are
flat, a Gaussian elsewhere. The two faces of a wall are two surfels, so that a robot that drives
through a door does not take the far face for the near one (a wall of 0.14 m then costs 0.14 m).

All that is done once per point is compiled by numba, and kept in one file: its cache knows when a
function's own file has changed, not when another file has, from which it calls a function.

Arrays of moments hold `[n, x, y, z, xx, xy, xz, yy, yz, zz]` and the sum of the directions to the
sensor, those of symmetric matrices `[xx, xy, xz, yy, yz, zz]`.

References:
    Biber and Strasser, The normal distributions transform, IROS 2003.
    Magnusson, The three-dimensional normal-distributions transform, PhD thesis, Orebro 2009.
    Segal et al., Generalized-ICP, RSS 2009 (planes as Gaussians).
    Dellenbach et al., CT-ICP, ICRA 2022 (a sweep is not a moment).
    Barfoot, State Estimation for Robotics, 2017, sections 5.3 (robust costs) and 7.1 (SE(3)).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from hmt_service.core.geometry import FloatArray, Pose

Indices = npt.NDArray[np.int64]

# Fewer points do not make a surface.
_LEAST_POINTS = 4
# A surface is at most so thick, as a share of its width, and at least so wide, as a share of its
# length squared: a single ring of a LiDAR has no normal.
_FLATNESS = 0.35
_SLENDERNESS = 0.1
_ROUND, _LINE, _FLAT = 0, 1, 2
# Points spread evenly over three cells have a standard deviation of 0.87 cells: above this, what
# they lie on goes on beyond.
_UNBOUNDED = 0.6
_UNFITTED, _FITTED, _VOID = 0, 1, 2
_FACES = 6
_SIDE = 1 << 20
_GOLDEN = -7046029254386353131
_SMALL_ANGLE_RAD = 1e-7
# Steps below this, rad and m, are the end.
_CONVERGED = 1e-4
# After steps above this, points are matched anew.
_REMATCHED = 1e-3


class Surfels(NamedTuple):
    """A map of surfels as arrays: C cells, S surfels.

    A surfel is fitted when a point is first matched there: most of a map is not looked at before it
    is replaced by the next.
    """

    table: Indices
    """Hash table of the cells, open addressing, -1 where free, length a power of two."""
    keys: Indices
    """Coordinates of each cell, packed, shape (C,)."""
    corners: Indices
    """Least corner of each cell, in cells, shape (C, 3)."""
    moments: FloatArray
    """Of the points of each surfel in its own cell, about its corner, shape (S, 13)."""
    state: Indices
    """Whether each surfel has been fitted, and was found to be one, shape (S,)."""
    surfel_of: Indices
    """Surfel of each cell and face (+x, -x, +y, -y, +z, -z), -1 for none, shape (C, 6)."""
    means: FloatArray
    """Middle of each surfel, shape (S, 3), m."""
    normals: FloatArray
    """Vector to the side that it was seen from, shape (S, 3); of unit length where flat."""
    weights: FloatArray
    """Information of the position of a point on each, shape (S, 6), 1/m^2."""
    cell_m: float
    """Edge of a cell."""
    sigma_m: float
    """Standard deviation of the distance of a point from its surfel."""
    is_planar: bool
    """Whether heights do not count."""


@njit(cache=True)
def _key(i: int, j: int, k: int) -> int:
    return ((i + _SIDE) << 42) | ((j + _SIDE) << 21) | (k + _SIDE)


@njit(cache=True)
def _slot_of(key: int, table: Indices) -> int:
    # Fibonacci hashing.
    return ((key * _GOLDEN) >> 20) & (len(table) - 1)


@njit(cache=True)
def _find(table: Indices, keys: Indices, i: int, j: int, k: int) -> int:
    """Return the index of a cell, -1 if there is none."""
    key = _key(i, j, k)
    slot = _slot_of(key, table)
    while True:
        cell: int = table[slot]
        if cell < 0 or keys[cell] == key:
            return cell
        slot = (slot + 1) & (len(table) - 1)


@njit(cache=True)
def _cells_of(
    points: FloatArray, cell_m: float, is_planar: bool
) -> tuple[Indices, Indices, Indices, Indices]:
    """Return the hash table, keys and corners (in cells) of the cells, and each point's cell."""
    size = 16
    while size < 2 * len(points):
        size *= 2
    table = np.full(size, -1, np.int64)
    keys = np.empty(len(points), np.int64)
    corners = np.empty((len(points), 3), np.int64)
    cell_of = np.empty(len(points), np.int64)
    cells = 0
    for n in range(len(points)):
        i = math.floor(points[n, 0] / cell_m)
        j = math.floor(points[n, 1] / cell_m)
        k = 0 if is_planar else math.floor(points[n, 2] / cell_m)
        key = _key(i, j, k)
        slot = _slot_of(key, table)
        while table[slot] >= 0 and keys[table[slot]] != key:
            slot = (slot + 1) & (size - 1)
        if table[slot] < 0:
            table[slot] = cells
            keys[cells] = key
            corners[cells, 0], corners[cells, 1], corners[cells, 2] = i, j, k
            cells += 1
        cell_of[n] = table[slot]
    return table, keys[:cells].copy(), corners[:cells].copy(), cell_of


@njit(cache=True)
def _first_points(points: FloatArray, cell_m: float) -> Indices:
    """Return the index of the first point in each cell, in the order of the points."""
    _, keys, _, cell_of = _cells_of(points, cell_m, False)
    first = np.empty(len(keys), np.int64)
    seen = 0
    for n in range(len(points)):
        if cell_of[n] == seen:
            first[seen] = n
            seen += 1
    return first


@njit(cache=True)
def _moments_of(
    points: FloatArray,
    directions: FloatArray,
    faces: Indices,
    cell_of: Indices,
    corners: Indices,
    cell_m: float,
) -> tuple[Indices, FloatArray]:
    """Return the surfel of each cell and face, and the moments of each about its cell's corner."""
    surfel_of = np.full((len(corners), _FACES), -1, np.int64)
    moments = np.zeros((len(points), 13))
    surfels = 0
    for n in range(len(points)):
        cell, face = cell_of[n], faces[n]
        if surfel_of[cell, face] < 0:
            surfel_of[cell, face] = surfels
            surfels += 1
        x = points[n, 0] - corners[cell, 0] * cell_m
        y = points[n, 1] - corners[cell, 1] * cell_m
        z = points[n, 2] - corners[cell, 2] * cell_m
        m = moments[surfel_of[cell, face]]
        m[0] += 1.0
        m[1] += x
        m[2] += y
        m[3] += z
        m[4] += x * x
        m[5] += x * y
        m[6] += x * z
        m[7] += y * y
        m[8] += y * z
        m[9] += z * z
        for axis in range(3):
            m[10 + axis] += directions[n, axis]
    return surfel_of, moments[:surfels].copy()


@njit(cache=True)
def _add_moved(total: FloatArray, m: FloatArray, x: float, y: float, z: float) -> None:
    """Add moments that count from a corner at (x, y, z)."""
    n = m[0]
    total[0] += n
    total[1] += m[1] + n * x
    total[2] += m[2] + n * y
    total[3] += m[3] + n * z
    total[4] += m[4] + 2.0 * x * m[1] + n * x * x
    total[5] += m[5] + x * m[2] + y * m[1] + n * x * y
    total[6] += m[6] + x * m[3] + z * m[1] + n * x * z
    total[7] += m[7] + 2.0 * y * m[2] + n * y * y
    total[8] += m[8] + y * m[3] + z * m[2] + n * y * z
    total[9] += m[9] + 2.0 * z * m[3] + n * z * z
    for axis in range(10, 13):
        total[axis] += m[axis]


@njit(cache=True)
def _neighbours(
    table: Indices, keys: Indices, corner: Indices, is_planar: bool, out: Indices
) -> None:
    """Fill in the cell and its neighbours, shape (27,), -1 where there is none."""
    depth = 0 if is_planar else 1
    n = 0
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-1, 2):
                out[n] = -1
                if abs(dk) <= depth:
                    out[n] = _find(table, keys, corner[0] + di, corner[1] + dj, corner[2] + dk)
                n += 1


@njit(cache=True)
def _covariance(m: FloatArray, out: FloatArray) -> None:
    """Fill in the covariance that moments have, shape (6,)."""
    n = m[0]
    x, y, z = m[1] / n, m[2] / n, m[3] / n
    out[0] = m[4] / n - x * x
    out[1] = m[5] / n - x * y
    out[2] = m[6] / n - x * z
    out[3] = m[7] / n - y * y
    out[4] = m[8] / n - y * z
    out[5] = m[9] / n - z * z


@njit(cache=True)
def _eigenvalues_2d(c: FloatArray) -> tuple[float, float]:
    """Return the eigenvalues of the horizontal part of a covariance, the smaller first."""
    middle, half = 0.5 * (c[0] + c[3]), 0.5 * (c[0] - c[3])
    radius = math.sqrt(half * half + c[1] * c[1])
    return middle - radius, middle + radius


@njit(cache=True)
def _eigenvalues_3d(c: FloatArray) -> tuple[float, float, float]:
    """Return the eigenvalues of a covariance in ascending order, by the trigonometric formula."""
    mean = (c[0] + c[3] + c[5]) / 3.0
    xx, yy, zz = c[0] - mean, c[3] - mean, c[5] - mean
    square = xx * xx + yy * yy + zz * zz + 2.0 * (c[1] * c[1] + c[2] * c[2] + c[4] * c[4])
    if square <= 0.0:
        return mean, mean, mean
    radius = math.sqrt(square / 6.0)
    det = (
        xx * (yy * zz - c[4] * c[4])
        - c[1] * (c[1] * zz - c[4] * c[2])
        + c[2] * (c[1] * c[4] - yy * c[2])
    )
    angle = math.acos(min(max(0.5 * det / radius**3, -1.0), 1.0)) / 3.0
    largest = mean + 2.0 * radius * math.cos(angle)
    least = mean + 2.0 * radius * math.cos(angle + 2.0 * math.pi / 3.0)
    return least, 3.0 * mean - largest - least, largest


@njit(cache=True)
def _eigenvector(c: FloatArray, value: float, is_planar: bool, out: FloatArray) -> bool:
    """Fill in the unit eigenvector of a single eigenvalue; return whether there is one.

    In space it is orthogonal to the rows of the matrix less the eigenvalue.
    """
    xx, yy, zz = c[0] - value, c[3] - value, c[5] - value
    best = 0.0
    for pair in range(3):
        if is_planar:
            x, y, z = (c[1], -xx, 0.0) if pair == 0 else (yy, -c[1], 0.0)
        elif pair == 0:
            x, y, z = c[1] * c[4] - c[2] * yy, c[2] * c[1] - xx * c[4], xx * yy - c[1] * c[1]
        elif pair == 1:
            x, y, z = c[1] * zz - c[2] * c[4], c[2] * c[2] - xx * zz, xx * c[4] - c[1] * c[2]
        else:
            x, y, z = yy * zz - c[4] * c[4], c[4] * c[2] - c[1] * zz, c[1] * c[4] - yy * c[2]
        length = x * x + y * y + z * z
        if length > best:
            best = length
            out[0], out[1], out[2] = x, y, z
    if best <= 0.0:
        return False
    out /= math.sqrt(best)
    return True


@njit(cache=True)
def _shape_2d(c: FloatArray, normal: FloatArray) -> int:
    """Fill in the normal of a planar covariance; return its shape."""
    least, largest = _eigenvalues_2d(c)
    if largest <= 0.0 or least > _FLATNESS**2 * largest:
        return _ROUND
    return _FLAT if _eigenvector(c, least, True, normal) else _ROUND


@njit(cache=True)
def _shape_3d(c: FloatArray, normal: FloatArray) -> int:
    """Fill in the normal of a covariance; return its shape."""
    least, middle, largest = _eigenvalues_3d(c)
    if middle <= _SLENDERNESS * largest:
        return _LINE
    if least > _FLATNESS**2 * middle:
        return _ROUND
    return _FLAT if _eigenvector(c, least, False, normal) else _ROUND


@njit(cache=True)
def _shape_of(c: FloatArray, is_planar: bool, normal: FloatArray) -> int:
    return _shape_2d(c, normal) if is_planar else _shape_3d(c, normal)


@njit(cache=True)
def _inverse_with_noise(c: FloatArray, variance: float, is_planar: bool, out: FloatArray) -> None:
    """Fill in the inverse of a covariance with so much added to its diagonal, shape (6,)."""
    xx, yy, zz = c[0] + variance, c[3] + variance, c[5] + variance
    if is_planar:
        det = xx * yy - c[1] * c[1]
        out[0], out[1], out[2] = yy / det, -c[1] / det, 0.0
        out[3], out[4], out[5] = xx / det, 0.0, 0.0
        return
    a = yy * zz - c[4] * c[4]
    b = c[2] * c[4] - c[1] * zz
    d = c[1] * c[4] - c[2] * yy
    det = xx * a + c[1] * b + c[2] * d
    out[0], out[1], out[2] = a / det, b / det, d / det
    out[3] = (xx * zz - c[2] * c[2]) / det
    out[4] = (c[1] * c[2] - xx * c[4]) / det
    out[5] = (xx * yy - c[1] * c[1]) / det


@njit(cache=True)
def _open_along_extent(
    c: FloatArray, cell_m: float, variance: float, is_planar: bool, weight: FloatArray
) -> None:
    """Take away what a surfel says along an axis on which only its cells bound it.

    The edge between wall and floor goes on in the next cells: it says nothing of the way along it.
    """
    largest = _eigenvalues_2d(c)[1] if is_planar else _eigenvalues_3d(c)[2]
    axis = np.empty(3)
    if largest < (_UNBOUNDED * cell_m) ** 2 or not _eigenvector(c, largest, is_planar, axis):
        return
    said = 1.0 / (largest + variance)
    weight[0] -= said * axis[0] * axis[0]
    weight[1] -= said * axis[0] * axis[1]
    weight[2] -= said * axis[0] * axis[2]
    weight[3] -= said * axis[1] * axis[1]
    weight[4] -= said * axis[1] * axis[2]
    weight[5] -= said * axis[2] * axis[2]


@njit(cache=True)
def _plane(normal: FloatArray, variance: float, out: FloatArray) -> None:
    """Fill in the information of a distance along a normal, shape (6,)."""
    x, y, z = normal[0], normal[1], normal[2]
    out[0], out[1], out[2] = x * x / variance, x * y / variance, x * z / variance
    out[3], out[4], out[5] = y * y / variance, y * z / variance, z * z / variance


@njit(cache=True)
def _fit(surfels: Surfels, cell: int, face: int) -> None:
    """Fit one surfel to the points in its cell and around, and note whether there is any."""
    surfel = surfels.surfel_of[cell, face]
    around, total = np.empty(27, np.int64), np.zeros(13)
    _neighbours(surfels.table, surfels.keys, surfels.corners[cell], surfels.is_planar, around)
    for n in range(27):
        if around[n] >= 0 and surfels.surfel_of[around[n], face] >= 0:
            x, y, z = n // 9 - 1, n // 3 % 3 - 1, n % 3 - 1
            moments, edge = surfels.moments[surfels.surfel_of[around[n], face]], surfels.cell_m
            _add_moved(total, moments, x * edge, y * edge, z * edge)
    surfels.state[surfel] = _VOID
    if total[0] < _LEAST_POINTS:
        return
    covariance, normal, variance = np.empty(6), np.empty(3), surfels.sigma_m**2
    _covariance(total, covariance)
    shape = _shape_of(covariance, surfels.is_planar, normal)
    if shape == _LINE:
        return
    surfels.state[surfel] = _FITTED
    for axis in range(3):
        corner_m = surfels.corners[cell, axis] * surfels.cell_m
        surfels.means[surfel, axis] = corner_m + total[1 + axis] / total[0]
    facing = 0.0
    for axis in range(3):
        facing += normal[axis] * total[10 + axis]
    if shape == _FLAT:
        surfels.normals[surfel] = normal if facing >= 0.0 else -normal
        _plane(normal, variance, surfels.weights[surfel])
    else:
        surfels.normals[surfel] = total[10:]
        weight, edge = surfels.weights[surfel], surfels.cell_m
        _inverse_with_noise(covariance, variance, surfels.is_planar, weight)
        _open_along_extent(covariance, edge, variance, surfels.is_planar, weight)


@njit(cache=True)
def _add_normals(
    points: FloatArray,
    cell_m: float,
    is_planar: bool,
    directions: FloatArray,
    is_known: npt.NDArray[np.bool_],
) -> None:
    """Fill in the surface normal at each point that has none yet and lies on a flat surface."""
    table, keys, corners, cell_of = _cells_of(points, cell_m, is_planar)
    faces = np.zeros(len(points), np.int64)
    surfel_of, moments = _moments_of(points, directions, faces, cell_of, corners, cell_m)
    normals = np.zeros((len(keys), 3))
    is_flat = np.zeros(len(keys), np.bool_)
    around = np.empty(27, np.int64)
    total, covariance = np.empty(13), np.empty(6)
    for cell in range(len(keys)):
        _neighbours(table, keys, corners[cell], is_planar, around)
        total[:] = 0.0
        for n in range(27):
            if around[n] >= 0:
                x, y, z = n // 9 - 1, n // 3 % 3 - 1, n % 3 - 1
                m = moments[surfel_of[around[n], 0]]
                _add_moved(total, m, x * cell_m, y * cell_m, z * cell_m)
        if total[0] >= _LEAST_POINTS:
            _covariance(total, covariance)
            is_flat[cell] = _shape_of(covariance, is_planar, normals[cell]) == _FLAT
    for n in range(len(points)):
        if not is_known[n] and is_flat[cell_of[n]]:
            directions[n] = normals[cell_of[n]]
            is_known[n] = True


@njit(cache=True)
def distance2_of(surfels: Surfels, surfel: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of a point from a surfel in standard deviations."""
    w, mean = surfels.weights[surfel], surfels.means[surfel]
    x, y, z = x - mean[0], y - mean[1], z - mean[2]
    square: float = w[0] * x * x + w[3] * y * y + w[5] * z * z
    mixed: float = w[1] * x * y + w[2] * x * z + w[4] * y * z
    return square + 2.0 * mixed


@njit(cache=True)
def _nearest_in(
    surfels: Surfels,
    cell: int,
    x: float,
    y: float,
    z: float,
    view: FloatArray,
    least: float,
    best: int,
) -> tuple[float, int]:
    """Return the nearest surfel of a cell that faces the sensor, and its squared distance."""
    for face in range(_FACES):
        surfel = surfels.surfel_of[cell, face]
        if surfel < 0:
            continue
        if surfels.state[surfel] == _UNFITTED:
            _fit(surfels, cell, face)
        if surfels.state[surfel] == _VOID:
            continue
        normal = surfels.normals[surfel]
        if normal[0] * view[0] + normal[1] * view[1] + normal[2] * view[2] <= 0.0:
            continue
        distance2 = distance2_of(surfels, surfel, x, y, z)
        if distance2 < least:
            least, best = distance2, surfel
    return least, best


@njit(cache=True)
def _match(surfels: Surfels, x: float, y: float, z: float, view: FloatArray) -> int:
    """Return the surfel that a point lies on, -1 if there is none in its cell or next to it.

    Args:
        surfels: The map.
        x: Coordinates of the point.
        y: The same.
        z: The same.
        view: Vector from the point to the sensor.
    """
    i = math.floor(x / surfels.cell_m)
    j = math.floor(y / surfels.cell_m)
    k = 0 if surfels.is_planar else math.floor(z / surfels.cell_m)
    least, best = np.inf, -1
    cell = _find(surfels.table, surfels.keys, i, j, k)
    if cell >= 0:
        least, best = _nearest_in(surfels, cell, x, y, z, view, least, best)
    if best >= 0:
        return best
    depth = 0 if surfels.is_planar else 1
    for di in range(-1, 2):
        for dj in range(-1, 2):
            for dk in range(-depth, depth + 1):
                cell = _find(surfels.table, surfels.keys, i + di, j + dj, k + dk)
                if cell >= 0:
                    least, best = _nearest_in(surfels, cell, x, y, z, view, least, best)
    return best


@njit(cache=True)
def match(
    surfels: Surfels,
    moved: FloatArray,
    pose: FloatArray,
    views: FloatArray,
    surfel_of: Indices,
    hits: Indices,
) -> None:
    """Fill in the surfel that each point lies on, -1 for none, and how many lie on each surfel.

    Args:
        surfels: The map.
        moved: Points in its frame, shape (N, 3), m.
        pose: `map_from_body`, shape (4, 4).
        views: Vector from each point to the sensor in the body frame, shape (N, 3).
        surfel_of: Filled in, shape (N,).
        hits: Filled in, shape (S,).
    """
    hits[:] = 0
    view = np.empty(3)
    for n in range(len(moved)):
        for row in range(3):
            view[row] = (
                pose[row, 0] * views[n, 0] + pose[row, 1] * views[n, 1] + pose[row, 2] * views[n, 2]
            )
        surfel_of[n] = _match(surfels, moved[n, 0], moved[n, 1], moved[n, 2], view)
        if surfel_of[n] >= 0:
            hits[surfel_of[n]] += 1


# ------------------------------------------------------------------ the pose that fits best


@njit(cache=True)
def _apply(pose: FloatArray, point: FloatArray, out: FloatArray) -> None:
    for row in range(3):
        out[row] = (
            pose[row, 0] * point[0]
            + pose[row, 1] * point[1]
            + pose[row, 2] * point[2]
            + pose[row, 3]
        )


@njit(cache=True)
def _move(pose: Pose, points: FloatArray, out: FloatArray) -> None:
    for n in range(len(points)):
        _apply(pose, points[n], out[n])


@njit(cache=True)
def linearize(
    surfels: Surfels,
    points: FloatArray,
    lags: FloatArray,
    pose: FloatArray,
    moved: FloatArray,
    surfel_of: Indices,
    hits: Indices,
    kernel2: float,
    information: FloatArray,
    gradient: FloatArray,
) -> tuple[int, int]:
    """Fill in what the points say of their pose, and return how many match and how many fit.

    Points on one surfel share its error: m of them weigh as much as m / (1 + m). Robust weights are
    those of Geman and McClure.

    Args:
        surfels: The map.
        points: In the body frame at the end of the sweep, shape (N, 3), m.
        lags: Share of the sweep's motion that was still to come when each point was taken, shape
            (N,).
        pose: `map_from_body`, shape (4, 4).
        moved: The points in the map's frame, shape (N, 3), m.
        surfel_of: Surfel of each point, -1 for none, shape (N,).
        hits: Number of points on each surfel, shape (S,).
        kernel2: Squared scale of the robust weights, in standard deviations.
        information: Filled in, shape (12, 12): of the pose, then of the motion during the sweep.
        gradient: Filled in, shape (12,).
    """
    information[:] = 0.0
    gradient[:] = 0.0
    matched, fitting = 0, 0
    jacobian = np.empty((3, 6))
    for n in range(len(points)):
        surfel = surfel_of[n]
        if surfel < 0:
            continue
        matched += 1
        distance2 = distance2_of(surfels, surfel, moved[n, 0], moved[n, 1], moved[n, 2])
        weight = 1.0 / (1.0 + distance2 / kernel2) ** 2
        fitting += weight > 0.25
        weight /= 1.0 + hits[surfel]
        p, w, mean, lag = points[n], surfels.weights[surfel], surfels.means[surfel], lags[n]
        for row in range(3):
            a, b, c = pose[row, 0], pose[row, 1], pose[row, 2]
            jacobian[row, 0] = c * p[1] - b * p[2]
            jacobian[row, 1] = a * p[2] - c * p[0]
            jacobian[row, 2] = b * p[0] - a * p[1]
            jacobian[row, 3], jacobian[row, 4], jacobian[row, 5] = a, b, c
        x, y, z = moved[n, 0] - mean[0], moved[n, 1] - mean[1], moved[n, 2] - mean[2]
        for column in range(6):
            a, b, c = jacobian[0, column], jacobian[1, column], jacobian[2, column]
            u = weight * (w[0] * a + w[1] * b + w[2] * c)
            v = weight * (w[1] * a + w[3] * b + w[4] * c)
            t = weight * (w[2] * a + w[4] * b + w[5] * c)
            pull = u * x + v * y + t * z
            gradient[column] += pull
            gradient[6 + column] -= lag * pull
            for row in range(column + 1):
                part = jacobian[0, row] * u + jacobian[1, row] * v + jacobian[2, row] * t
                information[row, column] += part
                information[row, 6 + column] -= lag * part
                information[6 + row, 6 + column] += lag * lag * part
    for column in range(6):
        for row in range(column):
            information[column, row] = information[row, column]
            information[column, 6 + row] = information[row, 6 + column]
            information[6 + column, 6 + row] = information[6 + row, 6 + column]
    for column in range(6):
        for row in range(6):
            information[6 + column, row] = information[row, 6 + column]
    return matched, fitting


@njit(cache=True)
def _exp(xi: FloatArray, out: FloatArray) -> None:
    """Fill in the transform of a tangent vector (compiled counterpart of `geometry.exp`)."""
    x, y, z = xi[0], xi[1], xi[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < _SMALL_ANGLE_RAD:
        a, b, c = 1.0, 0.5, 1.0 / 6.0
    else:
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / square
        c = (angle - math.sin(angle)) / (square * angle)
    u, v, w = xi[3], xi[4], xi[5]
    along = x * u + y * v + z * w
    out[0, 0], out[0, 1], out[0, 2] = (
        1.0 - b * (square - x * x),
        b * x * y - a * z,
        b * x * z + a * y,
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        b * x * y + a * z,
        1.0 - b * (square - y * y),
        b * y * z - a * x,
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        b * x * z - a * y,
        b * y * z + a * x,
        1.0 - b * (square - z * z),
    )
    straight = 1.0 - c * square
    out[0, 3] = straight * u + b * (y * w - z * v) + c * along * x
    out[1, 3] = straight * v + b * (z * u - x * w) + c * along * y
    out[2, 3] = straight * w + b * (x * v - y * u) + c * along * z
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@njit(cache=True)
def _log(pose: FloatArray, out: FloatArray) -> None:
    """Fill in the tangent vector of a transform (counterpart of `geometry.log`), angle below pi."""
    x = 0.5 * (pose[2, 1] - pose[1, 2])
    y = 0.5 * (pose[0, 2] - pose[2, 0])
    z = 0.5 * (pose[1, 0] - pose[0, 1])
    sine = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(sine, 0.5 * (pose[0, 0] + pose[1, 1] + pose[2, 2] - 1.0))
    if sine < _SMALL_ANGLE_RAD:
        stretch, b = 1.0, 1.0 / 12.0
    else:
        stretch = angle / sine
        b = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / (angle * angle)
    x, y, z = x * stretch, y * stretch, z * stretch
    u, v, w = pose[0, 3], pose[1, 3], pose[2, 3]
    straight = 1.0 - b * (x * x + y * y + z * z)
    along = b * (x * u + y * v + z * w)
    out[0], out[1], out[2] = x, y, z
    out[3] = straight * u - 0.5 * (y * w - z * v) + along * x
    out[4] = straight * v - 0.5 * (z * u - x * w) + along * y
    out[5] = straight * w - 0.5 * (x * v - y * u) + along * z


@njit(cache=True)
def _inverse_times(first: FloatArray, second: FloatArray, out: FloatArray) -> None:
    """Fill in `inverse(first) @ second`."""
    for row in range(3):
        for column in range(4):
            total = 0.0
            for n in range(3):
                part = second[n, column] - (first[n, 3] if column == 3 else 0.0)
                total += first[n, row] * part
            out[row, column] = total
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0


@njit(cache=True)
def carry_to_end(points: FloatArray, lags: FloatArray, motion: FloatArray, out: FloatArray) -> None:
    """Fill in where points are in the body frame at the end of the sweep, shape (N, 3), m.

    Args:
        points: Each in the body frame when it was taken, shape (N, 3), m.
        lags: Share of the motion that was still to come then, shape (N,).
        motion: Tangent vector of the motion, shape (6,).
        out: Filled in.
    """
    step, pose = np.empty(6), np.empty((4, 4))
    before = np.nan
    for n in range(len(points)):
        if lags[n] != before:
            before = lags[n]
            for axis in range(6):
                step[axis] = -before * motion[axis]
            _exp(step, pose)
        _apply(pose, points[n], out[n])


@njit(cache=True)
def _solve(matrix: FloatArray, vector: FloatArray, axes: Indices, out: FloatArray) -> bool:
    """Fill in the solution along some axes, zero elsewhere; return whether there is one."""
    count = len(axes)
    factor, partial = np.zeros((count, count)), np.empty(count)
    for i in range(count):
        for j in range(i + 1):
            total = matrix[axes[i], axes[j]]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(count):
        total = vector[axes[i]]
        for k in range(i):
            total -= factor[i, k] * partial[k]
        partial[i] = total / factor[i, i]
    out[:] = 0.0
    for i in range(count - 1, -1, -1):
        total = partial[i]
        for k in range(i + 1, count):
            total -= factor[k, i] * out[axes[k]]
        out[axes[i]] = total / factor[i, i]
    return True


@njit(cache=True)
def _add_prior(
    prior_information: FloatArray,
    gap: FloatArray,
    first: int,
    weight: float,
    information: FloatArray,
    gradient: FloatArray,
) -> None:
    """Add the information and the pull of a prior to the block that starts at an axis."""
    for row in range(6):
        for column in range(6):
            information[first + row, first + column] += weight * prior_information[row, column]
            gradient[first + row] += weight * prior_information[row, column] * gap[column]


@njit(cache=True)
def _weight_of(information: FloatArray, gap: FloatArray, gate: float) -> float:
    """Return the share of a prior's information that leaves it on the gate, at most 1."""
    distance2 = 0.0
    for row in range(6):
        for column in range(6):
            distance2 += gap[row] * information[row, column] * gap[column]
    return 1.0 if distance2 <= gate else gate / distance2


@njit(cache=True)
def gauss_newton(
    surfels: Surfels,
    points: FloatArray,
    lags: FloatArray,
    views: FloatArray,
    start: FloatArray,
    prior: FloatArray,
    prior_information: FloatArray,
    gate: float,
    motion: FloatArray,
    motion_information: FloatArray,
    kernel2: float,
    most: int,
) -> tuple[Pose, FloatArray, FloatArray, float, int, int, float]:
    """Return the pose that the points and the prior agree on.

    The prior counts in full up to the gate; where it contradicts the points beyond, only so much of
    it as leaves it on the gate. When the points of a sweep were taken one after the other, the
    motion during the sweep is estimated with the pose: half of an error of it would end up there.

    Args:
        surfels: The map.
        points: Each in the body frame when it was taken, shape (N, 3), m.
        lags: Share of the sweep's motion that was still to come then, shape (N,).
        views: Vector from each point to the sensor, of any length, shape (N, 3).
        start: `map_from_body` to start from, shape (4, 4).
        prior: The same as predicted.
        prior_information: Of the prediction, shape (6, 6).
        gate: Squared Mahalanobis distance up to which the prior is believed.
        motion: Predicted motion during the sweep as a tangent vector, shape (6,).
        motion_information: Of that, shape (6, 6).
        kernel2: Squared scale of the robust weights, in standard deviations.
        most: Largest number of iterations.

    Returns:
        The pose; the motion, shape (6,); the information of the points alone, and that of the prior
        of the motion, about the pose and the motion, shape (12, 12); the weight of the prior in
        (0, 1]; the numbers of points that match and that fit; the length of the last step (rad and
        m alike), infinite if there was none.
    """
    information, gradient = np.zeros((12, 12)), np.zeros(12)
    together, step = np.zeros((12, 12)), np.empty(12)
    hits = np.zeros(len(surfels.means), np.int64)
    surfel_of = np.empty(len(points), np.int64)
    pose, at_end, moving = start.copy(), points.copy(), motion.copy()
    moved, gap = np.empty(points.shape), np.empty(6)
    difference, change = np.empty((4, 4)), np.empty((4, 4))
    is_sweep = len(lags) > 0 and lags.max() > 0.0
    axes = np.array([2, 3, 4]) if surfels.is_planar else np.arange(12 if is_sweep else 6)
    matched, fitting, weight, length = 0, 0, 1.0, np.inf
    for iteration in range(most):
        if is_sweep:
            carry_to_end(points, lags, moving, at_end)
        _move(pose, at_end, moved)
        # Near the end a point keeps its surfel: it could go back and forth for ever.
        if iteration == 0 or (length > _REMATCHED and iteration < 2 * most // 3):
            match(surfels, moved, pose, views, surfel_of, hits)
        matched, fitting = linearize(
            surfels, at_end, lags, pose, moved, surfel_of, hits, kernel2, information, gradient
        )
        if is_sweep:
            _add_prior(motion_information, moving - motion, 6, 1.0, information, gradient)
        _inverse_times(prior, pose, difference)
        _log(difference, gap)
        weight = _weight_of(prior_information, gap, gate)
        together[:] = information
        _add_prior(prior_information, gap, 0, weight, together, gradient)
        if not _solve(together, -gradient, axes, step):
            return pose, moving, information, weight, matched, fitting, np.inf
        _exp(step, change)
        pose = pose @ change
        moving += step[6:]
        if surfels.is_planar:
            scale = math.sqrt(pose[0, 0] ** 2 + pose[1, 0] ** 2)
            c, s = pose[0, 0] / scale, pose[1, 0] / scale
            pose[0, 0], pose[0, 1], pose[1, 0], pose[1, 1] = c, -s, s, c
        length = np.abs(step[:6]).max()
        if length < _CONVERGED:
            break
    return pose, moving, information, weight, matched, fitting, length


# ------------------------------------------------------------------ what the stages use


def build_surfels(
    points: FloatArray,
    directions: FloatArray,
    *,
    cell_m: float,
    sigma_m: float,
    is_planar: bool,
) -> Surfels:
    """Return the surfels of some points.

    Args:
        points: Shape (N, 3), m, N >= 1.
        directions: Unit vector of each point to the side that it was seen from, shape (N, 3).
        cell_m: Edge of a cell; a surfel reaches over three.
        sigma_m: Standard deviation of the distance of a point from its surfel.
        is_planar: Whether heights do not count.
    """
    axis = np.argmax(np.abs(directions), axis=1)
    faces = 2 * axis + (directions[np.arange(len(points)), axis] < 0.0)
    table, keys, corners, cell_of = _cells_of(points, cell_m, is_planar)
    surfel_of, moments = _moments_of(points, directions, faces, cell_of, corners, cell_m)
    count = len(moments)
    return Surfels(
        table=table,
        keys=keys,
        corners=corners,
        moments=moments,
        state=np.full(count, _UNFITTED, dtype=np.int64),
        surfel_of=surfel_of,
        means=np.empty((count, 3)),
        normals=np.empty((count, 3)),
        weights=np.empty((count, 6)),
        cell_m=cell_m,
        sigma_m=sigma_m,
        is_planar=is_planar,
    )


def directions_of(
    points: FloatArray, sensor: FloatArray, cells_m: tuple[float, ...], *, is_planar: bool
) -> FloatArray:
    """Return the side that each point of one scan was seen from, as unit vectors, shape (N, 3).

    That is the normal of the surface around it, at the first size at which it is flat; the
    direction to the sensor where it is not.

    Args:
        points: Shape (N, 3), m.
        sensor: Position of the sensor in the same frame, shape (3,), m.
        cells_m: Edges of the cells to look at, in this order.
        is_planar: Whether heights do not count.
    """
    to_sensor = sensor - points
    if is_planar:
        to_sensor[:, 2] = 0.0
    lengths = np.linalg.norm(to_sensor, axis=1, keepdims=True)
    directions = np.divide(to_sensor, lengths, out=np.zeros_like(to_sensor), where=lengths > 0.0)
    is_known = np.zeros(len(points), dtype=bool)
    for cell_m in cells_m:
        _add_normals(points, cell_m, is_planar, directions, is_known)
    is_away = np.einsum("ni,ni->n", directions, to_sensor) < 0.0
    directions[is_away] *= -1.0
    return np.asarray(directions)


def thin(points: FloatArray, cell_m: float) -> Indices:
    """Return the indices of the first point in each occupied cell, in their order."""
    indices: Indices = _first_points(points, cell_m)
    return indices
