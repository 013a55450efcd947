"""The map file of a daemon: what is said to be stored survives anything, and goes on."""

from __future__ import annotations

import json
import os
import resource
import signal
import sqlite3
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.cli.serve import NOT_SAVED
from hmt_service.client import HmtClient
from hmt_service.core.config import load_config
from hmt_service.core.geometry import inverse
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import EventKind, Scan, TrackingFailure
from hmt_service.errors import InvalidInput
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import read_map, write_map
from hmt_service.runtime.messages import ProcessName
from hmt_service.service.kept_map import KeptMap
from tests.flat import path, readings
from tests.mapped import map_file_in, mapped
from tests.service.harness import running_daemon, wait_until

KILLS = 2
CHILD_KILLS = 6


def publish(client: HmtClient, first: int, last: int, *, later_s: float = 0.0) -> None:
    for reading in list(readings(last))[2 * first : 2 * last]:
        client.publish(replace(reading, stamp_s=reading.stamp_s + later_s))


def is_replaced(client: HmtClient, pid: int) -> bool:
    return pid not in {process.pid for process in client.status().processes}


def wait_for(client: HmtClient, count: str, least: int) -> None:
    wait_until(lambda: getattr(client.status(), count) >= least)


def test_what_is_stored_survives_a_kill_of_everything_at_any_moment(tmp_path: Path) -> None:
    rng, known = np.random.default_rng(3), tmp_path / "known.hmt"
    stored = 0
    for kill in range(KILLS):
        with (
            running_daemon(tmp_path / "out", map_file=known) as daemon,
            daemon.client() as client,
        ):
            publish(client, 0, 100, later_s=1e4 * kill)
            wait_for(client, "stored_keyframes", stored + 1)
            publish(client, 100, 300, later_s=1e4 * kill)
            wait_for(client, "processed_scans", 101 + int(rng.integers(0, 200)))
            status = client.status()
            stored = status.stored_keyframes
            daemon.process.kill()
            for process in status.processes:
                os.kill(process.pid, signal.SIGKILL)
            daemon.process.wait(10.0)
        assert check_map(known) == ()
        held = read_map(known)
        assert len(held.keyframes) >= stored > 0
    # Every daemon went on with what the one before had stored.
    begun = [k for k in held.keyframes if k.failure is TrackingFailure.NEW_SESSION]
    assert len(begun) == KILLS - 1


def test_the_map_is_whole_whichever_child_dies_at_any_moment(tmp_path: Path) -> None:
    rng, known = np.random.default_rng(4), tmp_path / "known.hmt"
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        for kill in range(CHILD_KILLS):
            publish(client, 50 * kill, 50 * kill + 50)
            wait_for(client, "processed_scans", 50 * kill + int(rng.integers(1, 50)))
            victim = client.status().processes[kill % 2]
            os.kill(victim.pid, signal.SIGKILL)
            wait_until(partial(is_replaced, client, victim.pid))
        assert client.finish().processed_scans == 50 * CHILD_KILLS
        assert sum(process.restarts for process in client.status().processes) == CHILD_KILLS
        daemon.process.terminate()
        daemon.output()
    assert daemon.process.returncode == 0
    assert check_map(known) == ()
    held = read_map(known)
    assert [k.failure for k in held.keyframes] == [None] * len(held.keyframes)
    scans = [r.stamp_s for r in readings(50 * CHILD_KILLS) if isinstance(r, Scan)]
    assert [scan.stamp_s for scan in held.scans] == scans


