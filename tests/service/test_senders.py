from __future__ import annotations

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from hmt_service.service.codec import encode_origin
from hmt_service.service.keys import Input
from hmt_service.service.reports import SenderCounts
from hmt_service.service.senders import Senders


@given(st.sets(st.integers(0, 30), min_size=1), st.randoms(use_true_random=False))
def test_what_arrived_and_what_did_not_adds_up_in_any_order(
    arrived: set[int], random: Random
) -> None:
    senders, order = Senders(), list(arrived)
    random.shuffle(order)
    for number in order:
        senders.note(Input.SCAN, encode_origin(7, number))
    (counts,) = senders.counts()
    lost = max(arrived) + 1 - len(arrived)
    assert counts == SenderCounts(7, Input.SCAN, len(arrived), lost)


def test_every_sender_and_key_has_its_own_count() -> None:
    senders = Senders()
    senders.note(Input.SCAN, encode_origin(1, 0))
    senders.note(Input.ODOMETRY, encode_origin(1, 0))
    senders.note(Input.SCAN, encode_origin(2, 2))
    assert senders.counts() == (
        SenderCounts(1, Input.SCAN, 1, 0),
        SenderCounts(1, Input.ODOMETRY, 1, 0),
        SenderCounts(2, Input.SCAN, 1, 2),
    )


@given(st.binary(max_size=40))
def test_any_attachment_is_survived(attachment: bytes) -> None:
    senders = Senders()
    senders.note(Input.SCAN, attachment)
    assert len(senders.counts()) <= 1


def test_a_flood_of_senders_takes_no_more_than_its_room() -> None:
    senders = Senders()
    for sender in range(1, 1000):
        senders.note(Input.SCAN, encode_origin(sender, 0))
    counts = senders.counts()
    assert len(counts) == 100
    assert counts[-1].sender == 999
