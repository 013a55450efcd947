from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.plan import (
    CEILING_M,
    Box,
    Mesh,
    ceiling,
    floor,
    furniture,
    interior,
    joined,
    lanes,
    mesh_of,
    on_floor,
    parked_car,
    placed,
    walls_around,
)


def segments(walls: Mesh) -> set[tuple[tuple[float, float], ...]]:
    """Return the ends of each wall as seen from above, sorted."""
    corners = walls.vertices.reshape(-1, 4, 3)
    assert np.array_equal(corners[:, :2, 2], np.zeros((len(corners), 2)))
    assert np.array_equal(corners[:, 2:, :2], corners[:, 1::-1, :2])
    return {tuple(sorted((x, y) for x, y in ends)) for ends in corners[:, :2, :2].tolist()}


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]].astype(float) for corner in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def test_box_turns_counter_clockwise_before_it_is_shifted() -> None:
    box = Box(1.0, 0.0, 3.0, 1.0, 2.0)
    assert box.moved(10.0, 20.0) == Box(11.0, 20.0, 13.0, 21.0, 2.0)
    assert box.moved(0.0, 0.0, 1) == Box(-1.0, 1.0, 0.0, 3.0, 2.0)
    assert box.moved(0.0, 0.0, 2) == Box(-3.0, -1.0, -1.0, 0.0, 2.0)
    assert box.moved(0.0, 0.0, -1, z=5.0) == Box(0.0, -3.0, 1.0, -1.0, 2.0, 5.0)


def test_boxes_that_only_touch_do_not_overlap() -> None:
    box = Box(0.0, 0.0, 1.0, 1.0)
    assert not box.overlaps(Box(1.0, 0.0, 2.0, 1.0))
    assert box.overlaps(Box(0.9, 0.9, 2.0, 2.0))
    assert box.overlaps(Box(1.0, 0.0, 2.0, 1.0).grown(0.1))


def test_floor_and_ceiling_end_at_their_heights() -> None:
    room = Box(0.0, 0.0, 4.0, 3.0)
    under, over = (mesh_of([slab]).vertices[:, 2] for slab in (floor(room, 3.0), ceiling(room)))
    assert under.max() == 3.0
    assert over.min() == CEILING_M


def test_mesh_of_a_box_is_its_surface() -> None:
    mesh = mesh_of([Box(1.0, 2.0, 3.0, 5.0, 4.0, 0.5)])
    assert mesh.vertices.min(axis=0).tolist() == [1.0, 2.0, 0.5]
    assert mesh.vertices.max(axis=0).tolist() == [3.0, 5.0, 4.5]
    assert area(mesh) == pytest.approx(2 * (2 * 3 + 2 * 4 + 3 * 4))


def test_lanes_hold_the_ground_beside_each_leg() -> None:
    route = [(0.0, 0.0), (4.0, 0.0), (4.0, -3.0)]
    assert lanes(route, 0.5) == [Box(-0.5, -0.5, 4.5, 0.5), Box(3.5, -3.5, 4.5, 0.5)]


def test_repeated_waypoints_are_left_out() -> None:
    route = on_floor([(0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (1.0, 0.0), (0.0, 0.0)])
    assert route.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]


def test_walls_of_one_room_are_its_four_sides() -> None:
    walls = walls_around([Box(0.0, 0.0, 4.0, 3.0)], 2.0)
    assert segments(walls) == {
        ((0.0, 0.0), (4.0, 0.0)),
        ((0.0, 3.0), (4.0, 3.0)),
        ((0.0, 0.0), (0.0, 3.0)),
        ((4.0, 0.0), (4.0, 3.0)),
    }
    assert area(walls) == pytest.approx(2.0 * 14.0)


def test_doorway_opens_the_walls_of_two_rooms() -> None:
    rooms = [Box(0.0, 0.0, 4.0, 4.0), Box(5.0, 0.0, 9.0, 4.0), Box(3.5, 1.0, 5.5, 2.0)]
    found = segments(walls_around(rooms))
    assert {((4.0, 0.0), (4.0, 1.0)), ((4.0, 2.0), (4.0, 4.0))} <= found
    assert {((5.0, 0.0), (5.0, 1.0)), ((5.0, 2.0), (5.0, 4.0))} <= found
    assert {((4.0, 1.0), (5.0, 1.0)), ((4.0, 2.0), (5.0, 2.0))} <= found
    assert len(found) == 6 + 6


