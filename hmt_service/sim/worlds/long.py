"""As many areas as wanted, one behind the other, to measure how cost grows.

References:
    own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.worlds.plan import (
    CEILING_M,
    CLEARANCE_M,
    WALL_M,
    Box,
    Mesh,
    ceiling,
    floor,
    joined,
    mesh_between,
    mesh_of,
    on_floor,
    wall_along_x,
    wall_along_y,
)
from hmt_service.sim.worlds.world import World

_DEPTH_M = 5.0
"""From row to row."""
_LENGTHS_M = (5.0, 8.0)
"""Of areas along their row."""
_SHIFT_M = 0.6
"""A partition or a door is at most so far from its usual place."""
_DOOR_M = 1.2
_SLOTS = 3
"""Places for furniture along one wall of a room."""
_LOOP_AREAS = (3, 12)
"""A loop reaches so many areas back from the end of a row."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """Areas in the order of the route, which runs to and fro along rows."""

    columns: FloatArray
    """Borders of the columns, x, shape (C + 1,)."""
    partitions: FloatArray
    """Walls between the areas of each row, x, shape (R, C + 1)."""
    row: npt.NDArray[np.int64]
    """Of each area, shape (N,)."""
    column: npt.NDArray[np.int64]
    """Of each area, shape (N,)."""
    turns: npt.NDArray[np.int64]
    """First area of each row but the first; the area before it lies beside it."""
    loops: npt.NDArray[np.int64]
    """Areas from which the route looks back into the row before, at most one per row."""

    @property
    def x(self) -> FloatArray:
        """Middle of each area's column, shape (N,)."""
        return np.asarray((self.columns[:-1] + self.columns[1:]) / 2)[self.column]

    @property
    def y(self) -> FloatArray:
        """Middle of each area's row, shape (N,)."""
        return _DEPTH_M * self.row.astype(np.float64)

    @property
    def left(self) -> FloatArray:
        """Western wall of each area, x, shape (N,)."""
        return self.partitions[self.row, self.column]

    @property
    def right(self) -> FloatArray:
        """Eastern wall of each area, x, shape (N,)."""
        return self.partitions[self.row, self.column + 1]

    @property
    def is_eastward(self) -> npt.NDArray[np.bool_]:
        """Whether the route runs east through each area, shape (N,)."""
        return np.asarray(self.row % 2 == 0)

    @property
    def seen_in_loops(self) -> npt.NDArray[np.int64]:
        """Area beside each of `loops` in the row before."""
        length = len(self.columns) - 1
        return 2 * length * self.row[self.loops] - 1 - self.loops


def long(seed: int, areas: int = 100) -> World:
    """Draw rooms and stretches of corridor in rows, each entered from the one before.

    The route runs to and fro along the rows, 7.0 m to 7.8 m per area of 100 or more. Soon after
    the beginning of each row it looks through a door into an area of the row before: a loop of
    40 m to 190 m.

    Args:
        seed: The same seed gives the same world.
        areas: Number of areas, 1 or more; each takes about 1.3 kB.
    """
    rng = np.random.default_rng(seed)
    rows = _laid_out(areas, rng)
    # Between an area and the next; where a row ends, the door is in the other wall.
    door_y = rng.uniform(-_SHIFT_M, _SHIFT_M, areas + 1)
    door_y[[0, *rows.turns, -1]] = 0.0
    ground = Box(0.0, -_DEPTH_M / 2, float(rows.columns[-1]), float(rows.y[-1]) + _DEPTH_M / 2)
    shell = [floor(ground), ceiling(ground), *_walls_between_rows(rows, ground)]
    shell += [wall_along_y(x, ground.y_min, ground.y_max) for x in (ground.x_min, ground.x_max)]
    mesh = joined([mesh_of(shell), _partitions(rows, door_y), _furnished(rows, rng)])
    return World(f"long-{seed}", mesh.vertices, mesh.triangles, _route(rows, door_y))


def _laid_out(areas: int, rng: np.random.Generator) -> _Rows:
    """Draw how many areas there are in a row, and how long each is."""
    length = math.ceil(math.sqrt(areas))
    row, place = np.divmod(np.arange(areas), length)
    column = np.where(row % 2 == 0, place, length - 1 - place)
    columns = np.concatenate([[0.0], np.cumsum(rng.uniform(*_LENGTHS_M, length))])
    partitions = columns + rng.uniform(-_SHIFT_M, _SHIFT_M, (row[-1] + 1, length + 1))
    partitions[:, [0, -1]] = columns[[0, -1]]
    turns = np.arange(length, areas, length)
    nearest, farthest = _LOOP_AREAS
    loops = turns[:0]
    if length > nearest:
        loops = turns + rng.integers(nearest, min(farthest, length - 1) + 1, len(turns))
    return _Rows(columns, partitions, row, column, turns, loops[loops < areas])


