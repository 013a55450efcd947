"""Correlation of two bird's-eye views over all shifts and turns of a region, by branch and bound.

A block of shifts can score no more than the view from above with each cell as high as the highest
of its block. Blocks that cannot reach what is asked for are not looked into, so that a place that
is another one costs little; what is found is what an exhaustive search finds.

References:
    Olson, Real-time correlative scan matching, ICRA 2009 (scores on a raster, all turns).
    Hess et al., Real-time loop closure in 2D LIDAR SLAM, ICRA 2016, section V (branch and bound).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit
from scipy import ndimage

from hmt_service.core.geometry import FloatArray

_Heights = npt.NDArray[np.uint8]
_Scores = npt.NDArray[np.float32]
_Cells = npt.NDArray[np.int64]

# A point is worth so much in its own cell, and less beside it: the raster is not the world's.
_BLUR_CELLS, _BLUR_GAIN = 0.7, 3.0
_FULL = 255
# The largest blocks have 2 to this power cells on each side.
_LEVELS = 4
# A wall is another one from its other side: views are kept apart by so many directions about the
# vertical, and one for what lies flat.
_SIDES = 8
# A direction belongs to all sides that it is no farther from than this: what is up to 45 degrees
# from another always agrees with it, what is over 90 degrees never does.
_SIDE_RAD = 1.5 * 2.0 * np.pi / _SIDES
_FLAT = 0.5


@dataclass(frozen=True, slots=True)
class Raster:
    """How finely a region is searched, and what is a peak of its own."""

    step_rad: float
    """Step between turns."""
    least: float
    """Lowest score that counts."""
    peak_share: float
    """The same over the highest score."""
    separation_m: float
    """Of peaks no farther apart than this, and no farther turned, only the highest counts."""
    separation_rad: float
    """The turn of that."""
    most: int
    """Largest number of peaks."""


@dataclass(frozen=True, slots=True, eq=False)
class Peak:
    """Where points agree with a view better than anywhere near."""

    yaw: float
    """How the points are turned, rad."""
    position: FloatArray
    """Where their origin is, shape (2,), m."""
    score: float
    """Mean height of the view where the points are, in [0, 1]."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Points seen from above, ready to be searched."""

    low: FloatArray
    """Corner of the first cell, shape (2,), m."""
    cell_m: float
    """Edge of a cell."""
    levels: _Heights
    """Highest of blocks of 1, 2, 4 ... cells that begin at a cell, of each side: 255 where points
    are, less beside them. Shape (L + 1, sides + 1, R, C), with a margin of one largest block."""

    @classmethod
    def of(cls, points: FloatArray, directions: FloatArray, *, cell_m: float) -> View:
        """Return the view of some points.

        Args:
            points: Shape (N, 3), m, N >= 1.
            directions: Unit vector of each point to the side that it was seen from, shape (N, 3).
            cell_m: Edge of a cell.
        """
        margin = (2**_LEVELS + 1) * cell_m
        low = points[:, :2].min(axis=0) - margin
        cells = ((points[:, :2] - low) / cell_m).astype(np.int64)
        heights = np.zeros((_SIDES + 1, *(cells.max(axis=0) + 2)), dtype=np.float32)
        for side, is_seen in enumerate(_sides_of(directions)):
            heights[side, cells[is_seen, 0], cells[is_seen, 1]] = 1.0
        blurred = _BLUR_GAIN * ndimage.gaussian_filter(heights, _BLUR_CELLS, axes=(1, 2))
        levels = [np.round(_FULL * np.minimum(blurred, 1.0)).astype(np.uint8)]
        for level in range(_LEVELS):
            half, last = 2**level, levels[-1]
            along = last.copy()
            np.maximum(last[:, :-half], last[:, half:], out=along[:, :-half])
            highest = along.copy()
            np.maximum(along[:, :, :-half], along[:, :, half:], out=highest[:, :, :-half])
            levels.append(highest)
        return cls(low, cell_m, np.stack(levels))

    def best_peaks(
        self,
        points: FloatArray,
        directions: FloatArray,
        *,
        middle: FloatArray,
        yaw: float,
        reach_m: float,
        reach_rad: float,
        raster: Raster,
    ) -> list[Peak]:
        """Return the best ways to lay points over the view.

        Args:
            points: What is laid, shape (N, 3), m; their heights do not count.
            directions: The side that each was seen from, shape (N, 3).
            middle: Where the points' origin is expected, shape (2,), m.
            yaw: How they are expected to be turned, rad.
            reach_m: How far from the middle the origin may be.
            reach_rad: How far to either side the points may be turned.
            raster: How finely to search.

        Returns:
            Separate local maxima, the best first; of equal ones the first turn, then the lowest
            cell.
        """
        # Turns are on a fixed raster, as shifts are: who asks for a place again finds the same.
        least, most = (np.array([-reach_rad, reach_rad]) + yaw) / raster.step_rad
        turns = np.arange(np.floor(least), np.ceil(most) + 1.0)
        yaws = raster.step_rad * turns[: int(np.ceil(2.0 * np.pi / raster.step_rad))]
        extent = int(np.ceil(np.linalg.norm(points[:, :2], axis=1).max() / self.cell_m)) + 1
        # Shifts in cells: the origin of the points goes to the middle of the cell.
        centre = (middle - self.low) / self.cell_m - 0.5
        reach = reach_m / self.cell_m + 1.0
        first = np.maximum(np.ceil(centre - reach).astype(np.int64), -extent)
        end = np.array(self.levels.shape[2:]) + extent
        last = np.minimum(np.floor(centre + reach).astype(np.int64), end)
        if np.any(last < first):
            return []
        # Pages of zeros that nothing is written to take no memory.
        scores = np.zeros((len(yaws), *(last - first + 1)), dtype=np.float32)
        cells = _search(
            self.levels,
            points / self.cell_m,
            directions,
            yaws,
            first,
            centre - first,
            reach,
            raster.least,
            raster.peak_share,
            scores,
        )
        apart = np.array(
            [raster.separation_rad / raster.step_rad, *[raster.separation_m / self.cell_m] * 2]
        )
        peaks = _separate(scores, cells, raster.peak_share, apart, raster.most)
        return [
            Peak(
                float(yaws[cell[0]]),
                self.low + (first + cell[1:] + 0.5) * self.cell_m,
                float(scores[tuple(cell)]),
            )
            for cell in peaks
        ]


