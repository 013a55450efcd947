"""Figure of a belief over time."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.image import imread

from hmt_service.core.types import Belief
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.viz.posterior import doubted_areas, draw_history

LOOP = (
    Belief(0.0, {14: 1.0}, 1.0),
    Belief(10.0, {14: 1.0}, 1.0),
    Belief(11.0, {15: 0.4, 1: 0.6}, 1.92),
    Belief(14.0, {15: 0.1, 1: 0.9}, 1.22),
    Belief(16.0, {1: 1.0}, 1.0),
    Belief(40.0, {1: 1.0}, 1.0),
)


def test_areas_in_doubt_are_shown() -> None:
    assert doubted_areas(LOOP) == [1, 15]
    assert doubted_areas(LOOP[:2]) == [14]
    many = [Belief(float(i), {i: 0.5, i + 1: 0.5}, 2.0) for i in range(30)]
    assert len(doubted_areas(many)) == 8


def test_one_panel_per_area_and_one_for_the_sample_size(tmp_path: Path) -> None:
    draw_history(LOOP, tmp_path / "two.png")
    draw_history(LOOP[:2], tmp_path / "one.png")
    two, one = (imread(tmp_path / name) for name in ("two.png", "one.png"))
    assert two.shape[0] > one.shape[0]
    # Filled: blue where an area had mass.
    assert ((two[..., 2] - two[..., 0]) > 0.2).sum() > 1000


def test_nothing_to_draw_and_no_place_to_draw_it_are_errors(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no belief"):
        draw_history((), tmp_path / "empty.png")
    with pytest.raises(InvalidInput, match="formats"):
        draw_history(LOOP, tmp_path / "loop.xyz")
    with pytest.raises(NotFound, match="folder"):
        draw_history(LOOP, tmp_path / "none" / "loop.png")
