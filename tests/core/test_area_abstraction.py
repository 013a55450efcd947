"""Overlap and borders, with sets and an exhaustive search as judges."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.area_abstraction import Cells, cells_of, overlap_of, partition
from hmt_service.core.geometry import FloatArray
from hmt_service.errors import InvalidInput


def normalized_cut(overlap: FloatArray, first_of_new: int) -> float:
    """Return Shi and Malik's normalized cut, by its definition."""
    count = len(overlap)
    old, new = range(first_of_new), range(first_of_new, count)

    def total(a: range, b: range) -> float:
        return float(sum(overlap[i, j] for i in a for j in b if i != j))

    across = total(old, new)
    if across <= 0.0:
        return 0.0
    everything = range(count)
    return across / total(old, everything) + across / total(new, everything)


@st.composite
def overlaps(draw: st.DrawFn) -> FloatArray:
    count = draw(st.integers(2, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    matrix = rng.uniform(0.0, 1.0, (count, count)) * rng.integers(0, 2, (count, count))
    return np.asarray(0.5 * (matrix + matrix.T))


def test_cells_are_those_that_hold_a_point() -> None:
    points = np.array([[0.1, 0.1, 0.0], [0.3, 0.1, 0.0], [-0.1, 0.1, 0.0], [0.1, 0.9, 0.0]])
    # The first two share a cell; the third is across the origin.
    assert len(cells_of(points, 0.4)) == 3
    assert len(cells_of(points, 0.15)) == 4
    assert len(cells_of(np.zeros((0, 3)), 0.4)) == 0


@given(seed=st.integers(0, 2**32 - 1), cell_m=st.floats(0.05, 3.0))
def test_cells_are_as_many_as_a_set_of_triples_has(seed: int, cell_m: float) -> None:
    points = np.random.default_rng(seed).uniform(-20.0, 20.0, (50, 3))
    judge = {tuple(np.floor(point / cell_m)) for point in points}
    cells = cells_of(points, cell_m)
    assert len(cells) == len(judge)
    assert np.all(np.diff(cells) > 0)


@given(st.lists(st.sets(st.integers(0, 2**62), max_size=12), min_size=1, max_size=6))
def test_overlap_is_the_mean_share_of_cells_in_common(seen: list[set[int]]) -> None:
    cells: list[Cells] = [np.array(sorted(own), dtype=np.int64) for own in seen]
    expected = [
        [0.5 * (len(a & b) / max(len(a), 1) + len(a & b) / max(len(b), 1)) for b in seen]
        for a in seen
    ]
    assert overlap_of(cells) == pytest.approx(np.array(expected))


@given(
    overlap=overlaps(),
    min_keyframes=st.integers(1, 4),
    max_cut=st.floats(0.0, 2.0),
)
def test_border_is_the_cheapest_of_all_contiguous_cuts(
    overlap: FloatArray, min_keyframes: int, max_cut: float
) -> None:
    borders = range(min_keyframes, len(overlap) - min_keyframes + 1)
    judged = {border: normalized_cut(overlap, border) for border in borders}
    split = partition(overlap, max_cut=max_cut, min_keyframes=min_keyframes)
    if split is None:
        assert not judged or min(judged.values()) > max_cut - 1e-9
        return
    assert split.first_of_new in judged
    assert split.cut == pytest.approx(judged[split.first_of_new], abs=1e-9)
    assert split.cut == pytest.approx(min(judged.values()), abs=1e-9)
    assert split.cut <= max_cut


@pytest.mark.parametrize("first_of_new", [3, 5, 6])
def test_border_of_two_separate_places_lies_exactly_between_them(first_of_new: int) -> None:
    overlap = np.zeros((9, 9))
    overlap[:first_of_new, :first_of_new] = 0.5
    overlap[first_of_new:, first_of_new:] = 0.5
    split = partition(overlap, max_cut=0.1, min_keyframes=3)
    assert split is not None
    assert (split.first_of_new, split.cut) == (first_of_new, 0.0)


def test_one_place_has_no_border() -> None:
    assert partition(np.ones((20, 20)), max_cut=0.9, min_keyframes=2) is None


@pytest.mark.parametrize(("count", "has_border"), [(7, False), (8, True)])
def test_border_needs_enough_keyframes_on_both_sides(count: int, has_border: bool) -> None:
    split = partition(np.eye(count), max_cut=2.0, min_keyframes=4)
    assert (split is not None) == has_border


@pytest.mark.parametrize("shape", [(3,), (3, 4), (2, 2, 2)])
def test_overlap_that_is_not_square_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(InvalidInput, match=r"\(.*\) is not square"):
        partition(np.ones(shape), max_cut=1.0, min_keyframes=2)


def test_overlap_that_is_not_symmetric_is_refused() -> None:
    with pytest.raises(InvalidInput, match="not symmetric"):
        partition(np.array([[1.0, 0.2], [0.3, 1.0]]), max_cut=1.0, min_keyframes=1)
