"""AAM: decides from the overlap of observations alone where one area ends and the next begins.

References:
    Blanco et al. 2008, section IV-A and Fig. 5 (bisection of the auxiliary graph of observations).
    Shi and Malik, Normalized cuts and image segmentation, PAMI 2000, Eq. (2) (the cost of a cut).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from hmt_service.core.geometry import FloatArray
from hmt_service.errors import InvalidInput

Cells = npt.NDArray[np.int64]
"""Sorted identifiers of the cells that one keyframe's returns fall into, shape (C,)."""

_CELL_BITS = 21


@dataclass(frozen=True, slots=True)
class Split:
    """A border between two areas."""

    first_of_new: int
    """Index of the first keyframe of the more recent part."""
    cut: float
    """Normalized cut of the border, in [0, 2]."""


def cells_of(points: FloatArray, cell_size_m: float) -> Cells:
    """Return the cells that hold at least one of the points, shape (C,).

    Args:
        points: Points in the frame of the area, shape (N, 3), m, within 10^6 cells of its origin.
        cell_size_m: Edge of a cell.
    """
    return np.unique(cell_of_each(points, cell_size_m))


def cell_of_each(points: FloatArray, cell_size_m: float) -> npt.NDArray[np.int64]:
    """Return the cell of each point, shape (N,); see `cells_of`."""
    cells = np.floor(points / cell_size_m).astype(np.int64) + (1 << (_CELL_BITS - 1))
    return np.asarray((cells[:, 0] << 2 * _CELL_BITS) | (cells[:, 1] << _CELL_BITS) | cells[:, 2])


def overlap_of(cells: Sequence[Cells]) -> FloatArray:
    """Return the pairwise share of cells in common, symmetrised, shape (K, K), in [0, 1].

    All pairs at once: with the sparse keyframe-by-cell matrix B, the shared cells are `B @ B.T`.
    """
    sizes = np.array([len(own) for own in cells])
    known, columns = np.unique(np.concatenate(cells), return_inverse=True)
    rows = np.repeat(np.arange(len(cells)), sizes)
    membership = csr_array(
        (np.ones(len(columns)), (rows, columns.ravel())), shape=(len(cells), len(known))
    )
    shared = (membership @ membership.T).toarray()
    sizes = np.maximum(sizes, 1)
    return np.asarray(0.5 * (shared / sizes[:, None] + shared / sizes[None, :]))


def partition(overlap: FloatArray, *, max_cut: float, min_keyframes: int) -> Split | None:
    """Return the cheapest border through one area.

    Only contiguous cuts can be a border (the new area is the most recent part), and of these there
    are K - 1: the cheapest is found exactly, where the Fiedler vector of the whole graph would give
    an approximation of a cut that need not be contiguous.

    Args:
        overlap: Pairwise keyframe overlap in [0, 1], symmetric, in time order, shape (K, K),
            K >= 2.
        max_cut: Largest normalized cut accepted as a border, in [0, 2].
        min_keyframes: Fewest keyframes on either side.

    Returns:
        The split, or None when every cut costs more than `max_cut`.

    Raises:
        InvalidInput: If `overlap` is not square or not symmetric.
    """
    if overlap.ndim != 2 or overlap.shape[0] != overlap.shape[1]:
        raise InvalidInput(f"overlap of shape {overlap.shape} is not square")
    if not np.allclose(overlap, overlap.T):
        raise InvalidInput("overlap is not symmetric")
    count = len(overlap)
    if count < 2 * min_keyframes:
        return None
    weights = overlap - np.diag(np.diag(overlap))
    degree = weights.sum(axis=1)
    # inside[k]: total weight among the first k keyframes, both directions.
    inside = np.concatenate([[0.0], np.cumsum(2.0 * np.tril(weights, -1).sum(axis=1))])
    association = np.concatenate([[0.0], np.cumsum(degree)])
    borders = np.arange(min_keyframes, count - min_keyframes + 1)
    across = association[borders] - inside[borders]
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = across / association[borders] + across / (association[-1] - association[borders])
    cuts = np.where(across <= 0.0, 0.0, cuts)
    best = int(np.argmin(cuts))
    if cuts[best] > max_cut:
        return None
    return Split(int(borders[best]), float(cuts[best]))
