"""The log of `hmt serve` on standard error: lines for people, or one JSON object per line.

References: own.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum

import typer

from hmt_service.errors import BAD_INPUT, HmtError

_LOG = logging.getLogger(__name__)

Say = Callable[[str, bool], None]
"""Tells one sentence of the command itself, and whether it is bad news."""


class LogFormat(StrEnum):
    """Who reads the log."""

    TEXT = "text"
    """People."""
    JSON = "json"
    """Programs: `time` (UTC), `level`, `event` (its kind, or null), `message`, `stamp_s` (sensor
    time, or null), `numbers`, and `exception` where there was one."""


class JsonLines(logging.Formatter):
    """Writes a record as one JSON object on one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line; numbers that are not finite become null."""
        from hmt_service.core.types import Event

        event = getattr(record, "event", None)
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "event": None,
            "message": record.getMessage(),
            "stamp_s": None,
            "numbers": {},
        }
        if isinstance(event, Event):
            line["event"] = event.kind
            line["message"] = event.message
            line["stamp_s"] = _finite(event.stamp_s)
            line["numbers"] = _numbers(event.numbers)
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, allow_nan=False)


@contextmanager
def logging_as(log_format: LogFormat) -> Iterator[Say]:
    """Send the log to standard error; yield how the command itself speaks there.

    Raises:
        Exit: As JSON, instead of an `HmtError`, which is a line of the log then.
    """
    if log_format is LogFormat.TEXT:
        yield _log_text()
        return
    handler = logging.StreamHandler()
    handler.setFormatter(JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    try:
        yield lambda text, is_bad: _LOG.log(logging.ERROR if is_bad else logging.INFO, "%s", text)
    except HmtError as error:
        _LOG.error("%s", error)
        raise typer.Exit(BAD_INPUT) from error


def _log_text() -> Say:
    from rich.console import Console
    from rich.logging import RichHandler
    from rich.text import Text

    console = Console(stderr=True)
    handler = RichHandler(console=console, show_path=False)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[handler])
    return lambda text, is_bad: console.print(Text(text, "red" if is_bad else ""), soft_wrap=True)


def _numbers(numbers: Mapping[str, float]) -> dict[str, float | None]:
    return {name: _finite(number) for name, number in numbers.items()}


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
