"""The clock of a client that asks: hand-made answers, known latencies."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from benchmarks.clients import paced, stamp_of
from hmt_service.core.types import Event, EventKind
from hmt_service.errors import DeadlineExceeded, InvalidInput, Unavailable
from hmt_service.service.codec import encode


class Clock:
    """A clock that only goes on when somebody sleeps or works."""

    def __init__(self, oversleep_s: float = 0.0) -> None:
        self.now_s = 100.0
        self._oversleep_s = oversleep_s

    def now(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s + self._oversleep_s


def ask(clock: Clock, durations_s: Iterator[float], *, for_s: float) -> list[float]:
    """Ask every second questions that take so long, a negative one without an answer."""

    def call() -> None:
        duration_s = next(durations_s)
        clock.now_s += abs(duration_s)
        if duration_s < 0.0:
            raise Unavailable("nothing yet")

    return paced(call, period_s=1.0, for_s=for_s, now=clock.now, sleep=clock.sleep)


def test_fast_answers_take_what_they_take() -> None:
    latencies_s = ask(Clock(), iter([0.1, 0.2, 0.3]), for_s=3.0)
    assert latencies_s == pytest.approx([0.1, 0.2, 0.3])


def test_questions_that_a_slow_answer_kept_waiting_count_from_their_turn() -> None:
    # Turns at 0, 1, 2, 3 s; the first answer comes at 2.5 s.
    latencies_s = ask(Clock(), iter([2.5, 0.1, 0.1, 0.1]), for_s=4.0)
    assert latencies_s == pytest.approx([2.5, 1.6, 0.7, 0.1])


def test_sleeping_too_long_is_not_counted() -> None:
    latencies_s = ask(Clock(oversleep_s=0.3), iter([0.1, 0.1, 0.1]), for_s=3.0)
    assert latencies_s == pytest.approx([0.1, 0.1, 0.1])


def test_questions_without_an_answer_do_not_count() -> None:
    latencies_s = ask(Clock(), iter([-0.1, 0.2, -0.1]), for_s=3.0)
    assert latencies_s == pytest.approx([0.2])


def test_a_question_that_is_never_answered_counts_as_long_as_it_was_waited_for() -> None:
    clock = Clock()

    def call() -> None:
        clock.now_s += 0.5
        raise DeadlineExceeded("no answer in 0.5 s")

    latencies_s = paced(call, period_s=1.0, for_s=2.0, now=clock.now, sleep=clock.sleep)
    assert latencies_s == pytest.approx([0.5, 0.5])


def test_something_else_published_as_a_pose_is_refused() -> None:
    message = encode(Event(EventKind.LOST, 1.0, "lost"))
    with pytest.raises(InvalidInput, match="Event"):
        stamp_of(message.payload, message.encoding)
