"""What all formats have in common: whole files, typed errors, the chosen frame and hypothesis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.registry import export_map
from hmt_service.io.map_file import write_map
from tests.mapped import map_file_in, mapped


def target(folder: Path, form: Format) -> Path:
    return folder / f"out.{'yaml' if form is Format.ROS_MAP else form}"


@pytest.mark.parametrize("form", Format)
def test_export_writes_the_same_bytes_twice_and_nothing_else(tmp_path: Path, form: Format) -> None:
    source, path = map_file_in(tmp_path), target(tmp_path, form)
    before = source.read_bytes()
    export_map(source, path, form)
    first = path.read_bytes()
    export_map(source, path, form)
    # Rerun numbers rows by the clock: test_rerun.py compares what they hold.
    assert form is Format.RRD or path.read_bytes() == first
    assert source.read_bytes() == before
    image = {"out.pgm"} if form is Format.ROS_MAP else set()
    assert {p.name for p in tmp_path.iterdir()} == {"map.hmt", path.name} | image


@pytest.mark.parametrize("form", Format)
def test_failed_export_leaves_what_was_there(tmp_path: Path, form: Format) -> None:
    source, path = map_file_in(tmp_path), target(tmp_path, form)
    path.write_text("old")
    with pytest.raises(NotFound, match=r"area 77 is not in hypothesis \d+, which has 2 areas"):
        export_map(source, path, form, reference_area=77)
    with pytest.raises(NotFound, match="hypothesis 999 is not one of"):
        export_map(source, path, form, hypothesis=999)
    assert path.read_text() == "old"
    with pytest.raises(NotFound, match="nowhere"):
        export_map(source, target(tmp_path / "nowhere", form), form)
    folder = target(tmp_path, form).with_stem("folder")
    folder.mkdir()
    with pytest.raises(Unavailable, match="is a folder"):
        export_map(source, folder, form)
    assert list(folder.iterdir()) == []
    assert len(list(tmp_path.iterdir())) == 3


def test_the_map_is_not_replaced_by_its_export(tmp_path: Path) -> None:
    source = map_file_in(tmp_path)
    before = source.read_bytes()
    with pytest.raises(InvalidInput, match="the map itself"):
        export_map(source, source, Format.TUM)
    assert source.read_bytes() == before


def test_an_empty_map_is_unavailable(tmp_path: Path) -> None:
    source = tmp_path / "map.hmt"
    empty = replace(mapped().stored(), keyframes=(), visits=(), hypotheses=(), scans=())
    write_map(source, empty)
    with pytest.raises(Unavailable, match="0 keyframes"):
        export_map(source, tmp_path / "out.tum", Format.TUM)


def test_settings_of_another_version_are_refused(tmp_path: Path) -> None:
    source = tmp_path / "map.hmt"
    write_map(source, replace(mapped().stored(), config_json='{"sonar": {}}'))
    with pytest.raises(InvalidInput, match="sonar"):
        export_map(source, tmp_path / "out.tum", Format.TUM)
