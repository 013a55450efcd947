"""The map file that grows: what is committed survives anything, and only what is new is written."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from hmt_service.core.chunked import Chunked
from hmt_service.core.config import Preset, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredMap
from hmt_service.core.types import Keyframe
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import opened, read_map, write_map
from hmt_service.io.map_info import map_info
from hmt_service.io.map_rows import SCHEMA_VERSION, TABLES, content_digest
from hmt_service.io.map_store import MapStore
from tests.flat import readings
from tests.io.growing import part_of
from tests.io.test_map_file import assert_same_map, random_map
from tests.mapped import map_file_in

GOLDEN = Path(__file__).parent / "golden"
KILLS = 5


def content(path: Path) -> list[list[tuple[object, ...]]]:
    with opened(path) as database:
        return [list(database.execute(f"SELECT * FROM {table} ORDER BY rowid")) for table in TABLES]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@contextmanager
def kept(path: Path) -> Iterator[MapStore]:
    with closing(MapStore(path)) as store:
        yield store


def read(store: MapStore) -> StoredMap | None:
    with store.reading() as stored:
        return None if stored is None else replace(stored, keyframes=tuple(stored.keyframes))


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    """A real limit of the operating system: writing beyond it fails as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_map_that_grew_is_the_one_that_is_written_at_once(tmp_path: Path) -> None:
    grown, whole = tmp_path / "grown.hmt", tmp_path / "whole.hmt"
    # Visits to the same rooms are soon forgotten.
    config = load_config(Preset.PLANAR, "areas: {max_cut: 0.8, max_views: 1}")
    engine, odometry, forgotten = Engine(config), Odometry(config), 0
    with kept(grown) as store:
        for number, reading in enumerate(readings(1300)):
            tracking = odometry.process(reading)
            if tracking is not None:
                engine.process(tracking)
            if number % 111 == 110:
                store.update(engine.stored())
        engine.finish(is_urgent=True)
        store.update(engine.stored())
        forgotten = sum(visit.is_forgotten for visit in engine.stored().visits)
    write_map(whole, engine.stored())
    assert forgotten >= 2
    assert content(grown) == content(whole)
    assert check_map(grown) == ()
    assert names(tmp_path) == ["grown.hmt", "whole.hmt"]


def test_only_what_is_new_is_asked_for(tmp_path: Path) -> None:
    whole, asked = random_map(1, keyframes=400, visits=2), list[int]()

    def chunk(number: int) -> Sequence[Keyframe]:
        asked.append(number)
        return whole.keyframes[10 * number : 10 * number + 10]

    with kept(tmp_path / "map.hmt") as store:
        store.update(replace(whole, keyframes=whole.keyframes[:385], scans=whole.scans[:700]))
        store.update(replace(whole, keyframes=Chunked([10] * 40, chunk)))
    assert set(asked) == {38, 39}
    assert_same_map(read_map(tmp_path / "map.hmt"), whole)


def test_a_visit_that_was_forgotten_loses_what_it_saw(tmp_path: Path) -> None:
    whole = random_map(2)
    path, (first, *others) = tmp_path / "map.hmt", whole.visits
    keyframes = tuple(
        replace(k, points_in_body=k.points_in_body[:0]) if k.index <= first.last_keyframe else k
        for k in whole.keyframes
    )
    later = replace(whole, visits=(replace(first, is_forgotten=True), *others), keyframes=keyframes)
    with kept(path) as store:
        store.update(whole)
        store.update(later)
        store.update(later)
    assert_same_map(read_map(path), later)
    with opened(path) as database:
        assert content_digest(database) == write_map(tmp_path / "other.hmt", later)