def test_walls_enclose_what_any_two_free_rectangles_share() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        corners = np.sort(rng.integers(0, 12, (4, 2, 2)), axis=1)
        corners[:, 1] += 1
        free = [Box(*low, *high) for low, high in corners.astype(float).tolist()]
        cells = np.zeros((14, 14), dtype=int)
        for (x0, y0), (x1, y1) in corners.tolist():
            cells[x0 + 1 : x1 + 1, y0 + 1 : y1 + 1] = 1
        border = np.abs(np.diff(cells, axis=0)).sum() + np.abs(np.diff(cells, axis=1)).sum()
        assert area(walls_around(free, 1.0)) == pytest.approx(border)


def test_open_walls_leave_out_the_rectangle_around() -> None:
    # A house of 2 m x 1 m in the middle of a yard.
    yard = [
        Box(0.0, 0.0, 6.0, 2.0),
        Box(0.0, 3.0, 6.0, 5.0),
        Box(0.0, 0.0, 2.0, 5.0),
        Box(4.0, 0.0, 6.0, 5.0),
    ]
    assert area(walls_around(yard, 1.0, is_open=True)) == pytest.approx(6.0)


def test_interior_closes_floor_and_ceiling() -> None:
    mesh = interior([Box(0.0, 0.0, 4.0, 3.0)], [Box(1.0, 1.0, 2.0, 2.0, 0.5)], 2.4)
    assert mesh.vertices[:, 2].min() < 0.0
    assert mesh.vertices[:, 2].max() > 2.4
    assert np.array_equal(np.unique(mesh.triangles), np.arange(len(mesh.vertices)))


def test_joined_meshes_keep_their_triangles() -> None:
    one, other = mesh_of([Box(0.0, 0.0, 1.0, 1.0)]), mesh_of([Box(5.0, 5.0, 7.0, 6.0)])
    both = joined([one, other, one])
    corners = both.vertices[both.triangles]
    assert np.array_equal(corners[12:24], other.vertices[other.triangles])
    assert np.array_equal(corners[24:], one.vertices[one.triangles])


def test_placed_mesh_is_turned_then_shifted() -> None:
    mesh = placed(mesh_of([Box(0.0, 0.0, 2.0, 1.0)]), 10.0, 20.0, 3.0, math.pi / 2)
    assert mesh.vertices.min(axis=0) == pytest.approx([9.0, 20.0, 3.0])
    assert mesh.vertices.max(axis=0) == pytest.approx([10.0, 22.0, 3.0 + CEILING_M])


@pytest.mark.parametrize("seed", range(20))
def test_furniture_stands_apart_inside_the_room(seed: int) -> None:
    room, kept_free = Box(0.0, 0.0, 5.0, 4.0), [Box(2.0, 0.0, 3.0, 3.0)]
    pieces = furniture(room, kept_free, 8, np.random.default_rng(seed))
    assert 3 <= len(pieces) <= 8
    for index, piece in enumerate(pieces):
        assert piece.x_min >= room.x_min
        assert piece.y_min >= room.y_min
        assert piece.x_max <= room.x_max + 1e-9
        assert piece.y_max <= room.y_max + 1e-9
        assert not any(piece.overlaps(other) for other in [*kept_free, *pieces[:index]])


def test_furniture_never_reaches_out_of_a_room_that_is_smaller() -> None:
    closet = Box(0.0, 0.0, 0.6, 0.6)
    for seed in range(20):
        for piece in furniture(closet, [], 5, np.random.default_rng(seed)):
            assert closet.grown(1e-9).x_max >= piece.x_max
            assert closet.grown(1e-9).y_max >= piece.y_max


def test_parked_car_is_as_long_and_wide_as_asked() -> None:
    body, cabin = parked_car(4.4, 1.8)
    size: FloatArray = np.array([body.x_max - body.x_min, body.y_max - body.y_min])
    assert size == pytest.approx([4.4, 1.8])
    assert cabin.base == body.height
