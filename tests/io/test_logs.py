"""The format of a log is known by its name."""

from __future__ import annotations

from pathlib import Path

import pytest

from hmt_service.errors import InvalidLog
from hmt_service.io.logs import read_log
from hmt_service.io.mcap_writer import McapWriter
from tests.flat import readings


@pytest.mark.parametrize(
    "name", ["run.clf", "run.log", "run.2024.log", "run.clf.gz", "run.log.bz2"]
)
def test_carmen_names_reach_the_carmen_reader(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text("FLASER 2 1 1 0 0 0 0 0 0 1 host 1\n")
    log = read_log(path, min_range_m=0.1, max_range_m=40.0)
    assert (log.scans, log.odometry, len(list(log.readings))) == (1, 1, 2)


@pytest.mark.parametrize("name", ["run.mcap", "run.2024.MCAP"])
def test_mcap_names_reach_the_mcap_reader(tmp_path: Path, name: str) -> None:
    with (tmp_path / name).open("wb") as file:
        writer = McapWriter(file)
        for reading in readings(2):
            writer.write(reading)
        writer.finish()
    log = read_log(tmp_path / name, min_range_m=0.1, max_range_m=40.0)
    assert (log.scans, log.odometry, len(list(log.readings))) == (2, 2, 4)


@pytest.mark.parametrize("name", ["run.zip", "run", "run.gz"])
def test_unknown_format_is_refused_with_the_known_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidLog, match=r"unknown format .*\.clf, \.log, \.mcap, \.bag"):
        read_log(tmp_path / name, min_range_m=0.1, max_range_m=40.0)
