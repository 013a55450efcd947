"""Surfels and the compiled registration, with numpy and finite differences as judges."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core import surfels as compiled
from hmt_service.core.geometry import FloatArray, exp, identity
from hmt_service.core.surfels import directions_of, thin
from tests.core.factories import (
    ROOM,
    built,
    cloud_of,
    matches_of,
    points_from,
    surfels_of,
    sweep_from,
    unpacked,
)

STILL = np.zeros(6)
ROUND, LINE, FLAT = compiled._ROUND, compiled._LINE, compiled._FLAT


def packed(matrix: FloatArray) -> FloatArray:
    """Return the upper triangle of a symmetric matrix, shape (6,)."""
    return np.asarray(matrix[np.triu_indices(3)])


def rotation_of(rng: np.random.Generator) -> FloatArray:
    return np.asarray(exp(np.append(rng.uniform(-1.5, 1.5, 3), np.zeros(3)))[:3, :3])


# ------------------------------------------------------------------ shapes


def shape_by_eigenvalues(matrix: FloatArray) -> int:
    least, middle, largest = np.linalg.eigvalsh(matrix)
    if middle <= 0.1 * largest:
        return LINE
    return ROUND if least > 0.35**2 * middle else FLAT


@pytest.mark.parametrize("scale_m", [1e-3, 0.1, 30.0])
def test_shapes_and_normals_are_those_of_the_eigenvectors(scale_m: float) -> None:
    rng = np.random.default_rng(5)
    normal, found = np.empty(3), []
    for _ in range(300):
        middle = rng.uniform(0.0, 0.5)
        values = scale_m**2 * np.array([rng.uniform(0.0, 0.3) * middle, middle, 1.0])
        turn = rotation_of(rng)
        matrix = turn @ np.diag(values) @ turn.T
        shape = compiled._shape_3d(packed(matrix), normal)
        assert shape == shape_by_eigenvalues(matrix)
        if shape == FLAT:
            expected = np.linalg.eigh(matrix)[1][:, 0]
            assert abs(normal @ expected) == pytest.approx(1.0, abs=1e-9)
        found.append(shape)
    # All three are among them: none of these branches goes untested.
    assert min(found.count(each) for each in (ROUND, LINE, FLAT)) > 20


@pytest.mark.parametrize(
    ("deviations", "shape"),
    [
        ((0.0, 1.0, 1.0), FLAT),  # a disc without any thickness
        ((0.0, 0.4, 1.0), FLAT),
        ((0.34, 1.0, 1.0), FLAT),
        ((0.36, 1.0, 1.0), ROUND),  # thicker than 0.35 of its width
        ((0.99, 1.0, 1.0), ROUND),
        ((0.0, 0.31, 1.0), LINE),  # 0.31^2 < 0.1: a ring of a LiDAR has no normal
        ((0.0, 0.33, 1.0), FLAT),
        ((0.0, 0.0, 1.0), LINE),
        ((0.01, 0.01, 1.0), LINE),
        ((0.0, 0.0, 0.0), LINE),  # a single point
    ],
)
def test_lines_and_blobs_are_told_from_planes(
    deviations: tuple[float, float, float], shape: int
) -> None:
    normal = np.empty(3)
    rng = np.random.default_rng(6)
    for turn in (np.eye(3), *(rotation_of(rng) for _ in range(20))):
        matrix = turn @ np.diag(0.2**2 * np.square(deviations)) @ turn.T
        assert compiled._shape_3d(packed(matrix), normal) == shape
        if shape == FLAT:
            assert abs(normal @ turn[:, 0]) == pytest.approx(1.0, abs=1e-9)


def test_planar_shapes_and_normals_are_those_of_the_eigenvectors() -> None:
    rng = np.random.default_rng(7)
    normal = np.empty(3)
    flat = 0
    for _ in range(200):
        angle, thickness = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 0.7)
        along, across = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        matrix = np.zeros((3, 3))
        matrix[:2, :2] = np.outer(along, along) + thickness**2 * np.outer(across, across)
        shape = compiled._shape_2d(packed(matrix), normal)
        assert shape == (FLAT if thickness <= 0.35 else ROUND)
        if shape == FLAT:
            flat += 1
            assert abs(normal[:2] @ across) == pytest.approx(1.0, abs=1e-12)
            assert normal[2] == 0.0
    assert 50 < flat < 150


@pytest.mark.parametrize("is_planar", [False, True])
def test_inverse_of_a_covariance_with_noise_is_that_of_numpy(is_planar: bool) -> None:
    rng = np.random.default_rng(8)
    result = np.empty(6)
    for _ in range(100):
        root = rng.uniform(-0.3, 0.3, (3, 3))
        matrix, variance = root @ root.T, 0.014**2
        compiled._inverse_with_noise(packed(matrix), variance, is_planar, result)
        axes = 2 if is_planar else 3
        expected = np.zeros((3, 3))
        expected[:axes, :axes] = np.linalg.inv((matrix + variance * np.eye(3))[:axes, :axes])
        assert unpacked(result) == pytest.approx(expected, rel=1e-9, abs=1e-6)


# ------------------------------------------------------------------ cells


def test_thinning_keeps_the_first_point_of_each_cell_in_order() -> None:
    points = np.random.default_rng(9).uniform(-2.0, 2.0, (3000, 3))
    first: dict[tuple[int, ...], int] = {}
    for index, point in enumerate(points):
        first.setdefault(tuple(np.floor(point / 0.3).astype(int)), index)
    chosen = thin(points, 0.3)
    assert chosen.tolist() == sorted(first.values())
    assert len(chosen) < len(points)


def test_thinning_nothing_gives_nothing() -> None:
    assert thin(np.zeros((0, 3)), 0.3).tolist() == []


@pytest.mark.parametrize("corner_m", [0.0, -900.0, 2000.0])
def test_surfels_are_the_same_wherever_their_cells_are(corner_m: float) -> None:
    points = np.random.default_rng(10).uniform(-1.0, 1.0, (400, 3)) * [1.0, 1.0, 0.01]
    # Middle of a cell, so that noise does not carry points into the next.
    points[:, 2] += 0.125
    offset = np.array([corner_m, -corner_m, 0.25])
    found = []
    for move in (np.zeros(3), offset):
        surfels = surfels_of(points + move, np.array([0.0, 0.0, 5.0]) + move)
        matches = matches_of(surfels, points[::5] + move, np.tile([0.0, 0.0, 1.0], (80, 1)))
        assert matches.min() >= 0
        found.append((surfels.means[matches] - move, surfels.weights[matches]))
    (means, weights), (moved_means, moved_weights) = found
    assert moved_means == pytest.approx(means, abs=1e-9)
    assert moved_weights == pytest.approx(weights, rel=1e-5, abs=1e-3)


# ------------------------------------------------------------------ sides


@pytest.mark.parametrize("is_planar", [False, True])
def test_directions_point_to_the_sensor(is_planar: bool) -> None:
    sensor = np.array([0.3, -0.2, 0.4])
    points = points_from(ROOM, identity()) if is_planar else sweep_from(identity(), STILL)[0]
    directions = directions_of(points, sensor, (0.25, 1.0), is_planar=is_planar)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(len(points)), abs=1e-9)
    to_sensor = sensor - points
    if is_planar:
        to_sensor[:, 2] = 0.0
        assert np.all(directions[:, 2] == 0.0)
    assert np.einsum("ni,ni->n", directions, to_sensor).min() >= 0.0


def test_directions_on_a_wall_are_its_normal() -> None:
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.05), np.arange(-1.0, 1.0, 0.05))
    wall = np.stack([np.full(y.size, 1.0), y.ravel(), z.ravel()], axis=1)
    # Seen at a glance: the direction to the sensor is another.
    for sensor, side in ((np.array([0.8, -3.0, 0.0]), -1.0), (np.array([1.1, -3.0, 0.0]), 1.0)):
        directions = directions_of(wall, sensor, (0.25,), is_planar=False)
        expected = np.tile([side, 0.0, 0.0], (len(wall), 1))
        assert directions == pytest.approx(expected, abs=1e-6)


def test_point_at_the_sensor_has_no_direction() -> None:
    directions = directions_of(np.zeros((1, 3)), np.zeros(3), (0.25,), is_planar=False)
    assert np.array_equal(directions, np.zeros((1, 3)))


def faces_of_a_thin_wall(*, is_planar: bool) -> tuple[FloatArray, FloatArray]:
    """Return both faces of a wall of 0.14 m, at x = 1 m and 1.14 m, and their directions."""
    y, z = np.meshgrid(np.arange(-2.0, 2.0, 0.04), [0.0] if is_planar else np.arange(-1, 1, 0.04))
    points, directions = [], []
    for x, sensor_x in ((1.0, -1.0), (1.14, 3.0)):
        face = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)
        sensor = np.array([sensor_x, 0.1, 0.0])
        points.append(face)
        directions.append(directions_of(face, sensor, (0.25, 1.0), is_planar=is_planar))
    return np.concatenate(points), np.concatenate(directions)


@pytest.mark.parametrize("cell_m", [0.1, 0.25, 1.0])
@pytest.mark.parametrize("is_planar", [False, True])
def test_faces_of_a_thin_wall_are_two_surfels(is_planar: bool, cell_m: float) -> None:
    points, directions = faces_of_a_thin_wall(is_planar=is_planar)
    surfels = built(points, directions, cell_m=cell_m, is_planar=is_planar)
    step = 1 if is_planar else 37
    matches = matches_of(surfels, points[::step], directions[::step])
    # A face's own edge is as well covered as its middle.
    assert matches.min() >= 0
    used = np.unique(matches)
    normals, means = surfels.normals[used], surfels.means[used]
    assert np.abs(normals[:, 0]) == pytest.approx(np.ones(len(used)), abs=1e-6)
    is_near = normals[:, 0] < 0.0
    assert is_near.any()
    assert (~is_near).any()
    # Neither is drawn to the other: each lies on its face.
    assert means[is_near, 0] == pytest.approx(np.full(is_near.sum(), 1.0), abs=1e-9)
    assert means[~is_near, 0] == pytest.approx(np.full((~is_near).sum(), 1.14), abs=1e-9)


@pytest.mark.parametrize("is_planar", [False, True])
def test_point_seen_from_one_side_never_matches_the_other(is_planar: bool) -> None:
    points, directions = faces_of_a_thin_wall(is_planar=is_planar)
    surfels = built(points, directions, cell_m=0.1, is_planar=is_planar)
    rng = np.random.default_rng(11)
    matched = {-1.0: 0, 1.0: 0}
    for _ in range(200):
        x, y = rng.uniform(0.85, 1.3), rng.uniform(-1.5, 1.5)
        for side in matched:
            view = np.array([side * rng.uniform(0.1, 3.0), rng.uniform(-3.0, 3.0), 0.0])
            surfel = compiled._match(surfels, x, y, 0.02, view)
            if surfel >= 0:
                matched[side] += 1
                assert np.sign(surfels.normals[surfel, 0]) == side
                assert surfels.means[surfel, 0] == pytest.approx(1.0 if side < 0 else 1.14)
    assert min(matched.values()) > 40


@pytest.mark.parametrize("cell_m", [0.25, 1.0])
def test_single_ring_of_a_lidar_makes_no_surfel(cell_m: float) -> None:
    azimuths = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    ring = np.stack([6.0 * np.cos(azimuths), 6.0 * np.sin(azimuths), 0.0 * azimuths - 1.2], axis=1)
    surfels = surfels_of(ring, np.zeros(3), cell_m=cell_m)
    assert matches_of(surfels, ring[::9], -ring[::9]).max() == -1
    # Two rings span a plane where they are near enough, and that plane is the floor.
    both = np.concatenate([ring, ring * [1.05, 1.05, 1.0]])
    surfels = surfels_of(both, np.zeros(3))
    matches = matches_of(surfels, ring[::9], -ring[::9])
    known = matches[matches >= 0]
    assert len(known) > 50
    expected = np.tile([0.0, 0.0, 1.0], (len(known), 1))
    assert surfels.normals[known] == pytest.approx(expected, abs=1e-6)


def test_cloud_of_a_room_is_covered_by_surfels() -> None:
    # Nearly every point of a map lies on something that this map knows.
    points = cloud_of(ROOM, spacing_m=0.02)
    directions = directions_of(points, np.array([0.1, 0.1, 0.0]), (0.1, 0.4), is_planar=True)
    surfels = built(points, directions, cell_m=0.1, is_planar=True)
    matches = matches_of(surfels, points[::10], directions[::10])
    assert np.mean(matches >= 0) > 0.98
