"""`hmt inspect`: what it prints, its exit codes, and that `hmt run` takes the same preset."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hmt_service.__main__ import main
from hmt_service.cli.app import app
from hmt_service.io.map_info import map_info
from tests.hall import write_hall
from tests.ros import Ros, write_bag2

SCANS = 40


def hmt(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


@pytest.fixture
def hall(tmp_path: Path) -> Path:
    return write_hall(tmp_path / "hall", half_m=6.0)


def test_a_usable_log_is_0_with_streams_sensor_and_preset(hall: Path) -> None:
    result = hmt("inspect", hall)
    assert result.exit_code == 0
    text = " ".join(result.stdout.split())
    for part in ("sequence of KITTI", "velodyne/*.bin", "16 rows", "3d-indoor fits", ": usable"):
        assert part in text
    assert "note: no odometry" in text
    assert "  next: " in result.stdout


def test_json_is_one_object_with_everything(hall: Path) -> None:
    result = hmt("inspect", hall, "--json")
    inspection = json.loads(result.stdout)
    assert (result.exit_code, inspection["verdict"]) == (0, "usable")
    assert (inspection["preset"], inspection["scans"]["rows"]) == ("3d-indoor", 16)
    assert [finding["trouble"] for finding in inspection["findings"]] == [
        "no_point_times",
        "no_odometry",
    ]


def test_a_log_with_a_fault_is_1_and_an_unusable_one_2(tmp_path: Path) -> None:
    sent = Ros().drive(SCANS)
    doubtful = hmt("inspect", write_bag2(tmp_path / "doubtful", sent))
    assert doubtful.exit_code == 1
    assert "warning: /odom, message 1: wrong_frame" in doubtful.stdout
    assert doubtful.stdout.endswith("doubtful: usable, with warnings\n")
    no_scan = [each for each in sent if each[0] != "/scan"]
    unusable = hmt("inspect", write_bag2(tmp_path / "unusable", no_scan))
    assert unusable.exit_code == 2
    assert "/odom" in unusable.stdout
    assert unusable.stdout.endswith("unusable: unusable\n")


def test_what_is_no_log_is_2_with_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["hmt", "inspect", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "holds neither metadata.yaml" in capsys.readouterr().err


def test_run_takes_the_preset_that_inspect_names(hall: Path, tmp_path: Path) -> None:
    for name in ("first", "second"):
        result = hmt("run", hall, "--out", tmp_path / name)
        assert result.exit_code == 0, result.output
        assert result.stderr.startswith("preset 3d-indoor fits: in 20 scans, ")
    assert map_info(tmp_path / "first" / "map.hmt").preset == "3d-indoor"
    first, second = ((tmp_path / n / "map.hmt").read_bytes() for n in ("first", "second"))
    assert first == second
    given = hmt("run", hall, "--out", tmp_path / "given", "--preset", "3d-outdoor")
    assert "fits" not in given.stderr
    assert map_info(tmp_path / "given" / "map.hmt").preset == "3d-outdoor"


def test_a_planar_log_gets_the_planar_preset(tmp_path: Path) -> None:
    path = write_bag2(tmp_path / "flat", Ros().drive(SCANS))
    result = hmt("run", path, "--out", tmp_path / "out")
    assert "preset 2d fits" in result.stderr
    assert map_info(tmp_path / "out" / "map.hmt").preset == "2d"


def test_an_assumed_rate_is_said_and_can_be_given(hall: Path, tmp_path: Path) -> None:
    (hall / "times.txt").unlink()
    assumed = hmt("run", hall, "--out", tmp_path / "assumed")
    assert "10 scans per second are assumed: say --scan-rate" in assumed.stderr
    given = json.loads(hmt("inspect", hall, "--scan-rate", "4", "--json").stdout)
    assert given["streams"][0]["why"] == "stamped by 4 scans per second"
    assert given["scans"]["timing"]["rate_hz"] == pytest.approx(4.0)
    assert "assumed" not in {finding["trouble"] for finding in given["findings"]}
