from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hmt_service.core.types import Keyframe
from hmt_service.errors import Unavailable
from hmt_service.io.shelf import DiskShelf
from tests.io.test_map_file import random_map


def assert_same_keyframe(first: Keyframe, second: Keyframe) -> None:
    assert (first.index, first.stamp_s, first.failure) == (
        second.index,
        second.stamp_s,
        second.failure,
    )
    for one, other in (
        (first.points_in_body, second.points_in_body),
        (first.sensor_in_body, second.sensor_in_body),
        (first.previous_from_body.mean, second.previous_from_body.mean),
        (first.previous_from_body.covariance, second.previous_from_body.covariance),
        (first.own_error, second.own_error),
    ):
        assert (one.dtype, one.shape, one.strides) == (other.dtype, other.shape, other.strides)
        assert one.tobytes() == other.tobytes()


def test_keyframes_come_back_the_same_in_every_bit() -> None:
    shelf, keyframes = DiskShelf(), random_map(4, keyframes=12).keyframes
    fortran = np.asfortranarray(keyframes[3].points_in_body)
    odd = replace(keyframes[3], points_in_body=fortran, stamp_s=np.nextafter(1.7e9, 2e9))
    empty = replace(keyframes[4], points_in_body=keyframes[4].points_in_body[:0])
    visits = {7: keyframes[:3], 8: (odd,), 2: (empty, *keyframes[5:])}
    for visit, kept in visits.items():
        shelf.put(visit, kept)
    for visit, kept in visits.items():
        for one, other in zip(shelf.get(visit), kept, strict=True):
            assert_same_keyframe(one, other)
    assert shelf.size_bytes > sum(k.points_in_body.nbytes for k in keyframes[5:])


def test_a_shelf_is_handed_to_another_process_before_it_is_used() -> None:
    shelf = pickle.loads(pickle.dumps(DiskShelf()))
    assert shelf.size_bytes == 0


def test_a_shelf_without_room_says_how_much_there_is() -> None:
    shelf, keyframes = DiskShelf(), random_map(4).keyframes
    shelf.put(0, keyframes)
    (pages,) = shelf._opened().execute("PRAGMA page_count").fetchone()
    shelf._opened().execute(f"PRAGMA max_page_count = {pages + 1}")
    with pytest.raises(Unavailable, match="do not fit"):
        shelf.put(1, keyframes)
    assert_same_keyframe(shelf.get(0)[0], keyframes[0])
