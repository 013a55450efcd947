from __future__ import annotations

from pathlib import Path

import pytest

from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.whole_files import whole_files


def test_files_appear_when_the_block_has_ended(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    first.write_text("old")
    with whole_files(first, second) as (part, other):
        part.write_text("new")
        other.write_text("beside")
        assert first.read_text() == "old"
        assert not second.exists()
    assert (first.read_text(), second.read_text()) == ("new", "beside")
    assert sorted(tmp_path.iterdir()) == [first, second]


def test_after_an_error_only_what_was_there_is_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("old")

    def write_half() -> None:
        with whole_files(path) as (part,):
            part.write_text("half")
            raise InvalidInput("the rest is missing")

    with pytest.raises(InvalidInput, match="the rest"):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_the_file_system_refuses_is_unavailable(tmp_path: Path) -> None:
    with (
        pytest.raises(Unavailable, match=r"absent not written: No such file"),
        whole_files(tmp_path / "absent"),
    ):
        pass
    with pytest.raises(NotFound, match="nowhere"), whole_files(tmp_path / "nowhere" / "file"):
        pass
    with pytest.raises(Unavailable, match="is a folder"), whole_files(tmp_path):
        pass
