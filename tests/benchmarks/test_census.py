"""What is freed when all hypotheses but the best are dropped, and who lives."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import gtsam
import numpy as np
import pytest

from benchmarks.census import _bytes_in_use, _bytes_per_extra, take_census
from benchmarks.chain import write_readings
from benchmarks.processes import ChildFailed
from hmt_service.core.config import load_config
from hmt_service.core.geometry import GaussianPose, identity
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.types import Reading
from hmt_service.runtime.offline import map_readings
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.families import Family, draw

SCANS = 10
BALLAST_BYTES = 8 * 500 * 500


def readings() -> list[Reading]:
    instants = islice(simulate(draw(Family.OFFICE, 0), INDOOR_LASER, 0), SCANS)
    return [reading for instant in instants for reading in instant.readings]


def heavy(best: Hypothesis, hypothesis: int) -> Hypothesis:
    """Return another hypothesis that alone holds a large array."""
    ballast = Assignment(0, 0, GaussianPose(identity(), np.ones((500, 500))))
    topology = Topology((ballast,))
    return replace(best, hypothesis=hypothesis, log_weight=-9.0, topology=topology)


def taken_by_each(extra: int) -> tuple[float, int]:
    """Return the bytes that each of some heavy hypotheses takes, and how many are left."""
    engine, _ = map_readings(readings(), load_config())
    best = engine._particles.best
    engine._particles.replace([best, *(heavy(best, index + 1) for index in range(extra))])
    return _bytes_per_extra(engine), len(engine._particles.hypotheses)


@pytest.mark.parametrize("extra", [1, 4])
def test_an_extra_hypothesis_takes_what_it_does_not_share(extra: int) -> None:
    # In a process of its own: what other tests have left is freed when it likes.
    with get_context("spawn").Pool(1) as pool:
        taken, left = pool.apply(taken_by_each, (extra,))
    assert taken == pytest.approx(BALLAST_BYTES, rel=0.05)
    assert left == 1


def test_memory_of_gtsam_is_in_use() -> None:
    before = _bytes_in_use()
    graphs = [gtsam.ISAM2() for _ in range(1000)]
    assert _bytes_in_use() - before > 200 * len(graphs)


def test_hypotheses_are_counted_after_each_scan(tmp_path: Path) -> None:
    write_readings(readings(), tmp_path / "readings")
    census = take_census(tmp_path / "readings", load_config(), tmp_path, timeout_s=120.0)
    np.testing.assert_array_equal(census.alive, np.ones(SCANS))
    assert census.bytes_per_extra is None


def test_a_file_that_is_no_readings_is_a_failure(tmp_path: Path) -> None:
    (tmp_path / "readings").write_bytes(b"not an array")
    with pytest.raises(ChildFailed, match="ended with code 1"):
        take_census(tmp_path / "readings", load_config(), tmp_path, timeout_s=120.0)
