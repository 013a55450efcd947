"""Parameters of questions over a real session: whatever is sent, there is exactly one answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import zenoh
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from hmt_service.client.local import free_endpoint
from hmt_service.errors import HmtError, InvalidInput
from hmt_service.service.codec import decode
from hmt_service.service.keys import Call, Keys
from hmt_service.service.questions import Question, receive
from hmt_service.service.reports import Ack
from hmt_service.service.session import Endpoints, Mode, open_session

KEYS = Keys("site", "robot")
NUMBERS = st.text("0123456789.-+eEinfa ", max_size=25)
VERSIONS = st.text("0123456789:,-x ", max_size=40)


class Sessions:
    """A robot that is asked, and somebody who asks."""

    def __init__(self, asked: zenoh.Session, asking: zenoh.Session) -> None:
        self._asking = asking
        self.read: Callable[[Question[Call]], object] = lambda question: None
        keys = {call: KEYS.call(call) for call in Call}

        def handle(question: Question[Call]) -> Ack:
            self.value = self.read(question)
            return Ack(0, 0, 0, 0)

        self._queryable = asked.declare_queryable(
            KEYS.calls, lambda query: receive(query, keys, handle)
        )

    def ask(self, parameters: str) -> object:
        """Return what was read of a question, or the error that it is answered with."""
        selector = zenoh.Selector(KEYS.call(Call.MAP), parameters)
        (reply,) = self._asking.get(selector, timeout=60.0)
        value = decode(reply.result.payload.to_bytes(), str(reply.result.encoding))
        return value if isinstance(value, HmtError) else self.value


@contextmanager
def opened() -> Iterator[Sessions]:
    endpoint = free_endpoint()
    with (
        open_session(Endpoints(mode=Mode.PEER, listen=(endpoint,))) as asked,
        open_session(Endpoints(mode=Mode.CLIENT, connect=(endpoint,), timeout_s=60.0)) as asking,
    ):
        yield Sessions(asked, asking)


@pytest.fixture(scope="module")
def sessions() -> Iterator[Sessions]:
    with opened() as sessions:
        yield sessions


@given(NUMBERS)
@hypothesis_settings(max_examples=60)
def test_a_number_is_finite_or_refused(sessions: Sessions, text: str) -> None:
    sessions.read = lambda question: question.number("from")
    value = sessions.ask(f"from={text}")
    if isinstance(value, InvalidInput):
        return
    assert isinstance(value, float)
    assert math.isfinite(value)
    assert value == float(text)


@given(st.floats(-1e12, 1e12))
@hypothesis_settings(max_examples=30)
def test_every_stamp_can_be_said(sessions: Sessions, stamp_s: float) -> None:
    sessions.read = lambda question: question.number("from")
    assert sessions.ask(f"from={stamp_s}") == stamp_s


@given(VERSIONS)
@hypothesis_settings(max_examples=60)
def test_versions_are_numbers_or_refused(sessions: Sessions, text: str) -> None:
    sessions.read = lambda question: dict(question.versions("known"))
    value = sessions.ask(f"known={text}")
    if isinstance(value, InvalidInput):
        return
    assert isinstance(value, dict)
    pairs = [pair.split(":") for pair in text.split(",") if pair]
    assert value == {int(area): int(version) for area, version in pairs}


@given(NUMBERS)
@hypothesis_settings(max_examples=60)
def test_a_deadline_is_in_range_or_refused(sessions: Sessions, text: str) -> None:
    sessions.read = lambda question: question.deadline_s(8.0)
    value = sessions.ask(f"deadline={text}")
    if isinstance(value, InvalidInput):
        return
    assert isinstance(value, float)
    assert 0.0 < value <= 600.0


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ("from=nan", "nan"),
        ("from=1e400", "1e400"),
        ("from=" + "9" * 5000, "not a number"),
        ("known=3", "area:version"),
        ("known=3:4:5", "area:version"),
        ("known=3:-4", "area:version"),
        ("deadline=0", "(0, 600]"),
        ("deadline=601", "(0, 600]"),
        ("part_bytes=16383", "16384"),
        ("part_bytes=1048577", "1048576"),
        ("part_bytes=1e6", "integer"),
        ("known=" + "1:1," * 300_000, "1000000 at most"),
    ],
)
def test_what_is_wrong_is_named(sessions: Sessions, parameters: str, words: str) -> None:
    sessions.read = lambda question: (
        question.number("from"),
        question.versions("known"),
        question.deadline_s(8.0),
        question.part_bytes,
    )
    error = sessions.ask(parameters)
    assert isinstance(error, InvalidInput)
    assert words in str(error)


def test_what_is_not_said_is_the_usual(sessions: Sessions) -> None:
    sessions.read = lambda question: (
        question.number("from"),
        dict(question.versions("known")),
        question.deadline_s(8.0),
        question.part_bytes,
    )
    assert sessions.ask("") == (None, {}, 8.0, None)
