"""The files of a run, read together."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hmt_service.errors import InvalidInput, NotFound
from hmt_service.io.saved_run import SUMMARY, read_run
from tests.mapped import SCANS, saved_run_in


def changed(folder: Path, **fields: object) -> Path:
    path = saved_run_in(folder) / SUMMARY
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))
    return folder


def test_a_run_is_read_as_it_was_saved(tmp_path: Path) -> None:
    run = read_run(saved_run_in(tmp_path / "flat"))
    assert run.name == "flat"
    assert run.summary.scans == len(run.stored.scans) == SCANS
    assert [h.probability for h in run.summary.posterior] == [0.8, 0.2]
    assert run.events
    assert run.beliefs


def test_the_map_may_be_elsewhere(tmp_path: Path) -> None:
    folder = saved_run_in(tmp_path / "flat")
    elsewhere = (folder / "map.hmt").rename(tmp_path / "site.hmt")
    with pytest.raises(NotFound, match=r"map\.hmt"):
        read_run(folder)
    assert len(read_run(folder, map_file=elsewhere).stored.scans) == SCANS


def test_the_map_of_another_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="the run 0123456789ab"):
        read_run(changed(tmp_path / "flat", config_hash="0123456789ab"))


@pytest.mark.parametrize(
    ("fields", "expected"),
    [({"scans": "many"}, "scans"), ({"posterior": []}, "no hypothesis")],
)
def test_a_damaged_summary_is_refused_by_name(
    tmp_path: Path, fields: dict[str, object], expected: str
) -> None:
    with pytest.raises(InvalidInput, match=rf"summary\.json.*{expected}"):
        read_run(changed(tmp_path / "flat", **fields))


def test_a_missing_folder_or_summary_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="absent"):
        read_run(tmp_path / "absent")
    with pytest.raises(NotFound, match=r"summary\.json"):
        read_run(tmp_path)
