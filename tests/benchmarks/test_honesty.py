"""NEES of the odometry: a short drive, and what is made of its errors."""

from __future__ import annotations

from benchmarks import honesty
from benchmarks.calibration import consistency
from hmt_service.sim.worlds.families import Family


def test_the_steps_of_a_short_drive_are_as_wrong_as_they_say() -> None:
    result = honesty._track(honesty._Drive(Family.OFFICE, 7, 300))
    assert result["is_planar"]
    found = consistency(result["errors"], is_planar=True)
    assert found.count == len(result["errors"]) > 40
    assert 0.4 < found.mean < 1.8
    assert found.coverage > 0.85
