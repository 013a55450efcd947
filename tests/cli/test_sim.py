"""`hmt sim`: files that say what was simulated, and that `hmt run` maps."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hmt_service.cli.app import app
from hmt_service.cli.sim import expected_scans
from hmt_service.core.geometry import inverse
from hmt_service.core.types import OdometryReading, Scan
from hmt_service.errors import InvalidInput
from hmt_service.io.logs import read_log
from hmt_service.io.trajectory import read_tum
from hmt_service.sim.simulation import INDOOR_LASER, simulate
from hmt_service.sim.worlds.families import RECIPES, Family, draw

FILES = {"log.mcap", "truth.tum", "places.csv", "world.json"}
SMALL = ("long", "--areas", "4", "--seed", "3")
COARSE = ("long", "--areas", "2", "--rate-hz", "1", "--beams", "20")


def hmt(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments, env={"COLUMNS": "200"})


def simulated(out: Path, *arguments: str) -> dict[str, Any]:
    """Return what a simulation declares."""
    result = hmt("sim", *arguments, "--out", str(out))
    assert result.exit_code == 0, (result.output, result.exception)
    declared: dict[str, Any] = json.loads((out / "world.json").read_text())
    return declared


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("drive")
    simulated(out, *SMALL)
    return out


def test_the_files_hold_what_the_simulation_yields(drive: Path) -> None:
    instants = list(simulate(draw(Family.LONG, 3, areas=4), INDOOR_LASER, 3))
    sent = [reading for instant in instants for reading in instant.readings]
    log = read_log(drive / "log.mcap", min_range_m=0.0, max_range_m=100.0)
    for before, after in zip(sent, log.readings, strict=True):
        assert abs(after.stamp_s - before.stamp_s) <= 0.5e-9
        if isinstance(before, Scan):
            assert isinstance(after, Scan)
            # Half a step of float32 at 20 m.
            np.testing.assert_allclose(after.points_in_body, before.points_in_body, atol=1e-6)
        else:
            assert isinstance(after, OdometryReading)
            np.testing.assert_allclose(after.odom_from_body, before.odom_from_body, atol=1e-12)
    truth = read_tum(drive / "truth.tum")
    for instant, pose in zip(instants, truth, strict=True):
        true = instant.truth.reference_from_body
        np.testing.assert_allclose(pose.reference_from_body, true, atol=1e-8)
    places = (drive / "places.csv").read_text().splitlines()[1:]
    assert [int(line.split(",")[1]) for line in places] == [i.place for i in instants]


def test_world_json_says_everything(drive: Path) -> None:
    declared = json.loads((drive / "world.json").read_text())
    truth = read_tum(drive / "truth.tum")
    positions = np.array([pose.reference_from_body[:3, 3] for pose in truth])
    assert (declared["family"], declared["seed"]) == ("long", 3)
    assert declared["parameters"] == {"areas": 4}
    assert declared["preset"] == "2d"
    assert declared["robot"]["sensor"]["range_sigma_m"] == INDOOR_LASER.sensor.range_sigma_m
    assert declared["robot"]["odometry"]["scale"] == INDOOR_LASER.odometry.scale
    assert declared["scans"] == declared["odometry"] == len(truth)
    assert declared["duration_s"] == pytest.approx(truth[-1].stamp_s)
    length_m = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert declared["length_m"] == pytest.approx(length_m, abs=1e-3)
    assert {path.name for path in drive.iterdir()} == FILES


def test_the_same_seed_and_options_give_the_same_bytes(drive: Path, tmp_path: Path) -> None:
    simulated(tmp_path / "again", *SMALL)
    simulated(tmp_path / "other", *SMALL[:-1], "4")
    for name in FILES:
        content = (drive / name).read_bytes()
        assert (tmp_path / "again" / name).read_bytes() == content
        assert (tmp_path / "other" / name).read_bytes() != content


def test_every_choice_is_declared(tmp_path: Path) -> None:
    choices = (
        "--beams 20 --fov-deg 90 --max-range-m 7 --range-noise-m 0.5 --rate-hz 4 --drop 0.25 "
        "--odometry-scale 1.1 --odometry-drift-deg-per-m 2 --slips-per-100m 50 --people 2"
    )
    declared = simulated(tmp_path, "long", "--areas", "1", *choices.split())
    robot = declared["robot"]
    assert robot["sensor"]["beams"] == 20
    assert robot["sensor"]["field_of_view_rad"] == pytest.approx(math.pi / 2)
    assert robot["sensor"]["max_range_m"] == 7.0
    assert robot["sensor"]["range_sigma_m"] == 0.5
    assert robot["scan_period_s"] == 0.25
    assert robot["drop_share"] == 0.25
    assert robot["odometry"]["scale"] == 1.1
    assert robot["odometry"]["drift_rad_per_m"] == pytest.approx(math.radians(2.0))
    assert robot["odometry"]["slips_per_m"] == 0.5
    assert robot["odometry"]["slip_m"] > 0.0
    assert robot["odometry"]["slip_sigma_rad"] > 0.0
    assert declared["people"] == 2


def test_a_lost_scan_has_no_truth(tmp_path: Path) -> None:
    declared = simulated(tmp_path, *COARSE, "--drop", "0.5")
    assert declared["lost_scans"] > 0
    assert declared["scans"] + declared["lost_scans"] == declared["odometry"]
    log = read_log(tmp_path / "log.mcap", min_range_m=0.0, max_range_m=100.0)
    stamps = [reading.stamp_s for reading in log.readings if isinstance(reading, Scan)]
    assert [pose.stamp_s for pose in read_tum(tmp_path / "truth.tum")] == pytest.approx(stamps)
    assert len(stamps) == declared["scans"]
    assert len((tmp_path / "places.csv").read_text().splitlines()) == 1 + len(stamps)


def test_odometry_can_be_left_out(tmp_path: Path) -> None:
    declared = simulated(tmp_path, *COARSE, "--no-odometry")
    assert (declared["odometry"], declared["robot"]["odometry"]) == (0, None)
    log = read_log(tmp_path / "log.mcap", min_range_m=0.0, max_range_m=100.0)
    assert (log.scans, log.odometry) == (declared["scans"], 0)


def largest_error_m(out: Path, drive: Path) -> float:
    """Return how far a trajectory is from the truth at most, start laid on start."""
    truth, poses = read_tum(drive / "truth.tum"), read_tum(out / "trajectory.tum")
    world_from_start = truth[0].reference_from_body
    assert len(poses) == len(truth)
    return max(
        float(np.linalg.norm((inverse(t) @ world_from_start @ p)[:3, 3]))
        for t, p in zip(
            (pose.reference_from_body for pose in truth),
            (pose.reference_from_body for pose in poses),
            strict=True,
        )
    )


def test_run_maps_a_simulated_laser(drive: Path, tmp_path: Path) -> None:
    result = hmt("run", str(drive / "log.mcap"), "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    assert largest_error_m(tmp_path, drive) < 0.1


def test_run_maps_a_simulated_lidar(tmp_path: Path) -> None:
    lidar = ("--sensor", "lidar", "--columns", "120", "--fov-deg", "28")
    declared = simulated(tmp_path, "long", "--areas", "2", *lidar)
    assert declared["preset"] == "3d-indoor"
    sensor = declared["robot"]["sensor"]
    assert (sensor["columns"], sensor["rows"]) == (120, 16)
    assert sensor["vertical_fov_rad"] == pytest.approx(math.radians(28.0))
    log = read_log(tmp_path / "log.mcap", min_range_m=0.0, max_range_m=100.0)
    scan = next(reading for reading in log.readings if isinstance(reading, Scan))
    assert scan.point_times is not None
    assert len(scan.points_in_body) > 500
    log_file = str(tmp_path / "log.mcap")
    result = hmt("run", log_file, "--preset", "3d-indoor", "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    assert largest_error_m(tmp_path, tmp_path) < 0.3


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ("bogus", "'bogus'; there are office, aliased, "),
        ("office --beams 0", "beams = 0"),
        ("office --range-noise-m -0.1", r"range_sigma_m = -0\.1"),
        ("office --max-range-m nan", "max_range_m = nan"),
        ("office --rate-hz 0", "0 scans per second"),
        ("office --drop 1.5", r"drop_share = 1\.5"),
        ("office --people -1", "-1 people"),
        ("office --rows 4 --columns 9", "a laser has no rows and no columns"),
        ("garage --beams 4", "a lidar has no beams"),
        ("office --areas 3", r"no parameter areas; it has laps \(whole number 1 to 50"),
        ("long --areas 0", "areas is 0, not areas"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path: Path, arguments: str, reason: str
) -> None:
    result = hmt("sim", *arguments.split(), "--out", str(tmp_path / "out"))
    assert isinstance(result.exception, InvalidInput), result.output
    with pytest.raises(InvalidInput, match=reason):
        raise result.exception
    assert not (tmp_path / "out").exists()


def test_a_drive_that_does_not_fit_on_the_disk_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2_000_000_000))
    result = hmt("sim", "long", "--areas", "10000", "--out", str(tmp_path / "a" / "b"))
    assert isinstance(result.exception, InvalidInput)
    assert "GB, and 2.0 GB are free" in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_the_estimate_of_scans_is_near_what_comes(drive: Path) -> None:
    expected = expected_scans(draw(Family.LONG, 3, areas=4), INDOOR_LASER)
    declared = json.loads((drive / "world.json").read_text())
    assert expected == pytest.approx(declared["scans"], rel=0.2)


def test_a_foreign_log_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "log.mcap").write_bytes(b"precious")
    result = hmt("sim", *COARSE, "--out", str(tmp_path))
    assert isinstance(result.exception, InvalidInput)
    assert (tmp_path / "log.mcap").read_bytes() == b"precious"


def test_help_names_every_family_and_parameter() -> None:
    text = " ".join(hmt("sim", "--help").output.split())
    for family, recipe in RECIPES.items():
        assert f"{family}:" in text
        for parameter in recipe.parameters:
            assert f"--{parameter.name.replace('_', '-')}" in text
            assert f"{family} {parameter.low:g} to {parameter.high:g}" in text
