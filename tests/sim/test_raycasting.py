from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.sim.raycasting import Fans, RayCaster
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
    directions = np.array(forward)
    up = np.broadcast_to([0.0, 0.0, 1.0], directions.shape)
    return Fans(np.broadcast_to(origin, directions.shape), directions, up, np.zeros(1))


def test_range_to_a_wall_is_its_distance() -> None:
    angle = math.radians(40.0)
    fans = rays([1.0, 0.0, 0.0], [[1.0, 0.0, 0.0], [math.cos(angle), math.sin(angle), 0.0]])
    assert RayCaster(WALL).ranges(fans)[:, 0] == pytest.approx([3.0, 3.0 / math.cos(angle)])


def test_rays_of_a_fan_spread_by_their_elevations() -> None:
    elevations = np.radians([-30.0, 0.0, 45.0, 89.0])
    forward, up = np.array([[0.8, 0.6, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    ranges = RayCaster(WALL).ranges(Fans(np.zeros((1, 3)), forward, up, elevations))
    assert ranges[0, :3] == pytest.approx(5.0 / np.cos(elevations[:3]))
    assert ranges[0, 3] == math.inf


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