def _sides_of(directions: FloatArray) -> list[npt.NDArray[np.bool_]]:
    """Return for each side which directions belong to it, each of shape (N,)."""
    is_flat = np.hypot(directions[:, 0], directions[:, 1]) < _FLAT
    yaws = np.arctan2(directions[:, 1], directions[:, 0])
    gaps = yaws - 2.0 * np.pi / _SIDES * np.arange(_SIDES)[:, None]
    is_near = np.abs(np.arctan2(np.sin(gaps), np.cos(gaps))) <= _SIDE_RAD
    return [*(is_near & ~is_flat), is_flat]


@njit(cache=True)
def _search(
    levels: _Heights,
    points: FloatArray,
    directions: FloatArray,
    yaws: FloatArray,
    first: _Cells,
    centre: FloatArray,
    reach: float,
    least: float,
    peak_share: float,
    scores: _Scores,
) -> _Cells:
    """Fill in all scores that count, and return where they are, shape (N, 3).

    Args:
        levels: Heights of blocks of 1, 2, 4 ... cells of each side, shape (L + 1, S + 1, R, C).
        points: What is laid over them, shape (N, 3), in cells.
        directions: The side that each was seen from, shape (N, 3).
        yaws: Turns, shape (T,), rad.
        first: Lowest shift, shape (2,), in cells.
        centre: Middle of the region from there, shape (2,), in cells.
        reach: Radius of the region in cells.
        least: Lowest score that counts.
        peak_share: The same over the highest score of all.
        scores: Zeros, shape (T, R, C): one per turn and shift.
    """
    top = len(levels) - 1
    turns, rows, columns = scores.shape
    stamps = np.empty((turns, len(points), 3), np.int64)
    counts = np.empty(turns, np.int64)
    down, across = (rows >> top) + 1, (columns >> top) + 1
    bounds = np.empty((turns, down, across))
    for turn in range(turns):
        counts[turn] = _stamp(points, directions, yaws[turn], stamps[turn])
        for i in range(down):
            for j in range(across):
                row, column = first[0] + (i << top), first[1] + (j << top)
                bounds[turn, i, j] = _score(levels[top], stamps[turn, : counts[turn]], row, column)
    found = []
    limit = least
    # Of each level three blocks wait at most while the fourth is looked into.
    stack, heights = np.empty((4 * top + 4, 3), np.int64), np.empty(4 * top + 4)
    for index in np.argsort(-bounds.ravel(), kind="mergesort"):
        turn, block = index // (down * across), index % (down * across)
        stack[0] = top, block // across << top, block % across << top
        heights[0] = bounds.ravel()[index]
        depth = 1
        while depth > 0:
            depth -= 1
            level, row, column = stack[depth]
            if heights[depth] < limit:
                continue
            if level > 0:
                depth = _push_parts(
                    levels[level - 1],
                    stamps[turn, : counts[turn]],
                    first,
                    centre,
                    reach,
                    limit,
                    scores.shape,
                    stack,
                    heights,
                    depth,
                )
                continue
            scores[turn, row, column] = heights[depth]
            found.append((turn, row, column))
            limit = max(limit, peak_share * heights[depth])
    cells = np.empty((len(found), 3), np.int64)
    for i, (turn, row, column) in enumerate(found):
        cells[i, 0], cells[i, 1], cells[i, 2] = turn, row, column
    return cells


