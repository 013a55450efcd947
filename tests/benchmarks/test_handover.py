"""Records come back from a file as they were written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks.handover import PoseRecord, Record, SweepRecord, read_records, write_record

SWEEP = SweepRecord(
    1_137_834_225.97376,
    np.array([[1.0, 2.0, 3.0], [1 / 3, -2 / 3, 0.0]]),
    np.array([0.1, 0.0, 0.8]),
    np.array([0.25, 1.0]),
)
AT_ONCE = SweepRecord(2.0, np.ones((3, 3)), np.zeros(3), None)
EMPTY = SweepRecord(3.0, np.zeros((0, 3)), np.zeros(3), None)
POSE = PoseRecord(4.0, np.arange(16.0).reshape(4, 4))


def through_a_file(folder: Path, records: Sequence[Record]) -> list[Record]:
    with (folder / "records").open("wb") as file:
        for record in records:
            write_record(file, record)
    return list(read_records(folder / "records"))


@pytest.mark.parametrize("sweep", [SWEEP, AT_ONCE, EMPTY])
def test_a_scan_comes_back_bit_for_bit(sweep: SweepRecord, tmp_path: Path) -> None:
    (back,) = through_a_file(tmp_path, [sweep])
    assert isinstance(back, SweepRecord)
    assert back.stamp_s == sweep.stamp_s
    np.testing.assert_array_equal(back.points, sweep.points)
    np.testing.assert_array_equal(back.sensor, sweep.sensor)
    if sweep.times is None:
        assert back.times is None
    else:
        assert back.times is not None
        np.testing.assert_array_equal(back.times, sweep.times)


def test_odometry_comes_back_bit_for_bit(tmp_path: Path) -> None:
    (back,) = through_a_file(tmp_path, [POSE])
    assert isinstance(back, PoseRecord)
    assert back.stamp_s == POSE.stamp_s
    np.testing.assert_array_equal(back.pose, POSE.pose)


def test_records_keep_their_order(tmp_path: Path) -> None:
    back = through_a_file(tmp_path, [POSE, SWEEP, EMPTY, POSE])
    assert [record.stamp_s for record in back] == [4.0, SWEEP.stamp_s, 3.0, 4.0]


def test_a_file_without_records_has_none(tmp_path: Path) -> None:
    assert through_a_file(tmp_path, []) == []
