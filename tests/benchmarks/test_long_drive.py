"""A map that grows in a process of its own: a short real drive, and how it ends."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import psutil

from benchmarks.long_drive import Checkpoint, End, Entry, drive
from hmt_service.core.config import load_config
from hmt_service.core.types import Reading, Scan
from tests import flat

CONFIG = load_config(text=flat.SETTINGS)
SCANS = 140


def endless() -> Iterator[Reading]:
    stamp_s = 0.0
    while True:
        for reading in flat.readings(SCANS, start_s=stamp_s):
            stamp_s = reading.stamp_s + 1.0
            yield reading


def mapping_processes() -> list[psutil.Process]:
    return [
        process
        for process in psutil.Process().children()
        if process.status() != psutil.STATUS_ZOMBIE and "spawn_main" in " ".join(process.cmdline())
    ]


def test_a_drive_through_two_rooms_says_what_each_entry_and_checkpoint_takes() -> None:
    messages = list(drive(flat.readings(SCANS), CONFIG, checkpoints=(1, 2, 500), budget_s=600.0))
    *said, end = messages
    entries = [message for message in said if isinstance(message, Entry)]
    looks = [message for message in said if isinstance(message, Checkpoint)]
    assert isinstance(end, End)
    assert end.is_complete
    assert [entry.areas for entry in entries][:2] == [1, 2]
    # The first scan begins the first area; all others lie between entries or are one.
    assert entries[0].scans == 0
    assert sum(entry.scans + 1 for entry in entries) <= SCANS
    assert all(entry.entry_s > 0.0 for entry in entries)
    assert entries[1].scans_s > 0.0
    assert [look.areas for look in looks] == [1, 2]
    # A checkpoint is said just after the entry that reaches it.
    assert isinstance(said[1], Checkpoint)
    assert min(looks[1].consistent_s, looks[1].shortest_path_s, looks[1].snapshot_s) > 0.0
    assert looks[1].file_bytes > looks[0].file_bytes > 0
    assert looks[1].memory_bytes > 0


def test_a_drive_ends_when_its_time_is_over_whatever_more_there_is() -> None:
    messages = list(drive(endless(), CONFIG, checkpoints=(1,), budget_s=0.2))
    end = messages[-1]
    assert isinstance(end, End)
    assert not end.is_complete
    assert end.elapsed_s >= 0.2


def test_a_drive_that_nobody_follows_to_its_end_leaves_no_process_behind() -> None:
    before = mapping_processes()
    messages = drive(endless(), CONFIG, checkpoints=(), budget_s=600.0)
    assert isinstance(next(messages), Entry)
    (process,) = set(mapping_processes()) - set(before)
    messages.close()
    assert not process.is_running()


def test_a_process_that_dies_is_told_with_its_exit_code() -> None:
    before = mapping_processes()
    messages = drive(endless(), CONFIG, checkpoints=(), budget_s=600.0)
    next(messages)
    (process,) = set(mapping_processes()) - set(before)
    process.kill()
    *_, end = messages
    assert isinstance(end, End)
    assert not end.is_complete
    assert end.failure == "the mapping process ended with code -9"


def test_an_engine_that_fails_is_told_after_what_it_has_done() -> None:
    first, *others = flat.readings(20)
    # No engine can map a scan of points that have only two coordinates.
    broken = Scan(others[-1].stamp_s + 0.1, np.zeros((100, 2)), np.zeros(3))
    *said, end = drive([first, *others, broken], CONFIG, checkpoints=(1,), budget_s=600.0)
    assert isinstance(end, End)
    assert not end.is_complete
    assert end.failure is not None
    assert "InvalidInput: " in end.failure
    assert [type(message) for message in said] == [Entry, Checkpoint]
