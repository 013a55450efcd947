"""Laps: where they end, and what is compared with what."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.laps import ends_of_laps, metrics_of


def test_laps_end_where_their_way_is_done() -> None:
    turn = np.linspace(0.0, 6.0 * np.pi, 3001)
    positions = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    assert ends_of_laps(positions, 2.0 * np.pi, 3) == pytest.approx([1000, 2000, 3001], abs=1)


def test_a_route_whose_corners_are_cut_has_as_many_laps() -> None:
    positions = np.stack([np.linspace(0.0, 9.0, 91), np.zeros(91), np.zeros(91)], axis=1)
    assert ends_of_laps(positions, 3.5, 3) == pytest.approx([30, 60, 91], abs=1)


def test_the_last_lap_is_compared_with_the_second() -> None:
    few = {"first_rmse_m": 0.04}
    many = {
        "areas": [6.0, 8.0, 8.0],
        "cost_ms": [3.0, 2.0, 2.5],
        "memory_mb": [10.0, 20.0, 25.0],
        "first_rmse_m": 0.03,
    }
    values = {metric.key: metric.value for metric in metrics_of(few, many)}
    assert values["areas_over_lap_2"] == 1.0
    assert values["cost_over_lap_2"] == 1.25
    assert values["map_memory_over_lap_2"] == 1.25
    assert (values["laps"], values["map_memory"]) == (3.0, 25.0)
    assert (values["error_of_first_laps"], values["error_of_first_laps_alone"]) == (0.03, 0.04)