def _route(rows: _Rows, door_y: FloatArray) -> FloatArray:
    """Return the way from door to door, by the middle of each area, shape (W, 3), m."""
    x, y = rows.x, rows.y
    looked_at = y.copy() + door_y[:-1]
    looked_at[rows.loops] = y[rows.loops] - _DEPTH_M
    stops = np.stack([y + door_y[:-1], looked_at, y + door_y[1:]], axis=1)
    inside = np.stack([np.broadcast_to(x[:, None], stops.shape), stops], axis=2).reshape(-1, 2)
    start = rows.left[0] + _DOOR_M, y[0]
    end = (rows.right[-1] - _DOOR_M if rows.is_eastward[-1] else rows.left[-1] + _DOOR_M), y[-1]
    return on_floor(np.vstack([start, inside, end]))


def _walls_between_rows(rows: _Rows, ground: Box) -> list[Box]:
    """Return the walls along x, with doors where the route goes from row to row."""
    ends = np.concatenate([rows.turns, rows.loops])
    doors = np.column_stack([rows.x[ends] - _DOOR_M / 2, rows.x[ends] + _DOOR_M / 2])
    walls = []
    for number in range(len(rows.partitions) + 1):
        gaps = np.sort(doors[rows.row[ends] == number].ravel())
        pieces = np.concatenate([[ground.x_min], gaps, [ground.x_max]]).reshape(-1, 2)
        y = (number - 0.5) * _DEPTH_M
        walls += [wall_along_x(x_min, x_max, y) for x_min, x_max in pieces.tolist()]
    return walls


def _partitions(rows: _Rows, door_y: FloatArray) -> Mesh:
    """Return the walls along y: one with a door at the end of each area, the last without."""
    x = np.where(rows.is_eastward, rows.right, rows.left)
    half = _DEPTH_M / 2
    south = np.column_stack([rows.y - half, rows.y + door_y[1:] - _DOOR_M / 2])
    north = np.column_stack([rows.y + door_y[1:] + _DOOR_M / 2, rows.y + half])
    south[-1, 1] = north[-1, 0] = rows.y[-1]
    has_wall = np.ones(len(x), dtype=bool)
    has_wall[rows.turns - 1] = False
    y = np.concatenate([south[has_wall], north[has_wall]])
    x = np.tile(x[has_wall], 2)
    zero = np.zeros(len(x))
    return mesh_between(
        np.column_stack([x - WALL_M / 2, y[:, 0], zero]),
        np.column_stack([x + WALL_M / 2, y[:, 1], zero + CEILING_M]),
    )


def _furnished(rows: _Rows, rng: np.random.Generator) -> Mesh:
    """Draw cupboards along the southern and northern wall of each area, or a narrow corridor."""
    shape = len(rows.row), 2, _SLOTS
    begins = (np.arange(_SLOTS) + rng.uniform(0.0, 0.3, shape)) / _SLOTS
    ends = (np.arange(_SLOTS) + rng.uniform(0.6, 1.0, shape)) / _SLOTS
    depth, height = rng.uniform(0.25, 0.95, shape), rng.uniform(0.7, 2.0, shape)
    is_there = rng.random(shape) < 0.65
    is_corridor = rng.random(shape[0]) < 0.3
    has_side_door = np.zeros(shape[:2], dtype=bool)
    has_side_door[np.concatenate([rows.turns, rows.loops]), 0] = True
    has_side_door[np.concatenate([rows.turns - 1, rows.seen_in_loops]), 1] = True

    # In a corridor, the first of the cupboards is as long and as high as the wall.
    is_corridor &= ~has_side_door.any(axis=1)
    begins[is_corridor, :, 0], ends[is_corridor, :, 0] = 0.0, 1.0
    depth[is_corridor], height[is_corridor] = (
        rng.uniform(0.6, 1.0, (is_corridor.sum(), 1, 1)),
        CEILING_M,
    )
    is_there[is_corridor] = (True, False, False)

    left, right = (x[:, None, None] for x in (rows.left + WALL_M / 2, rows.right - WALL_M / 2))
    x_min, x_max = left + begins * (right - left), left + ends * (right - left)
    x = rows.x[:, None, None]
    is_in_way = (x_min < x + CLEARANCE_M) & (x_max > x - CLEARANCE_M) & has_side_door[:, :, None]
    is_there &= ~is_in_way
    wall = (_DEPTH_M - WALL_M) / 2
    is_south = np.array([True, False])[:, None]
    y = rows.y[:, None, None]
    y_min, y_max = np.where(is_south, -wall, wall - depth), np.where(is_south, depth - wall, wall)
    low = np.stack([x_min, y + y_min, np.zeros(shape)], axis=-1)
    high = np.stack([x_max, y + y_max, height], axis=-1)
    return mesh_between(low[is_there], high[is_there])
