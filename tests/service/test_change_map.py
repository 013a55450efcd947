"""What an operator can do with the map of a running daemon: leave it, empty it, seek the robot."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from hmt_service.client import HmtClient
from hmt_service.core.geometry import inverse
from hmt_service.core.types import EventKind
from hmt_service.errors import HmtError, InvalidInput, NotFound, Unavailable
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import read_map, write_map
from tests.flat import path, readings
from tests.mapped import map_file_in, mapped
from tests.service.harness import running_daemon, wait_until

SCANS = 120
RESULTS = ("trajectory.tum", "map.hmt", "events.jsonl", "posterior.jsonl", "summary.json")


def publish(client: HmtClient, *, later_s: float) -> None:
    """Send a drive from the left room to the right one, and wait until it is in the map."""
    before = client.status().processed_scans
    for reading in readings(SCANS):
        client.publish(replace(reading, stamp_s=reading.stamp_s + later_s))
    wait_until(lambda: client.status().processed_scans == before + SCANS)


def test_a_daemon_goes_from_map_to_map(tmp_path: Path) -> None:
    shutil.copy(map_file_in(tmp_path), tmp_path / "other.hmt")
    known = tmp_path / "known.hmt"
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        publish(client, later_s=0.0)
        assert client.load("other.hmt").files == (str(known), *RESULTS)
        assert len(read_map(known).scans) == SCANS
        # The robot is somewhere in the other map, and finds out where.
        wait_until(lambda: client.status().keyframes == len(mapped().stored().keyframes))
        with pytest.raises(Unavailable, match="no pose yet"):
            client.pose()
        publish(client, later_s=1e4)
        (lost,) = [e for e in client.events() if e.kind is EventKind.LOST]
        assert "a new session begins" in lost.message
        pose, truth = client.pose().reference_from_body, inverse(path(1)[0]) @ path(SCANS)[-1]
        assert pose.mean[:2, 3] == pytest.approx(truth[:2, 3], abs=0.1)
        assert client.load("known.hmt").files[0] == str(tmp_path / "other.hmt")
        publish(client, later_s=2e4)
        client.finish()
    assert check_map(known) == check_map(tmp_path / "other.hmt") == ()
    assert len(read_map(known).scans) == 2 * SCANS


def test_a_reset_sets_the_file_aside_and_begins_anew(tmp_path: Path) -> None:
    known = tmp_path / "known.hmt"
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        assert client.reset().files == ()
        for number in (1, 2):
            publish(client, later_s=1e4 * number)
            assert client.reset().files == (str(tmp_path / f"known-{number}.hmt"),)
            assert not known.exists()
            wait_until(lambda: client.status().keyframes == 0)
        publish(client, later_s=3e4)
        assert client.status().processed_scans == 3 * SCANS
        assert str(known) in client.save().files
        assert client.pose().reference_area == 0
    for file in (known, tmp_path / "known-1.hmt", tmp_path / "known-2.hmt"):
        assert check_map(file) == ()
        held = read_map(file)
        assert len(held.scans) == SCANS
        assert [k.failure for k in held.keyframes] == [None] * len(held.keyframes)


def test_a_robot_that_was_carried_is_sought_where_it_may_be(tmp_path: Path) -> None:
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        with pytest.raises(Unavailable, match="no map yet"):
            client.relocalize()
        publish(client, later_s=0.0)
        before = client.status()
        assert client.relocalize().processed_scans == SCANS
        assert client.status().keyframes == before.keyframes
        # Back at the start without having driven there: by the wheels it stands in the other room.
        publish(client, later_s=1e3)
        (lost,) = [e for e in client.events() if e.kind is EventKind.LOST]
        assert "may be anywhere" in lost.message
        pose, truth = client.pose().reference_from_body, inverse(path(1)[0]) @ path(SCANS)[-1]
        assert pose.mean[:2, 3] == pytest.approx(truth[:2, 3], abs=0.1)
        assert max(client.posterior().current_area.values()) > 0.8


@pytest.mark.parametrize(
    ("tell", "kind", "words"),
    [
        (lambda c: c.load("nothing.hmt"), NotFound, "nothing.hmt does not exist"),
        (lambda c: c.load("../known.hmt"), InvalidInput, "not the name of a file"),
        (lambda c: c.load("known.hmt"), InvalidInput, "already"),
        (lambda c: c.load("settings.yaml"), InvalidInput, "not the name of a file"),
        (lambda c: c.load("broken.hmt"), InvalidInput, "broken.hmt"),
        (lambda c: c.load("different.hmt"), InvalidInput, "other settings"),
    ],
)
def test_a_map_that_cannot_be_gone_on_with_leaves_the_one_that_there_is(
    changing: tuple[HmtClient, Path],
    tell: Callable[[HmtClient], object],
    kind: type[HmtError],
    words: str,
) -> None:
    client, folder = changing
    (folder / "broken.hmt").write_bytes(b"no map")
    stored = mapped().stored()
    config = stored.config
    other = config.model_copy(
        update={"particles": config.particles.model_copy(update={"budget": 7})}
    )
    write_map(folder / "different.hmt", replace(stored, config_json=other.model_dump_json()))
    before = client.status()
    with pytest.raises(kind, match=words):
        tell(client)
    after = client.status()
    assert [p.pid for p in after.processes] == [p.pid for p in before.processes]
    assert after.keyframes == before.keyframes > 0


@pytest.fixture(scope="module")
def changing(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[HmtClient, Path]]:
    folder = tmp_path_factory.mktemp("maps")
    known = map_file_in(folder).rename(folder / "known.hmt")
    with running_daemon(folder / "out", map_file=known) as daemon, daemon.client() as client:
        yield client, folder


def test_a_frozen_map_stays(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    with (
        running_daemon(tmp_path / "out", map_file=known, options=["--frozen"]) as daemon,
        daemon.client() as client,
        pytest.raises(InvalidInput, match="frozen"),
    ):
        client.reset()
    assert known.exists()


def test_what_had_arrived_before_a_map_was_left_is_in_it(tmp_path: Path) -> None:
    shutil.copy(map_file_in(tmp_path), tmp_path / "other.hmt")
    before = len(read_map(tmp_path / "other.hmt").scans)
    known = tmp_path / "known.hmt"
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        for reading in readings(600):
            client.publish(reading)
        assert client.load("other.hmt").processed_scans == 600
        # At rest, in one file.
        assert {file.name for file in tmp_path.glob("known*")} == {"known.hmt"}
        assert len(read_map(known).scans) == 600
        publish(client, later_s=1e5)
        client.finish()
    assert len(read_map(tmp_path / "other.hmt").scans) == before + SCANS


def test_a_damaged_or_empty_map_is_not_gone_on_with(changing: tuple[HmtClient, Path]) -> None:
    client, folder = changing
    with closing(sqlite3.connect(map_file_in(folder).rename(folder / "flipped.hmt"))) as database:
        database.execute("UPDATE scans SET stamp_s = stamp_s + 1 WHERE rowid = 7")
        database.commit()
    write_map(folder / "empty.hmt", replace(mapped().stored(), visits=(), hypotheses=()))
    for name, words in (("flipped.hmt", "flipped"), ("empty.hmt", "empty")):
        with pytest.raises(InvalidInput, match=words):
            client.load(name)
    assert client.status().keyframes > 0


def test_a_reset_takes_a_link_and_a_relative_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "disk").mkdir()
    real = map_file_in(tmp_path / "disk")
    (tmp_path / "site.hmt").symlink_to(real)
    monkeypatch.chdir(tmp_path)
    with (
        running_daemon(tmp_path / "out", map_file=Path("site.hmt")) as daemon,
        daemon.client() as client,
    ):
        held = client.status().keyframes
        assert client.reset().files == (str(real.with_name("map-1.hmt")),)
        wait_until(lambda: client.status().keyframes == 0)
        with pytest.raises(Unavailable):
            client.posterior()
        publish(client, later_s=1e4)
        client.finish()
    assert (tmp_path / "site.hmt").is_symlink()
    assert len(read_map(real.with_name("map-1.hmt")).keyframes) == held
    assert len(read_map(real).scans) == SCANS
