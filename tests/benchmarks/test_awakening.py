"""Waking up in the flat: found when it is found, and wrong when the truth is another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.awakening import Awakening, Truth, awaken
from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import planar_pose
from tests.flat import SETTINGS, path, readings
from tests.mapped import SCANS, mapped

LATER_S = 1e4


def woken(*, shift_m: float) -> Awakening:
    """Wake up in the left room; the truth of that session is so far off."""
    sent = readings(SCANS)
    stamps_s, poses = np.array([r.stamp_s for r in sent[1::2]]), np.array(path(SCANS))
    elsewhere = planar_pose(shift_m, 0.0, 0.0) @ poses
    truth = Truth(
        np.concatenate([stamps_s, stamps_s + LATER_S]), np.concatenate([poses, elsewhere])
    )
    later = [replace(reading, stamp_s=reading.stamp_s + LATER_S) for reading in sent]
    return awaken(mapped().stored(), later, truth, load_config(Preset.PLANAR, SETTINGS))


def test_the_right_place_is_found() -> None:
    found = woken(shift_m=0.0)
    assert found.found_m is not None
    assert found.found_m < 5.0
    assert found.wrong < 0.5


def test_a_place_that_is_not_the_true_one_is_wrong() -> None:
    found = woken(shift_m=3.0)
    assert found.found_m is None
    assert found.wrong > 0.95
