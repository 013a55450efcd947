"""Memory of the odometry in a process of its own, and what is made of it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.processes import ChildFailed
from benchmarks.resident import ResidentMemory, resident_memory
from hmt_service.core.config import load_config
from hmt_service.core.types import OdometryReading, Reading
from hmt_service.errors import InvalidInput
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.families import Family, draw


def readings() -> Iterator[Reading]:
    for instant in simulate(draw(Family.OFFICE, 0), INDOOR_LASER, 0):
        yield from instant.readings


def test_memory_is_told_after_every_scan_until_the_time_is_over() -> None:
    memory = resident_memory(readings(), load_config(), until_s=4.0)
    np.testing.assert_allclose(memory.stamps_s, np.arange(21) * 0.2)
    assert memory.rss_bytes.shape == (21,)
    # An interpreter with numpy, scipy and compiled kernels; no log.
    assert 30e6 < memory.rss_bytes.min() <= memory.rss_bytes.max() < 300e6


def test_memory_at_a_time_is_the_median_of_the_minute_before() -> None:
    memory = ResidentMemory(np.arange(100.0) + 7.0, np.arange(100.0))
    # After 31 s to after 90 s.
    assert memory.at(90.0) == 60.5
    assert memory.at(99.0) == 69.5


def test_there_is_no_memory_after_the_last_scan() -> None:
    with pytest.raises(InvalidInput, match="scans of 9 s tell no memory at 10 s"):
        ResidentMemory(np.arange(10.0), np.arange(10.0)).at(10.0)


def test_a_process_that_ends_is_a_failure(capfd: pytest.CaptureFixture[str]) -> None:
    broken = OdometryReading(0.0, np.zeros(3))
    with pytest.raises(ChildFailed, match="the odometry ended with code 1"):
        resident_memory([broken, broken], load_config(), until_s=4.0)
    assert "IndexError" in capfd.readouterr().err
