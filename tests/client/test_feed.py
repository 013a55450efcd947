from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.client.feed import Feed
from hmt_service.errors import InvalidInput


@given(st.lists(st.integers(), max_size=30), st.integers(1, 10))
def test_the_newest_are_kept_in_order_and_the_others_counted(
    values: list[int], capacity: int
) -> None:
    feed: Feed[int] = Feed(capacity)
    for value in values:
        feed.put(value)
    feed.close()
    taken = []
    while not feed.is_over:
        taken.append(feed.get())
    assert taken == values[-capacity:]
    assert feed.dropped == len(values) - len(taken)


def test_a_value_is_waited_for() -> None:
    feed: Feed[str] = Feed(1)
    threading.Timer(0.05, lambda: feed.put("late")).start()
    assert feed.get(timeout_s=20.0) == "late"
    assert feed.get(timeout_s=0.0) is None
    assert not feed.is_over


def test_who_waits_learns_that_nothing_more_comes() -> None:
    feed: Feed[str] = Feed(1)
    threading.Timer(0.05, feed.close).start()
    assert feed.get(timeout_s=20.0) is None
    assert feed.is_over


def test_what_cannot_be_understood_is_an_error_in_its_place() -> None:
    feed: Feed[str] = Feed(3)
    feed.put("before")
    feed.put(InvalidInput("of another version"))
    feed.put("after")
    assert feed.get() == "before"
    with pytest.raises(InvalidInput, match="version"):
        feed.get()
    assert feed.get() == "after"


def test_every_change_is_told() -> None:
    changes: list[int] = []
    feed: Feed[int] = Feed(2)
    feed.on_change(lambda: changes.append(1))
    feed.put(1)
    feed.close()
    assert len(changes) == 2
