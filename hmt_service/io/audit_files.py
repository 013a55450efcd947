"""Events and beliefs of a run as JSON lines: one object per line, readable by any program.

References:
    https://jsonlines.org.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from hmt_service.core.types import Belief, Event
from hmt_service.errors import InvalidInput, NotFound

Line = TypeVar("Line", Event, Belief)

_EVENT, _BELIEF = TypeAdapter(Event), TypeAdapter(Belief)


def write_events(path: Path, events: Iterable[Event]) -> None:
    """Write events, one per line; equal events give equal bytes."""
    _write(path, _EVENT, events)


def write_beliefs(path: Path, beliefs: Iterable[Belief]) -> None:
    """Write beliefs, one per line; equal beliefs give equal bytes."""
    _write(path, _BELIEF, beliefs)


def read_events(path: Path) -> tuple[Event, ...]:
    """Read events in the order of the file.

    Raises:
        NotFound: If the file cannot be opened.
        InvalidInput: If a line does not hold an event.
    """
    return _read(path, _EVENT)


def read_beliefs(path: Path) -> tuple[Belief, ...]:
    """Read beliefs in the order of the file.

    Raises:
        NotFound: If the file cannot be opened.
        InvalidInput: If a line does not hold a belief.
    """
    return _read(path, _BELIEF)


def _write(path: Path, adapter: TypeAdapter[Line], values: Iterable[Line]) -> None:
    with path.open("wb") as file:
        for value in values:
            file.write(adapter.dump_json(value) + b"\n")


def _read(path: Path, adapter: TypeAdapter[Line]) -> tuple[Line, ...]:
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise NotFound(f"{path} cannot be read: {error.strerror}") from error
    values = []
    for number, line in enumerate(lines, start=1):
        try:
            values.append(adapter.validate_json(line))
        except ValidationError as error:
            what = error.errors()[0]
            place = ".".join(map(str, what["loc"]))
            raise InvalidInput(f"{path.name}:{number}: {place or 'line'}: {what['msg']}") from error
    return tuple(values)
