"""`hmt info`, `check` and `export`: what they print, and their exit codes."""

from __future__ import annotations

import json
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hmt_service.__main__ import main
from hmt_service.cli.app import app
from hmt_service.io.exporters.formats import Format
from hmt_service.io.map_file import read_map
from hmt_service.io.trajectory import read_tum
from tests.mapped import SCANS, map_file_in


def hmt(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def exit_code(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int | str | None:
    """Return the exit code of the whole program, in which errors become one."""
    monkeypatch.setattr(sys, "argv", ["hmt", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code


def test_info_prints_a_table_and_one_json_object(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    table = hmt("info", path)
    assert table.exit_code == 0
    assert f"{SCANS} scans" not in table.stdout
    assert f"{SCANS} in 54 keyframes, 3 visits" in table.stdout
    numbers = json.loads(hmt("info", path, "--json").stdout)
    assert numbers["scans"] == SCANS
    assert numbers["hypotheses"][0]["probability"] == pytest.approx(1.0)


def test_check_of_a_sound_map_is_0(tmp_path: Path) -> None:
    result = hmt("check", map_file_in(tmp_path))
    assert (result.exit_code, result.stdout.count("\n")) == (0, 1)
    assert result.stdout.endswith("map.hmt: sound\n")


def test_check_of_a_damaged_map_is_1_with_a_line_each(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE keyframes SET points_in_body = x'00' WHERE keyframe = 2")
    result = hmt("check", path)
    digest, points = result.stdout.splitlines()
    assert result.exit_code == 1
    assert "content_sha256" in digest
    assert points.startswith("keyframes, keyframe 2: points_in_body")


def test_check_of_no_map_is_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "text.hmt").write_text("no map")
    assert exit_code(monkeypatch, "check", tmp_path / "text.hmt") == 2
    assert "(6 bytes) is no map file" in capsys.readouterr().err
    assert exit_code(monkeypatch, "check", tmp_path / "absent.hmt") == 2
    assert exit_code(monkeypatch, "info", tmp_path / "absent.hmt") == 2


def test_export_writes_the_chosen_frame(tmp_path: Path) -> None:
    path, out = map_file_in(tmp_path), tmp_path / "out.tum"
    result = hmt("export", path, "--format", "tum", "--out", out, "--reference", "1")
    assert result.exit_code == 0
    (hypothesis,) = read_map(path).hypotheses
    assert f"hypothesis {hypothesis.hypothesis}, in the frame of area 1" in result.stderr
    assert len(read_tum(out)) == SCANS
    assert read_tum(out)[0].reference_from_body[0, 3] < -3.0


def test_export_errors_are_2_and_write_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = map_file_in(tmp_path), tmp_path / "out.tum"
    arguments = ("export", path, "--out", out)
    assert exit_code(monkeypatch, *arguments, "--format", "tum", "--hypothesis", "99") == 2
    assert "hypothesis 99 is not one of [" in capsys.readouterr().err
    assert exit_code(monkeypatch, *arguments, "--format", "tiff") == 2
    assert not out.exists()


def test_every_format_is_in_the_readme_and_in_the_help() -> None:
    readme = (Path(__file__).parents[2] / "README.md").read_text()
    text = hmt("export", "--help").stdout
    for form in Format:
        assert f"`{form}`" in readme
        assert form in text
