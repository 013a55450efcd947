"""Latency: hand-made arrivals with known waits, and a small daemon from end to end."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import pytest

from benchmarks.clients import Question
from benchmarks.latency import percentiles_ms, scan_to_pose, steady, throughput, under_load
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
    found = scan_to_pose(readings, [10.0, 10.5, 11.0, 11.5], {0.1: 11.75, 0.0: 12.0}, window_s=1.0)
    assert found.latencies_s == pytest.approx((1.5, 0.25))
    assert found.unmatched == 0


def test_scans_without_a_pose_are_counted_and_poses_without_a_scan_are_not() -> None:
    found = scan_to_pose([scan(0.0), scan(0.1)], [10.0, 11.0], {0.1: 11.5, 7.0: 9.0}, window_s=1.0)
    assert found.latencies_s == pytest.approx((0.5,))
    assert found.unmatched == 1


def test_a_scan_is_released_by_the_first_reading_more_than_the_window_later() -> None:
    readings: list[Reading] = [scan(0.0), scan(0.25), odometry(0.5), scan(0.5)]
    sent_s = [10.0, 20.0, 30.0, 31.0]
    arrived_s = {0.0: 30.5, 0.25: 32.0, 0.5: 33.0}
    # 0.25 is not more than 0.25 later than 0.0; 0.5 is, and odometry is the first to say so.
    found = scan_to_pose(readings, sent_s, arrived_s, window_s=0.25)
    assert found.latencies_s == pytest.approx((20.5, 12.0, 2.0))
    assert found.released_s == pytest.approx((0.5,))


def test_percentiles_are_those_of_numpy_in_milliseconds() -> None:
    seconds = [0.001 * number for number in range(1, 102)]  # 1 to 101 ms
    assert percentiles_ms(seconds) == pytest.approx({"p50": 51.0, "p99": 100.0, "max": 101.0})


def test_percentiles_of_nothing_are_an_error() -> None:
    with pytest.raises(DaemonFailure, match="not one answer"):
        percentiles_ms([])


# ------------------------------------------------------------------ end to end


def test_a_daemon_answers_while_scans_come_in_and_each_scan_gets_its_pose() -> None:
    readings = steady(flat.readings(80), rate_hz=50.0)
    with ProcessPoolExecutor(1 + len(Question), get_context("spawn")) as processes:
        cost = throughput(readings, processes)
        result = under_load(readings, processes, is_paced=True, idle_s=0.01)
    assert (cost["scans"], cost["lost"], result["lost"]) == (80, 0, 0)
    assert cost["daemon_s"] > 0.0
    assert cost["one_process_s"] > 0.0
    load, idle = result["load"], result["idle"]
    assert len(load["scan_to_pose"]) + result["unmatched"] == 80
    # Scans before the first map have no pose yet; the last ones are released by the end.
    assert len(load["scan_to_pose"]) > len(load["release_to_pose"]) > 0
    assert set(idle) == set(Question)
    assert all(
        latency_s > 0.0 for times_s in (*load.values(), *idle.values()) for latency_s in times_s
    )
    assert load["pose"]
    assert all(idle.values())