def test_a_daemon_goes_on_with_a_map_and_says_where_it_is(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    before = read_map(known)
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        publish(client, 0, 120, later_s=1e4)
        wait_until(lambda: client.status().processed_scans == 120)
        (lost,) = [e for e in client.events() if e.kind is EventKind.LOST]
        assert "new session" in lost.message
        # It woke up where the map began, and has gone to the other room.
        assert max(client.posterior().current_area.values()) > 0.8
        pose, truth = client.pose().reference_from_body, inverse(path(120)[0]) @ path(120)[-1]
        assert pose.mean[:2, 3] == pytest.approx(truth[:2, 3], abs=0.1)
        assert pose.sigma_m < 0.5
        assert str(known) in client.save().files
    after = read_map(known)
    assert len(after.keyframes) > len(before.keyframes)
    assert after.config_json == before.config_json
    assert check_map(known) == ()


def test_a_map_file_that_cannot_be_written_is_an_event_and_keeps_what_it_held(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    known = map_file_in(folder)
    before = known.read_bytes()
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        # Nothing can be put beside it, not even by root.
        (folder / f"{known.name}-wal").mkdir()
        publish(client, 0, 100, later_s=1e4)
        wait_until(lambda: any(e.kind is EventKind.NOT_SAVED for e in client.events()))
        status = client.status()
        assert status.stored_keyframes == len(mapped().stored().keyframes)
        assert status.processed_scans > 0
    (folder / f"{known.name}-wal").rmdir()
    assert known.read_bytes() == before


def test_a_daemon_whose_disk_was_full_catches_up_when_there_is_room(tmp_path: Path) -> None:
    known = tmp_path / "known.hmt"
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        publish(client, 0, 100)
        wait_for(client, "stored_keyframes", 1)
        pids = {process.name: process.pid for process in client.status().processes}
        topology = pids[ProcessName.TOPOLOGY]
        before = resource.prlimit(topology, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
        further = count(100)

        def is_told() -> bool:
            # What is said of the file comes with the answer to a scan.
            scan = next(further)
            publish(client, scan, scan + 1)
            return any(e.kind is EventKind.NOT_SAVED for e in client.events())

        wait_until(is_told)
        stored = client.status().stored_keyframes
        assert len(read_map(known).keyframes) == stored < client.status().keyframes
        resource.prlimit(topology, resource.RLIMIT_FSIZE, before)
        wait_until(lambda: is_told() and client.status().stored_keyframes > stored)
    assert check_map(known) == ()


def test_of_two_daemons_on_one_map_the_second_to_write_says_so(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    first, second = (running_daemon(tmp_path / name / "out", map_file=known) for name in "ab")
    for name in "ab":
        (tmp_path / name).mkdir()
    with first as one, second as other, one.client() as to_one, other.client() as to_other:
        keyframes = len(read_map(known).keyframes)
        publish(to_one, 0, 50, later_s=1e4)
        wait_for(to_one, "stored_keyframes", keyframes + 1)
        publish(to_other, 0, 50, later_s=1e4)
        wait_until(lambda: any(e.kind is EventKind.NOT_SAVED for e in to_other.events()))
        (refused, *_) = [e for e in to_other.events() if e.kind is EventKind.NOT_SAVED]
        assert "another program has written" in refused.message
        # The first one goes on, and its map is read by others meanwhile.
        publish(to_one, 50, 150, later_s=1e4)
        wait_until(lambda: to_one.status().processed_scans == 150)
        to_one.save()
        assert not any(e.kind is EventKind.NOT_SAVED for e in to_one.events())
        assert check_map(known) == ()
        assert len(read_map(known).keyframes) == to_one.status().keyframes


def test_a_daemon_that_ends_leaves_one_file_which_may_be_among_its_results(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    known = out / "map.hmt"
    with running_daemon(out, map_file=known) as daemon, daemon.client() as client:
        publish(client, 0, 100)
        wait_until(lambda: client.status().processed_scans == 100)
        keyframes = client.status().keyframes
        daemon.process.terminate()
        assert "saved" in daemon.output()
    assert daemon.process.returncode == 0
    assert [path.name for path in out.glob("map*")] == ["map.hmt"]
    assert len(read_map(known).keyframes) == keyframes
    assert check_map(known) == ()


def test_a_daemon_with_a_memory_budget_begins_a_map_and_goes_on_with_it(tmp_path: Path) -> None:
    known, out = tmp_path / "known.hmt", tmp_path / "out"
    for session in range(2):
        with (
            running_daemon(out, map_file=known, options=["--memory-budget", "40MB"]) as daemon,
            daemon.client() as client,
        ):
            publish(client, 0, 100, later_s=1e4 * session)
            wait_until(lambda: client.status().processed_scans == 100)
            client.save()
    summary = json.loads((out / "summary.json").read_text())
    assert 0.0 < summary["submaps_mb"]["memory"] < 40.0
    assert len(read_map(known).scans) == 200


def test_results_that_cannot_be_saved_do_not_keep_the_map_back(tmp_path: Path) -> None:
    known, out = tmp_path / "known.hmt", tmp_path / "out"
    out.write_text("a file where the folder should be")
    with running_daemon(out, map_file=known) as daemon, daemon.client() as client:
        publish(client, 0, 100)
        wait_until(lambda: client.status().processed_scans == 100)
        keyframes = client.status().keyframes
        daemon.process.terminate()
        assert "not saved" in daemon.output()
    assert daemon.process.returncode == NOT_SAVED
    assert len(read_map(known).keyframes) == keyframes


@pytest.mark.parametrize("command", ["serve", "run"])
def test_a_file_that_is_no_map_of_this_version_is_refused_and_left_alone(
    tmp_path: Path, command: str
) -> None:
    known = map_file_in(tmp_path)
    damaged = known.read_bytes()[:-3000]
    known.write_bytes(damaged)
    log = [str(tmp_path / "log.mcap"), "--out", str(tmp_path / "out")] if command == "run" else []
    result = CliRunner().invoke(app, [command, *log, "--map", str(known)])
    assert result.exit_code != 0
    assert result.exception is not None
    assert "no map file or damaged" in str(result.exception)
    assert known.read_bytes() == damaged


def test_a_frozen_map_is_only_read(tmp_path: Path) -> None:
    known, out = map_file_in(tmp_path), tmp_path / "out"
    before, keyframes = known.read_bytes(), len(mapped().stored().keyframes)
    with (
        running_daemon(out, map_file=known, options=["--frozen"]) as daemon,
        daemon.client() as client,
    ):
        # What the map is, is known before anything comes.
        wait_for(client, "keyframes", keyframes)
        publish(client, 0, 120, later_s=1e4)
        wait_for(client, "processed_scans", 120)
        status, pose = client.status(), client.pose()
        assert status.stored_keyframes == keyframes < status.keyframes
        assert status.localization is not None
        assert status.localization.probability > 0.8
        assert pose.localization.evidence_stamp_s == pytest.approx(pose.stamp_s, abs=3.0)
        assert "map.hmt" not in client.save().files
    assert known.read_bytes() == before
    assert not (out / "map.hmt").exists()


@pytest.mark.parametrize("command", ["serve", "run"])
def test_only_a_map_that_there_is_can_be_frozen(tmp_path: Path, command: str) -> None:
    log = [str(tmp_path / "log.mcap"), "--out", str(tmp_path / "out")] if command == "run" else []
    nothing = CliRunner().invoke(app, [command, *log, "--frozen"])
    assert "--frozen needs the map that --map names" in str(nothing.exception)
    missing = ["--map", str(tmp_path / "no.hmt"), "--frozen"]
    assert "no.hmt does not exist" in str(
        CliRunner().invoke(app, [command, *log, *missing]).exception
    )


def test_damage_that_only_the_digest_shows_is_refused(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    with closing(sqlite3.connect(known)) as database:
        database.execute("UPDATE keyframes SET stamp_s = stamp_s + 1e-6 WHERE keyframe = 3")
        database.commit()
    with pytest.raises(InvalidInput, match="is damaged"):
        KeptMap(known).engine(load_config(), seed=0)


def test_a_link_to_a_map_stays_a_link(tmp_path: Path) -> None:
    known, link = map_file_in(tmp_path), tmp_path / "link.hmt"
    link.symlink_to(known)
    before = known.read_bytes()
    with closing(KeptMap(link)) as kept:
        engine = kept.engine(load_config(), seed=0)
        tracking = Odometry(read_map(known).config).process(readings(1)[1])
        assert tracking is not None
        engine.process(tracking)
        kept.write(engine)
    assert link.is_symlink()
    assert known.read_bytes() != before
    assert read_map(known).revision == mapped().stored().revision + 1


def test_settings_of_a_map_that_goes_on_are_its_own(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    result = CliRunner().invoke(app, ["serve", "--map", str(known), "--preset", "2d"])
    assert "has settings of its own" in str(result.exception)


def test_a_map_written_again_is_the_same_file(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    written = known.read_bytes()
    write_map(known, read_map(known))
    assert known.read_bytes() == written