def test_hypotheses_may_become_others_and_fewer(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    maps = [random_map(3, hypotheses=count, visits=3) for count in (3, 1, 4, 2)]
    first, *others = [replace(maps[0], hypotheses=each.hypotheses[::-1]) for each in maps]
    with kept(path) as store:
        for each in (first, *others):
            store.update(each)
            assert_same_map(read_map(path), each)


def test_a_map_is_read_while_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "map.hmt"
    whole = read_map(map_file_in(tmp_path))
    with kept(tmp_path / "live.hmt") as store:
        path = tmp_path / "live.hmt"
        store.update(part_of(whole, 20))
        store.update(part_of(whole, 30))
        with opened(path) as database:
            keyframes = "SELECT count(*) FROM keyframes"
            assert database.execute(keyframes).fetchone() == (30,)
            store.update(part_of(whole, 40))
            # It goes on to see what it saw at first.
            assert database.execute(keyframes).fetchone() == (30,)
        assert check_map(path) == ()
        assert map_info(path).keyframes == 40
        assert "live.hmt-wal" in names(tmp_path)
    assert names(tmp_path) == ["live.hmt", "map.hmt"]


def test_closing_while_somebody_reads_loses_nothing(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    store = MapStore(path)
    store.update(part_of(whole, 20))
    store.update(part_of(whole, 30))
    with opened(path) as database:
        assert database.execute("SELECT count(*) FROM keyframes").fetchone() == (30,)
        store.close()
    assert len(read_map(path).keyframes) == 30
    with kept(path) as store:
        assert read(store) is not None
        store.update(part_of(whole, 40))
    assert names(tmp_path) == ["live.hmt", "map.hmt"]
    assert len(read_map(path).keyframes) == 40


def killed_at(store: MapStore, stored: StoredMap, path: Path, folder: Path) -> Path:
    """Return the file as a writer leaves it that is killed after an update."""
    store.update(stored)
    folder.mkdir()
    for left in path.parent.glob(f"{path.name}*"):
        shutil.copy(left, folder)
    return folder / path.name


def test_what_a_killed_writer_left_is_read_and_gone_on_with(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        left = killed_at(store, part_of(whole, 30), path, tmp_path / "killed")
    assert f"{left.name}-wal" in names(left.parent)
    assert len(read_map(left).keyframes) == 30
    assert check_map(left) == ()
    with kept(left) as store:
        assert read(store) is not None
        store.update(part_of(whole, 40))
    assert names(left.parent) == [left.name]
    assert content(left) == content_of(part_of(whole, 40), tmp_path)


def content_of(stored: StoredMap, folder: Path) -> list[list[tuple[object, ...]]]:
    write_map(folder / "expected.hmt", stored)
    return content(folder / "expected.hmt")


def test_a_log_that_was_left_is_not_read_into_the_next_file(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        left = killed_at(store, part_of(whole, 30), path, tmp_path / "killed")
    write_map(left, whole)
    assert names(left.parent) == [left.name]
    assert content(left) == content(tmp_path / "map.hmt")


def test_a_file_that_is_being_written_is_not_replaced(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        store.update(part_of(whole, 30))
        with pytest.raises(Unavailable, match="locked"):
            write_map(path, whole)
        store.update(part_of(whole, 40))
    assert len(read_map(path).keyframes) == 40


@pytest.mark.parametrize("has_log", [True, False])
def test_read_only_media_are_read(tmp_path: Path, *, has_log: bool) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        left = killed_at(store, part_of(whole, 30), path, tmp_path / "killed")
    if not has_log:
        # Copied without its log, it is what it was at the last checkpoint.
        for other in (f"{left.name}-wal", f"{left.name}-shm"):
            (left.parent / other).unlink()
    # Folders protect nothing from root, and pytest's own are closed to everybody else.
    with tempfile.TemporaryDirectory() as folder:
        medium = shutil.copytree(left.parent, Path(folder) / "medium")
        Path(folder).chmod(0o755)
        for each in medium.iterdir():
            each.chmod(0o444)
        medium.chmod(0o555)
        held = names(medium)
        reader = get_context("fork").Process(target=as_nobody, args=(medium / left.name,))
        reader.start()
        reader.join()
        assert names(medium) == held
        medium.chmod(0o755)
    assert reader.exitcode == 0


def as_nobody(path: Path) -> None:
    if os.geteuid() == 0:
        os.setuid(65534)
    with pytest.raises(PermissionError):
        (path.parent / "new").touch()
    assert check_map(path) == ()


def test_the_second_writer_is_noticed_whoever_comes_first(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    write_map(path, part_of(whole, 20))
    with kept(path) as first, kept(path) as second:
        assert read(first) is not None
        assert read(second) is not None
        first.update(part_of(whole, 30))
        with pytest.raises(Unavailable, match="another program has written"):
            second.update(part_of(whole, 25))
        first.update(part_of(whole, 40))
        with pytest.raises(Unavailable, match="another program has written"):
            second.update(part_of(whole, 45))
    assert content(path) == content_of(part_of(whole, 40), tmp_path)


def test_two_that_begin_the_same_file_are_noticed(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as first, kept(path) as second:
        assert read(first) is None
        assert read(second) is None
        first.update(part_of(whole, 20))
        with pytest.raises(Unavailable, match="another program has written"):
            second.update(part_of(whole, 25))
    assert len(read_map(path).keyframes) == 20


def test_a_file_that_was_exchanged_is_left_alone(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        store.update(part_of(whole, 30))
        shutil.copy(tmp_path / "map.hmt", tmp_path / "other.hmt")
        (tmp_path / "other.hmt").replace(path)
        with pytest.raises(Unavailable, match="another program has written"):
            store.update(part_of(whole, 40))


def test_a_file_that_was_removed_is_written_again(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        store.update(part_of(whole, 30))
        path.unlink()
        store.update(part_of(whole, 40))
        store.update(part_of(whole, 45))
    assert content(path) == content_of(part_of(whole, 45), tmp_path)


@pytest.mark.parametrize("version", range(2, SCHEMA_VERSION))
def test_a_map_of_an_older_version_becomes_one_of_this(tmp_path: Path, version: int) -> None:
    path = tmp_path / "old.hmt"
    shutil.copy(GOLDEN / f"map_v{version}.hmt", path)
    with kept(path) as store:
        stored = read(store)
        assert stored is not None
        store.update(stored)
        store.update(replace(stored, revision=stored.revision + 1))
    assert check_map(path) == ()
    assert map_info(path).schema_version == SCHEMA_VERSION
    assert_same_map(read_map(path), replace(stored, revision=stored.revision + 1))


@pytest.mark.parametrize("content", ["damaged", "newer", "foreign"])
def test_what_is_refused_is_not_touched(tmp_path: Path, content: str) -> None:
    path = map_file_in(tmp_path)
    if content == "damaged":
        path.write_bytes(path.read_bytes()[:-3000])
    else:
        pragma = "user_version" if content == "newer" else "application_id"
        with closing(sqlite3.connect(path)) as database:
            database.execute(f"PRAGMA {pragma} = 77")
    before = path.read_bytes()
    with kept(path) as store, pytest.raises(InvalidInput):
        read(store)
    assert path.read_bytes() == before
    assert names(tmp_path) == [path.name]


def test_a_full_disk_keeps_the_last_state_and_the_next_update_catches_up(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    with kept(path) as store:
        store.update(part_of(whole, 20))
        store.update(part_of(whole, 21))
        with no_file_larger_than(100_000), pytest.raises(Unavailable, match="40 keyframes not"):
            store.update(part_of(whole, 40))
        assert content(path) == content_of(part_of(whole, 21), tmp_path)
        store.update(part_of(whole, 45))
    assert content(path) == content_of(part_of(whole, 45), tmp_path)


def test_closing_on_a_full_disk_keeps_the_log(tmp_path: Path) -> None:
    path, whole = tmp_path / "live.hmt", read_map(map_file_in(tmp_path))
    store = MapStore(path)
    store.update(part_of(whole, 20))
    store.update(part_of(whole, 45))
    with no_file_larger_than(path.stat().st_size):
        store.close()
    assert "live.hmt-wal" in names(tmp_path)
    assert content(path) == content_of(part_of(whole, 45), tmp_path)


def test_a_folder_that_is_not_there_is_not_found(tmp_path: Path) -> None:
    with kept(tmp_path / "nowhere" / "map.hmt") as store, pytest.raises(NotFound, match="nowhere"):
        store.update(random_map(0))


def test_a_point_that_cannot_be_stored_leaves_the_state_before(tmp_path: Path) -> None:
    path, whole = tmp_path / "map.hmt", random_map(0)
    bad = replace(whole.keyframes[-1], points_in_body=np.full((1, 3), np.nan, dtype=np.float32))
    with kept(path) as store:
        store.update(replace(whole, keyframes=whole.keyframes[:-1]))
        with pytest.raises(InvalidInput, match="not finite"):
            store.update(replace(whole, keyframes=(*whole.keyframes[:-1], bad)))
        store.update(whole)
    assert_same_map(read_map(path), whole)


def test_a_writer_that_is_killed_at_any_moment_leaves_what_it_said(tmp_path: Path) -> None:
    """Also while the log is taken into the file, and while one that writes begins and ends."""
    path, rng = tmp_path / "live.hmt", np.random.default_rng(5)
    arguments = [sys.executable, "-m", "tests.io.growing", str(map_file_in(tmp_path)), str(path)]
    for _ in range(KILLS):
        path.unlink(missing_ok=True)
        with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            said = [int(process.stdout.readline()) for _ in range(int(rng.integers(1, 150)))]
            # Between two lines lie half a millisecond to several.
            process.kill()
            said += [int(line) for line in process.stdout if line.endswith("\n")]
        assert process.returncode == -signal.SIGKILL
        assert check_map(path) == ()
        assert read_map(path).revision in (said[-1], said[-1] + 1)
