"""Odometry and engine on recorded logs: accuracy over ground-truth relations, and repeatability."""

from __future__ import annotations

from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np

from hmt_service.core.config import Preset, load_config
from hmt_service.core.types import Reading, Scan, StampedPose
from hmt_service.io.carmen import read_carmen
from hmt_service.io.logs import read_log
from hmt_service.io.relations import evaluate, read_relations
from hmt_service.io.trajectory import write_tum
from hmt_service.runtime.offline import map_readings

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
    return map_readings(readings, CONFIG)[0].trajectory()


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


def test_lidar_without_odometry_is_tracked_to_a_few_per_cent(hmt_data: Path) -> None:
    folder = hmt_data / "3d/kitti00-part"
    truth = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[:40]
    config = load_config(Preset.OUTDOOR)
    sensor = config.sensor
    log = read_log(folder, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m)
    scans = list(islice(log.readings, len(truth)))
    engine, _ = map_readings(scans, config)
    last = engine.trajectory()[-1].reference_from_body[:3, 3]
    expected = truth[0, :, :3].T @ (truth[-1, :, 3] - truth[0, :, 3])
    travelled_m = np.linalg.norm(np.diff(truth[:, :, 3], axis=0), axis=1).sum()
    assert np.linalg.norm(last - expected) < 0.03 * travelled_m
