"""Our chain as a program: the same map as in this process, and what it says of its cost."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from benchmarks.chain import ChainRun, read_readings, run_chain, write_readings
from benchmarks.processes import ChildFailed
from benchmarks.stages import Stage
from hmt_service.core.config import load_config
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.runtime.offline import map_readings
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.families import Family, draw

SCANS = 40


@pytest.fixture(scope="module")
def readings() -> list[Reading]:
    instants = islice(simulate(draw(Family.OFFICE, 0), INDOOR_LASER, 0), SCANS)
    return [reading for instant in instants for reading in instant.readings]


@pytest.fixture(scope="module")
def run(readings: list[Reading], tmp_path_factory: pytest.TempPathFactory) -> ChainRun:
    folder = tmp_path_factory.mktemp("chain")
    write_readings(readings, folder / "readings")
    return run_chain(folder / "readings", load_config(), folder, timeout_s=120.0)


def test_readings_come_back_from_the_file(readings: list[Reading], tmp_path: Path) -> None:
    assert write_readings(readings, tmp_path / "readings") == SCANS
    back = list(read_readings(tmp_path / "readings"))
    assert [type(reading) for reading in back] == [type(reading) for reading in readings]
    assert [reading.stamp_s for reading in back] == [reading.stamp_s for reading in readings]
    pairs = zip(readings, back, strict=True)
    for there, here in pairs:
        if isinstance(there, Scan) and isinstance(here, Scan):
            np.testing.assert_array_equal(here.points_in_body, there.points_in_body)
            np.testing.assert_array_equal(here.sensor_in_body, there.sensor_in_body)
        elif isinstance(there, OdometryReading) and isinstance(here, OdometryReading):
            np.testing.assert_array_equal(here.odom_from_body, there.odom_from_body)


def test_the_program_maps_as_this_process_does(run: ChainRun, readings: list[Reading]) -> None:
    engine, _ = map_readings(readings, load_config())
    expected = engine.trajectory()
    assert [pose.stamp_s for pose in run.trajectory] == [pose.stamp_s for pose in expected]
    for pose, same in zip(run.trajectory, expected, strict=True):
        np.testing.assert_allclose(pose.reference_from_body, same.reference_from_body, atol=1e-9)


def test_costs_are_told_for_every_scan(run: ChainRun) -> None:
    assert run.memory_bytes.shape == (SCANS,)
    assert run.spent_s.shape == (SCANS + 1, len(Stage))
    assert (np.diff(run.spent_s, axis=0) >= 0.0).all()
    assert run.empty_bytes > 0.0
    assert run.cpu_s == pytest.approx(run.spent_s[-1].sum())
    assert run.busy_s > 0.0
    assert run.loop_closures == 0


def test_odometry_can_be_withheld(readings: list[Reading], tmp_path: Path) -> None:
    write_readings(readings, tmp_path / "readings")
    (tmp_path / "a").mkdir()
    run = run_chain(
        tmp_path / "readings", load_config(), tmp_path / "a", timeout_s=120.0, has_odometry=False
    )
    scans = [reading for reading in readings if isinstance(reading, Scan)]
    expected = map_readings(scans, load_config())[0].trajectory()
    np.testing.assert_allclose(
        run.trajectory[-1].reference_from_body, expected[-1].reference_from_body, atol=1e-9
    )


def test_a_file_that_is_no_readings_is_a_failure(tmp_path: Path) -> None:
    (tmp_path / "readings").write_bytes(b"not an array")
    with pytest.raises(ChildFailed, match="ended with code 1"):
        run_chain(tmp_path / "readings", load_config(), tmp_path, timeout_s=120.0)
