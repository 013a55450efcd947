"""Odometry and engine on recorded logs: accuracy over ground-truth relations, and repeatability."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Reading, Scan, StampedPose
from hmt_service.io.carmen import read_carmen
from hmt_service.io.relations import evaluate, read_relations
from hmt_service.io.trajectory import write_tum

CONFIG = load_config()


@cache
def readings_of(log: Path) -> tuple[Reading, ...]:
    sensor = CONFIG.sensor
    return read_carmen(log, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m).readings


def mapped(log: Path, *, scans: int | None = None) -> tuple[StampedPose, ...]:
    """Return the trajectory of the first scans of a log, or of all."""
    readings = readings_of(log)
    if scans is not None:
        is_scan = [i for i, reading in enumerate(readings) if isinstance(reading, Scan)]
        readings = readings[: is_scan[scans]]
    odometry, engine = Odometry(CONFIG), Engine(CONFIG, seed=0)
    for reading in readings:
        tracking = odometry.process(reading)
        if tracking is not None:
            engine.process(tracking)
    engine.finish()
    return engine.trajectory()


def test_beginning_of_intel_is_accurate(hmt_data: Path) -> None:
    trajectory = mapped(hmt_data / "2d/intel.clf.bz2", scans=3000)
    assert len(trajectory) == 3000
    errors = evaluate(trajectory, read_relations(hmt_data / "2d/intel.relations"))
    assert errors.matched > 500
    assert errors.all_pairs.translation_mean_m < 0.05
    assert errors.all_pairs.rotation_mean_deg < 0.6


def test_same_log_gives_the_same_file(hmt_data: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("first.tum", "second.tum")]
    for file in files:
        write_tum(file, mapped(hmt_data / "2d/intel.clf.bz2", scans=1500))
    assert files[0].stat().st_size > 100_000
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize(
    ("name", "largest_mean_m", "pairs"), [("intel", 0.05, 2984), ("fr079", 0.08, 1685)]
)
def test_whole_log_is_accurate(
    hmt_data: Path, name: str, largest_mean_m: float, pairs: int
) -> None:
    trajectory = mapped(hmt_data / f"2d/{name}.clf.bz2")
    errors = evaluate(trajectory, read_relations(hmt_data / f"2d/{name}.relations"))
    assert (errors.matched, errors.unmatched) == (pairs, 0)
    assert errors.all_pairs.translation_mean_m <= largest_mean_m
    assert errors.loop_closures is not None
    assert errors.loop_closures.translation_mean_m <= 2.0 * largest_mean_m
