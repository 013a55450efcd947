"""The files of a drive are complete or not there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hmt_service.core.geometry import planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput, Unavailable
from hmt_service.io.logs import read_log
from hmt_service.io.recording import recording
from hmt_service.io.trajectory import read_tum
from tests.flat import readings

NAMES = {"log.mcap", "truth.tum", "places.csv", "world.json"}
TRUTH = [StampedPose(1000.0 + 0.05 * i, planar_pose(i, 2.0, 0.1)) for i in range(3)]


def record(folder: Path, *, family: str = "flat", error: type[BaseException] | None = None) -> None:
    with recording(folder) as files:
        for reading in readings(3):
            files.send(reading)
        for place, truth in enumerate(TRUTH):
            files.reveal(truth, place)
        if error is not None:
            raise error
        files.finish({"family": family})


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_recording_holds_log_truth_places_and_what_was_declared(tmp_path: Path) -> None:
    record(tmp_path / "new" / "folder")
    folder = tmp_path / "new" / "folder"
    assert names(folder) == NAMES
    log = read_log(folder / "log.mcap", min_range_m=0.0, max_range_m=100.0)
    assert (log.scans, log.odometry) == (3, 3)
    for before, after in zip(TRUTH, read_tum(folder / "truth.tum"), strict=True):
        assert after.stamp_s == pytest.approx(before.stamp_s, abs=1e-6)
        np.testing.assert_allclose(after.reference_from_body, before.reference_from_body, atol=1e-8)
    assert (folder / "places.csv").read_text().splitlines() == [
        "stamp_s,place",
        "1000.000000,0",
        "1000.050000,1",
        "1000.100000,2",
    ]
    assert json.loads((folder / "world.json").read_text()) == {"family": "flat"}


def test_a_recording_replaces_an_earlier_one(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    record(tmp_path)
    record(tmp_path, family="other")
    assert names(tmp_path) == NAMES | {"notes.txt"}
    assert json.loads((tmp_path / "world.json").read_text()) == {"family": "other"}


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_interrupted_recording_leaves_nothing_and_what_was_there(
    tmp_path: Path, error: type[BaseException]
) -> None:
    record(tmp_path / "before")
    first = {path.name: path.read_bytes() for path in (tmp_path / "before").iterdir()}
    for folder in ("new", "before"):
        with pytest.raises(error):
            record(tmp_path / folder, error=error)
    assert names(tmp_path / "new") == set()
    assert {path.name: path.read_bytes() for path in (tmp_path / "before").iterdir()} == first


def test_a_log_of_somebody_else_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"precious")
    with pytest.raises(InvalidInput, match=r"log\.mcap but no world\.json"):
        record(tmp_path)
    assert names(tmp_path) == {"log.mcap"}
    assert (tmp_path / "log.mcap").read_bytes() == b"precious"


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Unavailable, match="File exists"):
        record(tmp_path / "file")
