from __future__ import annotations

import threading

import pytest

from hmt_service.runtime.queues import SizedQueue


def test_items_come_out_in_the_order_that_they_went_in() -> None:
    queue: SizedQueue[str] = SizedQueue(10)
    assert [queue.offer(item, 1) for item in "abc"] == [True] * 3
    assert [queue.get() for _ in range(3)] == ["a", "b", "c"]


def test_an_item_that_does_not_fit_is_refused_and_nothing_else_lost() -> None:
    queue: SizedQueue[str] = SizedQueue(10)
    assert queue.offer("a", 6)
    assert not queue.offer("b", 5)
    assert queue.offer("c", 4)
    assert (len(queue), queue.size_bytes) == (2, 10)


def test_an_item_larger_than_the_queue_passes_alone() -> None:
    queue: SizedQueue[str] = SizedQueue(10)
    assert queue.offer("a", 99)
    assert not queue.offer("b", 1)


def test_tokens_take_no_room_and_survive_a_discard_in_their_place() -> None:
    queue: SizedQueue[str] = SizedQueue(10)
    queue.offer("a", 10)
    queue.put_token("token")
    queue.get()
    queue.offer("b", 10)
    assert queue.discard() == 1
    assert (len(queue), queue.size_bytes) == (0, 0)
    queue.offer("c", 10)
    assert [queue.get(), queue.get()] == ["token", "c"]


def test_put_waits_for_room() -> None:
    queue: SizedQueue[str] = SizedQueue(10)
    queue.offer("a", 10)
    putting = threading.Thread(target=queue.put, args=("b", 10))
    putting.start()
    assert queue.get() == "a"
    assert queue.get(5.0) == "b"
    putting.join(5.0)
    assert not putting.is_alive()


def test_close_wakes_whoever_waits_and_keeps_what_is_inside() -> None:
    queue: SizedQueue[str] = SizedQueue(10)
    queue.offer("a", 10)
    outcome: list[bool] = []
    putting = threading.Thread(target=lambda: outcome.append(queue.put("b", 10)))
    putting.start()
    queue.close()
    putting.join(5.0)
    assert outcome == [False]
    assert not queue.offer("c", 1)
    assert not queue.put_token("d")
    assert [queue.get(), queue.get()] == ["a", None]


@pytest.mark.parametrize("timeout_s", [0.0, 0.01])
def test_get_returns_none_after_its_time(timeout_s: float) -> None:
    assert SizedQueue[str](10).get(timeout_s) is None