@njit(cache=True)
def _push_parts(
    heights: _Heights,
    stamp: _Cells,
    first: _Cells,
    centre: FloatArray,
    reach: float,
    limit: float,
    shape: tuple[int, int, int],
    stack: _Cells,
    bounds: FloatArray,
    depth: int,
) -> int:
    """Put the quarters of a block that may hold what counts on the stack, the highest last.

    Returns:
        The new depth of the stack; the block itself is taken off it.
    """
    level, row, column = stack[depth]
    half = 1 << (level - 1)
    bottom = depth
    for part in range(4):
        at_row, at_column = row + (part >> 1) * half, column + (part & 1) * half
        # The cell of the part that is nearest to the middle must be in the region.
        off_row = max(at_row - centre[0], 0.0, centre[0] - (at_row + half - 1))
        off_column = max(at_column - centre[1], 0.0, centre[1] - (at_column + half - 1))
        is_there = at_row < shape[1] and at_column < shape[2]
        if not is_there or off_row**2 + off_column**2 > reach**2:
            continue
        bound = _score(heights, stamp, first[0] + at_row, first[1] + at_column)
        if bound < limit:
            continue
        place = depth
        while place > bottom and bounds[place - 1] > bound:
            bounds[place] = bounds[place - 1]
            stack[place] = stack[place - 1]
            place -= 1
        bounds[place] = bound
        stack[place] = level - 1, at_row, at_column
        depth += 1
    return depth


@njit(cache=True)
def _stamp(points: FloatArray, directions: FloatArray, yaw: float, stamp: _Cells) -> int:
    """Fill in side and cell of turned points, each once, and return their number."""
    c, s = math.cos(yaw), math.sin(yaw)
    seen = set()
    count = 0
    for i in range(len(points)):
        x, y, u, v = points[i, 0], points[i, 1], directions[i, 0], directions[i, 1]
        side = _SIDES
        if u * u + v * v >= _FLAT**2:
            side = round((math.atan2(v, u) + yaw) * (_SIDES / (2.0 * math.pi))) % _SIDES
        row, column = round(c * x - s * y), round(s * x + c * y)
        key = (((row + (1 << 24)) << 25) + column + (1 << 24)) * (_SIDES + 1) + side
        if key not in seen:
            seen.add(key)
            stamp[count] = side, row, column
            count += 1
    return count


@njit(cache=True)
def _score(heights: _Heights, stamp: _Cells, row: int, column: int) -> float:
    """Return the mean height of the cells of a stamp that is put somewhere."""
    total = 0
    _, rows, columns = heights.shape
    for i in range(len(stamp)):
        at_row, at_column = row + stamp[i, 1], column + stamp[i, 2]
        if 0 <= at_row < rows and 0 <= at_column < columns:
            total += heights[stamp[i, 0], at_row, at_column]
    return total / (_FULL * len(stamp))


def _separate(
    scores: _Scores, cells: _Cells, peak_share: float, apart: FloatArray, most: int
) -> list[_Cells]:
    """Return the cells of a grid that no neighbour exceeds, the highest first.

    Args:
        scores: Grid, shape (T, R, C).
        cells: Those that may be peaks, shape (N, 3).
        peak_share: Lowest peak that counts, over the highest.
        apart: Distance along each axis, in cells, within which only the highest peak is kept.
        most: Most peaks returned.
    """
    if not len(cells):
        return []
    # Of equal heights the first in the order of the grid.
    cells = cells[np.lexsort((*cells.T[::-1], -scores[tuple(cells.T)]))]
    heights = scores[tuple(cells.T)]
    is_peak = heights >= peak_share * heights[0]
    limit = np.array(scores.shape) - 1
    for step in itertools.product((-1, 0, 1), repeat=3):
        is_peak &= heights >= scores[tuple(np.clip(cells + step, 0, limit).T)]
    cells = cells[is_peak]
    peaks: list[_Cells] = []
    while len(cells) and len(peaks) < most:
        peaks.append(cells[0])
        cells = cells[np.any(np.abs(cells - cells[0]) > apart, axis=1)]
    return peaks


def compile_kernels() -> None:
    """Compile the search, or load it: not while a scan waits."""
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3))
    view = View.of(points, points, cell_m=0.1)
    raster = Raster(
        step_rad=0.1, least=0.1, peak_share=0.5, separation_m=0.5, separation_rad=0.1, most=1
    )
    view.best_peaks(
        points, points, middle=np.zeros(2), yaw=0.0, reach_m=0.5, reach_rad=0.1, raster=raster
    )
