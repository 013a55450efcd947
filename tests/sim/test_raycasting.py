from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.sim.raycasting import Fans, RayCaster
from hmt_service.sim.worlds.plan import Box, mesh_of
from hmt_service.sim.worlds.world import World

# One square wall of 10 m x 10 m at x = 4 m.
WALL = World(
    "wall",
    np.array([[4, -5, -5], [4, 5, -5], [4, 5, 5], [4, -5, 5]], dtype=np.float32),
    np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
)


def rays(origin: list[float], forward: list[list[float]]) -> Fans:
    """Return fans of one ray each."""
    return Fans(
        np.array([[origin]]), np.array([[[0.0, 0.0, 1.0]]]), np.array([forward]), np.zeros(1)
    )


def test_range_to_a_wall_is_its_distance() -> None:
    angle = math.radians(40.0)
    fans = rays([1.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [math.cos(angle), math.sin(angle), 0.0]])
    assert RayCaster(WALL).ranges(fans)[0, :, 0] == pytest.approx([3.0, 3.0 / math.cos(angle)])


def test_rays_of_a_fan_spread_by_their_elevations() -> None:
    elevations = np.radians([-30.0, 0.0, 45.0, 89.0])
    up, forward = np.array([[[0.0, 0.0, 1.0]]]), np.array([[[0.8, 0.6, 0.0]]])
    ranges = RayCaster(WALL).ranges(Fans(np.zeros((1, 1, 3)), up, forward, elevations))
    assert ranges[0, 0, :3] == pytest.approx(5.0 / np.cos(elevations[:3]))
    assert ranges[0, 0, 3] == math.inf


def test_range_is_infinite_where_there_is_nothing() -> None:
    fans = rays([0.0, 0.0, 0.0], [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.all(np.isinf(RayCaster(WALL).ranges(fans)))


def test_points_behind_a_wall_are_not_seen() -> None:
    points = np.array([[3.9, 0.0, 0.0], [4.1, 0.0, 0.0], [8.0, 30.0, 0.0], [0.0, 0.0, 0.0]])
    is_seen = RayCaster(WALL).sees(np.zeros(3), points)
    assert is_seen.tolist() == [True, False, True, True]


def test_clearance_is_the_distance_to_the_nearest_surface() -> None:
    points = np.array([[1.0, 0.0, 0.0], [7.0, 9.0, 0.0]])
    assert RayCaster(WALL).clearances(points) == pytest.approx([3.0, 5.0], rel=1e-5)


def boxes(count: int, width_m: float) -> World:
    """Return a world of boxes scattered over a square, with a floor of two triangles."""
    rng = np.random.default_rng(0)
    low = rng.uniform(-width_m / 2, width_m / 2, (count, 2))
    high = low + rng.uniform(0.3, 4.0, (count, 2))
    corners = np.hstack([low, high]).tolist()
    vertices, triangles = mesh_of([Box(x, y, x_max, y_max, 2.0) for x, y, x_max, y_max in corners])
    floor = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=np.float32) * width_m
    square = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32) + len(vertices)
    return World(
        "boxes",
        np.concatenate([vertices, floor]),
        np.concatenate([triangles, square]),
        np.zeros((2, 3)),
    )


def spinning(origins: np.ndarray) -> Fans:
    """Return sweeps of 90 columns and three rows, shape of the origins (S, P, 3)."""
    angles = np.linspace(0.0, 2 * np.pi, 90)
    forward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(90)])
    return Fans(
        origins,
        np.broadcast_to([0.0, 0.0, 1.0], origins.shape),
        np.broadcast_to(forward, (len(origins), 90, 3)),
        np.array([-0.1, 0.0, 0.1]),
    )


@pytest.mark.parametrize("fans_start_together", [True, False])
def test_tiles_answer_like_the_whole(fans_start_together: bool) -> None:
    world = boxes(3000, 600.0)
    rng = np.random.default_rng(1)
    # Tiles are 64 m wide: sweeps start on many of them, and some cross a border.
    origins = rng.uniform(-300.0, 300.0, (60, 1, 3)) * (1.0, 1.0, 0.0) + (0.0, 0.0, 0.5)
    if not fans_start_together:
        origins = origins + np.linspace(0.0, 20.0, 90)[None, :, None] * (1.0, 0.0, 0.0)
    fans = spinning(origins)
    tiled = RayCaster(world, 20.0, whole_triangles=100).ranges(fans)
    whole = RayCaster(world, 20.0).ranges(fans)
    assert np.array_equal(tiled, whole)
    assert 0.2 < np.isfinite(whole).mean() < 0.9


def test_clearances_of_tiles_are_those_of_the_whole_up_to_the_reach() -> None:
    world = boxes(200, 600.0)
    points = np.random.default_rng(2).uniform(-300.0, 300.0, (500, 3)) * (1.0, 1.0, 0.1)
    tiled = RayCaster(world, 20.0, whole_triangles=100).clearances(points)
    whole = RayCaster(world).clearances(points)
    assert tiled == pytest.approx(np.where(whole <= 20.0, whole, np.inf), rel=1e-5)


def test_surfaces_beyond_the_reach_are_not_seen() -> None:
    fans = rays([0.0, 0.0, 0.0], [[1.0, 0.0, 0.0]])
    assert np.isfinite(RayCaster(WALL, 4.5).ranges(fans)).all()
    assert np.isinf(RayCaster(WALL, 3.5).ranges(fans)).all()


def test_where_there_is_no_mesh_nothing_is_seen() -> None:
    caster = RayCaster(WALL, 10.0, whole_triangles=1)
    assert np.isinf(caster.ranges(rays([900.0, 0.0, 0.0], [[1.0, 0.0, 0.0]]))).all()
    assert caster.clearances(np.array([[900.0, 0.0, 0.0]])).tolist() == [np.inf]
