"""Events and beliefs as JSON lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from hmt_service.core.types import Belief, Event, EventKind
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.io.audit_files import read_beliefs, read_events, write_beliefs, write_events

EVENTS = (
    Event(EventKind.LOST, 1.5, 'a "quoted"\nmessage', {"sigma_m": 0.25}),
    Event(EventKind.ACCEPTED, 2.0, "accepted", {}),
)
BELIEFS = (Belief(1.0, {0: 1.0}, 1.0), Belief(2.0, {0: 0.25, 17: 0.75}, 1.6))


def test_what_was_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "lines.jsonl"
    write_events(path, EVENTS)
    assert read_events(path) == EVENTS
    assert len(path.read_bytes().splitlines()) == 2
    write_beliefs(path, BELIEFS)
    assert read_beliefs(path) == BELIEFS
    write_beliefs(path, [])
    assert read_beliefs(path) == ()


@pytest.mark.parametrize("line", [b"{", b"{}", b'{"stamp_s": "soon"}', b"\xff"])
def test_a_line_that_is_none_is_refused_with_its_number(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "lines.jsonl"
    write_beliefs(path, BELIEFS)
    path.write_bytes(path.read_bytes() + line + b"\n")
    with pytest.raises(InvalidInput, match=r"lines\.jsonl:3: "):
        read_beliefs(path)


def test_a_file_that_is_not_there_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="cannot be read"):
        read_events(tmp_path / "none.jsonl")
