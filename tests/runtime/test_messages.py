from __future__ import annotations

from types import MappingProxyType

from hmt_service.core.types import Event, EventKind
from hmt_service.errors import NotFound
from hmt_service.runtime.messages import Mapped, RunReport, dump, load


def test_events_with_read_only_numbers_pass_a_pipe() -> None:
    event = Event(EventKind.LOST, 1.5, "lost", MappingProxyType({"distance_m": 2.0}))
    mapped = load(dump(Mapped(None, (event,), RunReport(1, 0.5, 0.25), 1, 0)))
    assert mapped.events == (event,)
    assert mapped.report == RunReport(1, 0.5, 0.25)


def test_errors_keep_type_and_message() -> None:
    error = load(dump(NotFound("area 9 of 4")))
    assert isinstance(error, NotFound)
    assert str(error) == "area 9 of 4"
