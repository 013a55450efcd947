"""`hmt replay` and everything that asks the daemon, against a running one."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hmt_service.cli.app import app
from hmt_service.cli.plain import to_json
from hmt_service.client import HmtClient
from hmt_service.client.local import free_endpoint
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.errors import NotFound, Unavailable
from hmt_service.io.logs import read_log
from hmt_service.io.mcap_writer import McapWriter
from hmt_service.io.trajectory import read_tum
from tests.flat import SETTINGS, path, ranges_from, readings
from tests.ros import Ros, write_bag2
from tests.service.harness import RunningDaemon, as_received, running_daemon

SCANS = 200
PERIOD_S = 0.1


def write_log(log: Path, scans: int) -> Path:
    """Write a CARMEN log of a drive through the flat; its wheels count from where it starts."""
    bearings = np.linspace(-np.pi / 2, np.pi / 2, 181)
    lines = []
    for index, world_from_body in enumerate(path(scans)):
        ranges = " ".join(f"{r:.4f}" for r in ranges_from(world_from_body, bearings))
        x, y = world_from_body[:2, 3]
        yaw = np.arctan2(world_from_body[1, 0], world_from_body[0, 0])
        pose, stamp_s = f"{x:.5f} {y:.5f} {yaw:.6f}", 1000.0 + index * PERIOD_S
        lines.append(f"FLASER 181 {ranges} {pose} {pose} {stamp_s:.6f} host {stamp_s:.6f}\n")
    log.write_text("".join(lines))
    return log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "flat.log", SCANS)


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory, log: Path) -> Iterator[RunningDaemon]:
    with running_daemon(tmp_path_factory.mktemp("daemon") / "out") as daemon:
        result = hmt(daemon, "replay", str(log))
        assert result.exit_code == 0, result.output
        assert f"{2 * SCANS} readings sent, refused none; {SCANS} scans new" in result.output
        yield daemon


def hmt(daemon: RunningDaemon, *arguments: str) -> Result:
    environment = {"HMT_CONNECT": daemon.endpoint, "COLUMNS": "160"}
    return CliRunner().invoke(app, arguments, env=environment)


def shown(daemon: RunningDaemon, *arguments: str) -> str:
    result = hmt(daemon, *arguments)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_replayed_log_makes_the_map_of_the_offline_run(daemon: RunningDaemon, log: Path) -> None:
    config = load_config(text=SETTINGS)
    sensor = config.sensor
    readings = read_log(
        log, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m
    ).readings
    odometry, engine = Odometry(config), Engine(config)
    for reading in readings:
        if (tracking := odometry.process(as_received(reading, sensor))) is not None:
            engine.process(tracking)
    engine.finish()
    saved = read_tum(daemon.out / "trajectory.tum")
    assert len(saved) == SCANS
    for mine, theirs in zip(saved, engine.trajectory(), strict=True):
        np.testing.assert_allclose(mine.reference_from_body, theirs.reference_from_body, atol=1e-8)


def test_status_shows_counters_and_processes(daemon: RunningDaemon) -> None:
    text = shown(daemon, "status")
    assert f"{2 * SCANS} samples" in text
    assert "topology" in text
    assert json.loads(shown(daemon, "status", "--json"))["input"]["accepted"] == 2 * SCANS


def test_pose_shows_area_and_uncertainty(daemon: RunningDaemon) -> None:
    answer = json.loads(shown(daemon, "pose", "--json"))
    assert answer["stamp_s"] == pytest.approx(1000.0 + (SCANS - 1) * PERIOD_S)
    assert len(answer["area_from_body"]["covariance"]) == 36
    assert "±" in shown(daemon, "pose")


def test_posterior_shows_hypotheses_whose_probabilities_sum_to_one(daemon: RunningDaemon) -> None:
    answer = json.loads(shown(daemon, "posterior", "--json"))
    assert sum(h["probability"] for h in answer["hypotheses"]) == pytest.approx(1.0)
    assert "loop closures" in shown(daemon, "posterior")


def test_posterior_over_time_is_shown_and_drawn(daemon: RunningDaemon, tmp_path: Path) -> None:
    path = tmp_path / "posterior.png"
    assert shown(daemon, "posterior", "--out", str(path)) == ""
    assert path.read_bytes().startswith(b"\x89PNG")
    saved = json.loads(shown(daemon, "posterior", str(daemon.out), "--json"))
    with HmtClient(daemon.endpoint) as client:
        live = client.history().beliefs
    assert json.loads(to_json(live)) == saved
    assert all(sum(belief["current_area"].values()) == pytest.approx(1.0) for belief in saved)


def test_events_are_those_that_the_run_has_saved(daemon: RunningDaemon) -> None:
    live, saved = (
        json.loads(shown(daemon, "events", *where, "--kind", "area_entered", "--json"))
        for where in ((), (str(daemon.out),))
    )
    assert live == saved
    assert all(event["numbers"]["hypotheses"] >= 1.0 for event in live)
    assert "effective_sample_size" in shown(daemon, "events")


def test_a_folder_without_events_is_not_found(tmp_path: Path) -> None:
    for command in ("events", "posterior"):
        result = CliRunner().invoke(app, [command, str(tmp_path)])
        assert result.exit_code != 0
        assert "cannot be read" in str(result.exception)


def test_areas_map_and_compare_show_every_area(daemon: RunningDaemon) -> None:
    areas = [area["area"] for area in json.loads(shown(daemon, "areas", "--json"))["areas"]]
    for command in ("map", "compare"):
        answer = json.loads(shown(daemon, command, "--json", "--reference", str(areas[-1])))
        assert answer["reference_area"] == areas[-1]
        assert [area["area"] for area in answer["areas"]] == areas
    assert "shortest_path map" in shown(daemon, "map", "--method", "shortest_path")
    assert "neighbours" in shown(daemon, "areas")
    assert "contradiction" in shown(daemon, "compare")


def test_map_draws_a_figure(daemon: RunningDaemon, tmp_path: Path) -> None:
    figure = tmp_path / "map.png"
    shown(daemon, "map", "--out", str(figure))
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_an_unknown_area_is_an_error_with_its_number(daemon: RunningDaemon) -> None:
    result = hmt(daemon, "map", "--reference", "4711")
    assert isinstance(result.exception, NotFound)
    assert "4711" in str(result.exception)


def test_a_log_replayed_twice_is_refused_as_old(daemon: RunningDaemon, log: Path) -> None:
    result = hmt(daemon, "replay", str(log))
    assert result.exit_code == 0
    # Only what is as old as the last reading may be a second sensor's.
    assert f"refused {2 * SCANS - 2} time_backwards; 1 scans new" in result.output


def test_ctl_saves_and_finishes(daemon: RunningDaemon) -> None:
    for command in ("save", "finish"):
        (daemon.out / "map.hmt").unlink(missing_ok=True)
        assert "map.hmt" in shown(daemon, "ctl", command)
        assert (daemon.out / "map.hmt").exists()


def test_replay_keeps_the_pace_that_it_is_told(tmp_path: Path) -> None:
    scans, rate = 200, 10.0
    log = write_log(tmp_path / "flat.log", scans)
    with running_daemon(tmp_path / "out") as daemon:
        started_s = time.monotonic()
        # A hundred scans and as many odometry readings per second.
        result = hmt(daemon, "replay", str(log), "--rate", str(rate))
        assert time.monotonic() - started_s >= (scans - 1) * PERIOD_S / rate
    assert f"{2 * scans} readings sent, refused none; {scans} scans new" in result.output


def test_an_mcap_log_is_replayed_as_it_is_read(tmp_path: Path) -> None:
    log = tmp_path / "flat.mcap"
    with log.open("wb") as file:
        writer = McapWriter(file)
        for reading in readings(60):
            writer.write(reading)
        writer.finish()
    log.write_bytes(log.read_bytes()[:-1000])
    with running_daemon(tmp_path / "out") as daemon:
        result = hmt(daemon, "replay", str(log))
    assert "60 scans, 60 odometry readings" in result.output
    assert "120 readings sent, refused none; 60 scans new" in result.output
    assert "malformed and left out: 1" in result.output
    assert "the file ends or cannot be read from here on" in result.output


def test_a_bag_of_ros_is_replayed(tmp_path: Path) -> None:
    bag = write_bag2(tmp_path / "flat", Ros().drive(30))
    with running_daemon(tmp_path / "out") as daemon:
        result = hmt(daemon, "replay", str(bag), "--sensor-pose", *"000000")
    assert "30 scans, 30 odometry readings" in result.output
    assert "60 readings sent, refused none; 30 scans new" in result.output


def test_a_command_without_daemon_says_where_it_looked() -> None:
    endpoint = free_endpoint()
    result = CliRunner().invoke(app, ["pose", "--connect", endpoint, "--timeout", "0.5"])
    assert isinstance(result.exception, Unavailable)
    assert endpoint in str(result.exception)


def test_ctl_shutdown_ends_the_daemon(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon:
        assert "0 samples received" in shown(daemon, "ctl", "shutdown")
        assert "stopped by a client" in daemon.output()
