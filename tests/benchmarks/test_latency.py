"""Latency: hand-made arrivals with known waits, and a small daemon from end to end."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cells import Cells, Result
from benchmarks.clients import Question
from benchmarks.latency import (
    measure,
    percentiles_ms,
    scan_to_pose,
    steady,
    throughput,
    under_load,
)
from benchmarks.report import Report, Run
from hmt_service.core.geometry import identity
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import DaemonFailure
from tests import flat


def scan(stamp_s: float) -> Scan:
    return Scan(stamp_s, np.zeros((1, 3)), np.zeros(3))


def odometry(stamp_s: float) -> OdometryReading:
    return OdometryReading(stamp_s, identity())


def kinds_and_stamps(readings: Sequence[Reading]) -> list[tuple[str, float]]:
    return [(type(reading).__name__[0], reading.stamp_s) for reading in readings]


# ------------------------------------------------------------------ what is sent


def test_steady_gives_each_scan_its_beat_and_odometry_that_of_the_next_scan() -> None:
    uneven: list[Reading] = [
        odometry(7.0),
        scan(7.1),
        odometry(7.2),
        odometry(7.3),
        scan(9.0),
        scan(9.0),
    ]
    assert kinds_and_stamps(steady(uneven, rate_hz=50.0)) == [
        ("O", 0.0),
        ("S", 0.0),
        ("O", 0.02),
        ("O", 0.02),
        ("S", 0.02),
        ("S", 0.04),
    ]


# ------------------------------------------------------------------ arithmetic


def test_each_pose_is_matched_with_the_scan_of_its_stamp() -> None:
    readings: list[Reading] = [odometry(0.0), scan(0.0), odometry(0.1), scan(0.1)]
    # The poses arrive in another order than the scans; odometry gets none.
    found = scan_to_pose(readings, [10.0, 10.5, 11.0, 11.5], {0.1: 11.75, 0.0: 12.0}, from_s=0.0)
    assert found.latencies_s == pytest.approx((1.5, 0.25))
    assert found.unmatched == 0


def test_scans_without_a_pose_are_counted_and_poses_without_a_scan_are_not() -> None:
    found = scan_to_pose([scan(0.0), scan(0.1)], [10.0, 11.0], {0.1: 11.5, 7.0: 9.0}, from_s=0.0)
    assert found.latencies_s == pytest.approx((0.5,))
    assert found.unmatched == 1


def test_scans_of_a_daemon_that_does_not_know_who_sends_do_not_count() -> None:
    readings: list[Reading] = [scan(0.0), scan(0.25), odometry(0.5), scan(0.5)]
    arrived_s = {0.0: 30.5, 0.25: 32.0, 0.5: 33.0}
    found = scan_to_pose(readings, [10.0, 20.0, 30.0, 31.0], arrived_s, from_s=0.25)
    assert found.latencies_s == pytest.approx((12.0, 2.0))


def test_percentiles_are_those_of_numpy_in_milliseconds() -> None:
    seconds = [0.001 * number for number in range(1, 102)]  # 1 to 101 ms
    assert percentiles_ms(seconds) == pytest.approx({"p50": 51.0, "p99": 100.0, "max": 101.0})


def test_percentiles_of_nothing_are_an_error() -> None:
    with pytest.raises(DaemonFailure, match="not one answer"):
        percentiles_ms([])


# ------------------------------------------------------------------ the report


def answers(*milliseconds: float) -> dict[str, list[float]]:
    return {question: [1e-3 * each for each in milliseconds] for question in Question}


def load(scan_to_pose_ms: float, *milliseconds: float, lost: int = 0) -> Result:
    scans_s = {"scan_to_pose": [1e-3 * scan_to_pose_ms]}
    return {
        "load": {**scans_s, **answers(*milliseconds)},
        "idle": answers(2.0),
        "unmatched": 3,
        "lost": lost,
    }


def measured(folder: Path, sensor_rate: Result, full_speed: Result) -> Report:
    """Return the report of a run that finds all of its units of work done."""
    cells = Cells(folder / "cells", "a", is_resumed=True)
    cells.write("throughput", {"one_process_s": 2.0, "daemon_s": 3.0, "scans": 400, "lost": 0})
    cells.write("sensor_rate", sensor_rate)
    cells.write("full_speed", full_speed)
    return measure(Run(True, lambda _: None, folder, cells))


def test_a_resumed_run_reports_the_units_that_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HMT_DATA", raising=False)
    found = measured(tmp_path, load(260.0, 2.0, 3.0, 4.0, lost=1), load(5000.0, 8.0, lost=2))
    values = {metric.key.removeprefix("office/"): metric.value for metric in found.metrics}
    assert values["over_one_process"] == 1.5
    assert values["scans_lost"] == 3.0
    assert values["sensor_rate/scans_without_pose"] == 3.0
    assert values["sensor_rate/scan_to_pose/p50"] == pytest.approx(260.0)
    assert values["sensor_rate/pose/max"] == pytest.approx(4.0)
    assert values["sensor_rate/pose/p50_over_idle"] == pytest.approx(1.5)
    assert values["full_speed/map_points/p50_over_idle"] == pytest.approx(4.0)
    # 2 s for 400 scans are 5 ms each.
    assert values["scan_to_pose_over_one_process"] == pytest.approx(52.0)
    assert found.skipped == (
        "intel, simulated office instead: HMT_DATA does not name the folder of recorded logs",
    )
    assert [figure.stat().st_size > 0 for figure in found.figures] == [True]


def test_only_ratios_of_medians_and_losses_are_gated(tmp_path: Path) -> None:
    metrics = measured(tmp_path, load(260.0, 2.0), load(5000.0, 8.0)).metrics
    gated = [metric for metric in metrics if metric.rel_tol is not None]
    assert {metric.unit for metric in gated} == {"1"}
    assert not any("p99" in metric.key or "max" in metric.key for metric in gated)


# ------------------------------------------------------------------ end to end


def test_a_daemon_answers_while_scans_come_in_and_each_scan_gets_its_pose() -> None:
    readings = steady(flat.readings(200), rate_hz=50.0)
    with ProcessPoolExecutor(1 + len(Question), get_context("spawn")) as processes:
        cost = throughput(readings, processes)
        result = under_load(readings, processes, is_paced=True, idle_s=0.01)
    assert (cost["scans"], cost["lost"], result["lost"]) == (200, 0, 0)
    assert cost["daemon_s"] > 0.0
    assert cost["one_process_s"] > 0.0
    loaded, idle = result["load"], result["idle"]
    # Of the first 2.5 s nothing is said.
    assert len(loaded["scan_to_pose"]) + result["unmatched"] == 75
    assert loaded["scan_to_pose"]
    assert set(idle) == set(Question)
    assert all(
        latency_s > 0.0 for times_s in (*loaded.values(), *idle.values()) for latency_s in times_s
    )
    assert loaded["pose"]
    assert all(idle.values())
