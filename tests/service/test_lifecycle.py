"""How the daemon starts and ends, with `hmt serve` in a process of its own."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.cli.serve import PROCESS_FAILED
from hmt_service.client import HmtClient
from hmt_service.client.local import free_endpoint
from hmt_service.core.config import Preset
from hmt_service.core.types import Event, EventKind
from hmt_service.errors import DaemonFailure, HmtError, Unavailable
from hmt_service.io.trajectory import read_tum
from hmt_service.runtime.messages import ProcessName
from hmt_service.service.codec import decode
from hmt_service.service.keys import Call, Keys, Topic
from hmt_service.service.reports import DaemonState
from hmt_service.service.session import Endpoints, Mode, open_session
from tests.flat import readings
from tests.service.harness import RunningDaemon, running_daemon, wait_until

FILES = ["events.jsonl", "map.hmt", "posterior.jsonl", "summary.json", "trajectory.tum"]
SURPLUS = 3000
"""Scans that take longer than the daemon has for them when it is told to stop."""


def publish(client: HmtClient, scans: int) -> None:
    for reading in readings(scans):
        client.publish(reading)
    # What was sent before a question has arrived before its answer.
    assert client.status().input.received == 2 * scans


def pid_of(client: HmtClient, name: ProcessName) -> int:
    return next(process.pid for process in client.status().processes if process.name == name)


def is_alive(pid: int) -> bool:
    try:
        # A dead child of a dead parent may wait for init as a zombie.
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_daemon_in_time_with_everything_saved(
    tmp_path: Path, number: signal.Signals
) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, 100)
        started_s = time.monotonic()
        daemon.process.send_signal(number)
        output = daemon.output()
        assert time.monotonic() - started_s < 5.0
    assert daemon.process.returncode == 0
    assert f"stopped by {number.name}: 200 samples received, refused none" in output
    assert "100 scans in the map, 0 samples not in it" in output
    assert sorted(path.name for path in daemon.out.iterdir()) == FILES
    assert len(read_tum(daemon.out / "trajectory.tum")) == 100
    assert json.loads((daemon.out / "summary.json").read_text())["scans"] == 100


def test_a_signal_to_the_whole_group_is_left_to_the_parent(tmp_path: Path) -> None:
    """A terminal and systemd signal the children too."""
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, 40)
        for name in (ProcessName.ODOMETRY, ProcessName.TOPOLOGY):
            os.kill(pid_of(client, name), signal.SIGTERM)
            os.kill(pid_of(client, name), signal.SIGINT)
        daemon.process.terminate()
        assert "40 scans in the map" in daemon.output()
    assert daemon.process.returncode == 0


def test_more_input_than_time_is_counted_and_the_rest_saved(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, SURPLUS)
        started_s = time.monotonic()
        daemon.process.terminate()
        output = daemon.output()
        assert time.monotonic() - started_s < 5.0
    mapped = len(read_tum(daemon.out / "trajectory.tum"))
    assert 0 < mapped < SURPLUS
    assert f"{mapped} scans in the map" in output
    # Neither lost nor counted twice: a scan is one sample, and so is its odometry.
    missing = re.search(r"(\d+) samples not in it", output)
    assert missing is not None
    assert SURPLUS - mapped <= int(missing[1]) <= 2 * (SURPLUS - mapped)
    assert daemon.process.returncode == 0


def test_a_daemon_without_input_stops_without_error(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon:
        daemon.process.terminate()
        assert "nothing to save" in daemon.output()
    assert daemon.process.returncode == 0


def test_a_daemon_that_still_loads_can_be_stopped(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out", is_awaited=False) as daemon:
        assert daemon.process.stderr is None
        assert daemon.process.stdout is not None
        assert "serving" in daemon.process.stdout.readline()
        started_s = time.monotonic()
        daemon.process.terminate()
        daemon.output()
        assert time.monotonic() - started_s < 5.0
    assert daemon.process.returncode == 0


def test_a_client_can_stop_the_daemon(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, 20)
        assert client.shut_down().received == 40
        assert "stopped by a client: 40 samples received" in daemon.output()
    assert daemon.process.returncode == 0


@pytest.mark.parametrize("name", [ProcessName.ODOMETRY, ProcessName.TOPOLOGY])
def test_another_process_takes_the_place_of_one_that_was_killed(
    tmp_path: Path, name: ProcessName
) -> None:
    with (
        running_daemon(tmp_path / "out") as daemon,
        daemon.client() as client,
        recorded_events(daemon) as events,
    ):
        publish(client, 60)
        pid = pid_of(client, name)
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: pid_of(client, name) != pid)
        # Who asks where the robot is gets an answer meanwhile.
        assert client.pose().stamp_s >= readings(1)[0].stamp_s
        wait_until(lambda: client.status().state is DaemonState.RUNNING)
        assert {p.name: p.restarts for p in client.status().processes}[name] == 1
        for reading in readings(100)[120:]:
            client.publish(reading)
        assert client.finish().processed_scans == 100
        daemon.process.terminate()
        output = daemon.output()
    assert daemon.process.returncode == 0
    assert "100 scans in the map, 0 samples not in it" in output
    reason = f"process {name} (pid {pid}) was killed by SIGKILL: another one goes on where it was"
    failed, restarted = (e for e in events if e.kind.startswith("process_"))
    assert (failed.kind, failed.message) == (EventKind.PROCESS_FAILED, reason)
    assert restarted.kind is EventKind.PROCESS_RESTARTED
    assert 0.0 < restarted.numbers["outage_s"] < 20.0
    assert len(read_tum(daemon.out / "trajectory.tum")) == 100


def test_a_daemon_ends_when_no_process_gets_ready(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, 60)
        client.finish()
        for path in daemon.out.iterdir():
            path.unlink()
        killed: set[int] = set()
        while daemon.process.poll() is None and len(killed) < 6:
            with suppress(HmtError, ProcessLookupError):
                pid = pid_of(client, ProcessName.ODOMETRY)
                if pid > 0 and pid not in killed:
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
        output = daemon.output()
    assert daemon.process.returncode == PROCESS_FAILED
    assert re.search(r"stopped by process odometry \(pid \d+\) was killed by SIGKILL", output)


@contextmanager
def recorded_events(daemon: RunningDaemon) -> Iterator[list[Event]]:
    """Collect what the daemon publishes as events."""
    events: list[Event] = []

    def take(sample: zenoh.Sample) -> None:
        event = decode(sample.payload.to_bytes(), str(sample.encoding))
        assert isinstance(event, Event)
        events.append(event)

    endpoints = Endpoints(mode=Mode.CLIENT, connect=(daemon.endpoint,))
    with open_session(endpoints) as session:
        session.declare_subscriber(Keys("site", "robot").topic(Topic.EVENT), take)
        # The subscription is known to the daemon when this later message has come back.
        list(session.get(Keys("site", "robot").call(Call.STATUS)))
        yield events


def test_a_wrong_preset_is_doubted_in_the_log_on_the_wire_and_in_the_summary(
    tmp_path: Path,
) -> None:
    scans = 600  # 60 m with a keyframe per metre; the first verdict takes 40
    with (
        running_daemon(tmp_path / "out", preset=Preset.INDOOR) as daemon,
        daemon.client() as client,
        recorded_events(daemon) as published,
    ):
        publish(client, scans)
        client.finish()
        (kept,) = [e for e in client.events() if e.kind is EventKind.PRESET_DOUBTED]
        wait_until(lambda: kept in published)
        daemon.process.terminate()
        output = daemon.output()
    assert daemon.process.returncode == 0
    assert [e for e in published if e.kind is EventKind.PRESET_DOUBTED] == [kept]
    assert kept.message.startswith("preset 3d-indoor expects heights")
    assert kept.numbers["keyframes"] == 40.0
    assert output.count("WARNING preset_doubted: preset 3d-indoor expects") == 1
    assert json.loads((daemon.out / "summary.json").read_text())["warnings"] == [kept.message]


def test_children_end_when_the_parent_is_killed(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, 40)
        pids = [process.pid for process in client.status().processes]
        daemon.process.kill()
        wait_until(lambda: not any(map(is_alive, pids)), timeout_s=5.0)


@pytest.mark.parametrize("name", [ProcessName.ODOMETRY, ProcessName.TOPOLOGY])
def test_a_call_that_waits_while_a_process_dies_is_answered(
    tmp_path: Path, name: ProcessName
) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        publish(client, 1000)
        pid = pid_of(client, name)
        with ThreadPoolExecutor(max_workers=1) as pool:
            waiting = pool.submit(client.finish, timeout_s=60.0)
            wait_until(lambda: client.status().processed_scans > 0)
            os.kill(pid, signal.SIGKILL)
            assert waiting.result(timeout=60.0).processed_scans == 1000


def test_a_daemon_serves_through_a_router(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config), running_daemon(tmp_path / "out", router=endpoint) as daemon:
        with daemon.client() as client:
            publish(client, 50)
            # Through the router, too, a question does not overtake what was sent before it.
            assert client.finish().processed_scans == 50
        result = CliRunner().invoke(app, ["serve", "--connect", endpoint])
        assert isinstance(result.exception, DaemonFailure)


def test_a_second_daemon_of_the_same_robot_or_endpoint_is_refused(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon:
        result = CliRunner().invoke(app, ["serve", "--connect", daemon.endpoint])
        assert isinstance(result.exception, DaemonFailure)
        assert "another daemon" in str(result.exception)
        result = CliRunner().invoke(app, ["serve", "--robot", "two", "--listen", daemon.endpoint])
        assert isinstance(result.exception, Unavailable)
        assert daemon.endpoint in str(result.exception)
        with daemon.client() as client:
            assert client.status().state is DaemonState.RUNNING
