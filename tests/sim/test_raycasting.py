from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.world import World

# One square wall of 10 m x 10 m at x = 4 m.
WALL = World(
    "wall",
    np.array([[4, -5, -5], [4, 5, -5], [4, 5, 5], [4, -5, 5]], dtype=np.float32),
    np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32),
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
)


def test_range_to_a_wall_is_its_distance() -> None:
    angle = math.radians(40.0)
    directions = np.array([[1.0, 0.0, 0.0], [math.cos(angle), math.sin(angle), 0.0]])
    ranges = RayCaster(WALL).ranges(np.array([1.0, 0.0, 0.0]), directions)
    assert ranges == pytest.approx([3.0, 3.0 / math.cos(angle)], rel=1e-5)


def test_range_is_infinite_where_there_is_nothing() -> None:
    directions = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.all(np.isinf(RayCaster(WALL).ranges(np.zeros(3), directions)))


def test_clearance_is_the_distance_to_the_nearest_surface() -> None:
    points = np.array([[1.0, 0.0, 0.0], [7.0, 9.0, 0.0]])
    assert RayCaster(WALL).clearances(points) == pytest.approx([3.0, 5.0], rel=1e-5)
