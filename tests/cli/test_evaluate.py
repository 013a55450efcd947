"""`hmt eval`, and what every command shares: version, help, errors."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hmt_service import __version__
from hmt_service.__main__ import main
from hmt_service.cli.app import app
from hmt_service.core.geometry import identity, planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.io.trajectory import write_tum


@pytest.fixture
def arguments(tmp_path: Path) -> list[str]:
    """Return a call on a trajectory whose only relation is 0.5 m off."""
    write_tum(
        tmp_path / "trajectory.tum",
        [StampedPose(0.0, identity()), StampedPose(70.0, planar_pose(2.5, 0.0, 0.0))],
    )
    relations = tmp_path / "some.relations"
    relations.write_text("0 70 2 0 0 0 0 0\n0 90 2 0 0 0 0 0\n")
    return ["eval", str(tmp_path), "--relations", str(relations)]


def test_eval_prints_one_json_object(arguments: list[str]) -> None:
    result = CliRunner().invoke(app, [*arguments, "--json"])
    errors = json.loads(result.stdout)
    assert result.exit_code == 0
    assert (errors["matched"], errors["unmatched"]) == (1, 1)
    assert errors["all_pairs"]["translation_mean_m"] == pytest.approx(0.5)
    assert errors["loop_closures"]["pairs"] == 1


def test_eval_prints_a_table(arguments: list[str]) -> None:
    result = CliRunner().invoke(app, arguments, env={"COLUMNS": "120"})
    assert result.exit_code == 0
    assert "0.5000 ± 0.0000" in result.stdout
    assert "1 relations matched, 1 without a scan" in result.stdout


def test_eval_without_loop_closures_says_so(arguments: list[str]) -> None:
    Path(arguments[3]).write_text("70 70 0 0 0 0 0 0\n")
    assert CliRunner().invoke(app, arguments, env={"COLUMNS": "120"}).exit_code == 0
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert json.loads(result.stdout)["loop_closures"] is None


def test_package_error_becomes_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["hmt", "eval", str(tmp_path), "--relations", "none"])
    with pytest.raises(SystemExit) as exit_info:
        main()
    captured = capsys.readouterr()
    assert exit_info.value.code == 2
    assert captured.out == ""
    assert captured.err.startswith("error: cannot read")
    assert captured.err.count("\n") == 1


def test_bug_crashes(monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> None:
    def broken(path: Path) -> None:
        raise ZeroDivisionError(path)

    monkeypatch.setattr("hmt_service.io.trajectory.read_tum", broken)
    monkeypatch.setattr(sys, "argv", ["hmt", *arguments])
    with pytest.raises(ZeroDivisionError):
        main()


def test_version_is_the_package_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"hmt {__version__}\n")
