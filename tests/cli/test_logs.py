"""The log as JSON: one object per line, whatever happens."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from types import MappingProxyType

from hmt_service.cli.logs import JsonLines
from hmt_service.core.types import Event, EventKind


def line_of(message: str, *arguments: object, event: Event | None = None) -> dict[str, object]:
    record = logging.makeLogRecord(
        {
            "name": "hmt_service",
            "levelno": logging.WARNING,
            "levelname": "WARNING",
            "msg": message,
            "args": arguments,
            "created": 0.25,
        }
    )
    if event is not None:
        record.event = event
    text = JsonLines().format(record)
    assert "\n" not in text
    line = json.loads(text)
    assert isinstance(line, dict)
    return line


def test_an_event_is_logged_with_its_kind_and_numbers() -> None:
    numbers = MappingProxyType({"overlap": 0.5, "log_odds": float("-inf")})
    event = Event(EventKind.LOST, 12.5, "nothing fits", numbers)
    assert line_of("%s: %s", event.kind, event.message, event=event) == {
        "time": "1970-01-01T00:00:00.250+00:00",
        "level": "warning",
        "event": "lost",
        "message": "nothing fits",
        "stamp_s": 12.5,
        "numbers": {"overlap": 0.5, "log_odds": None},
    }


def test_what_happens_before_the_first_reading_has_no_stamp() -> None:
    event = Event(EventKind.INPUT_DROPPED, float("-inf"), "1 samples refused")
    assert line_of("%s", event.message, event=event)["stamp_s"] is None


def test_what_is_no_event_is_a_line_too() -> None:
    line = line_of("call %s\nfailed", "ro/map")
    assert (line["event"], line["message"], line["numbers"]) == (None, "call ro/map\nfailed", {})


def test_an_exception_stays_on_its_line() -> None:
    error = ValueError("of 3\nlines")
    record = logging.makeLogRecord({"msg": "failed", "exc_info": (ValueError, error, None)})
    text = JsonLines().format(record)
    assert "\n" not in text
    assert "ValueError: of 3\nlines" in json.loads(text)["exception"]


def test_a_daemon_that_does_not_start_says_why_in_the_format_that_was_asked_for() -> None:
    options = ["serve", "--listen", "tcp/0.0.0.0:0", "--log-format", "json"]
    result = subprocess.run(
        [sys.executable, "-m", "hmt_service", *options], capture_output=True, check=False, text=True
    )
    assert (result.returncode, result.stdout) == (2, "")
    line = json.loads(result.stderr)
    assert line["level"] == "error"
    assert "--allow-unauthenticated" in line["message"]
