from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.geometry import identity
from hmt_service.core.ordering import ReorderWindow
from hmt_service.core.types import OdometryReading, Reading, Scan


def scan(stamp_s: float) -> Scan:
    return Scan(stamp_s, np.zeros((0, 3)), np.zeros(3))


def odometry(stamp_s: float) -> OdometryReading:
    return OdometryReading(stamp_s, identity())


def key(reading: Reading) -> tuple[float, bool]:
    return reading.stamp_s, isinstance(reading, Scan)


def through(window: ReorderWindow, readings: list[Reading]) -> list[Reading]:
    released: list[Reading] = []
    for reading in readings:
        taken = window.push(reading)
        assert taken is not None
        released += taken
    return [*released, *window.flush()]


# Sixteenths are exact in binary: sums of them compare without rounding.
steps = st.integers(0, 8).map(lambda n: n / 16.0)


@given(st.lists(st.tuples(steps, st.booleans())), st.sampled_from([0.0, 0.25]))
def test_readings_in_order_come_out_in_the_order_of_the_offline_run(
    moves: list[tuple[float, bool]], window_s: float
) -> None:
    stamp_s, readings = 100.0, list[Reading]()
    for step, is_scan in moves:
        stamp_s += step
        readings.append(scan(stamp_s) if is_scan else odometry(stamp_s))
    readings.sort(key=key)
    assert through(ReorderWindow(window_s), readings) == readings


streams = st.lists(st.integers(1, 8), max_size=20)


@given(streams, streams, st.lists(st.integers(0, 3), max_size=20), st.integers(0, 3))
def test_two_inputs_in_order_are_put_in_order_however_late_one_is(
    scans: list[int], odometries: list[int], later: list[int], late: int
) -> None:
    sent: list[tuple[int, Reading, int]] = [
        (n, scan(n / 16.0), late) for n in np.cumsum(scans).tolist()
    ]
    lateness = [*later, *([0] * 20)]
    sent += [
        (n, odometry(n / 16.0), lateness[i]) for i, n in enumerate(np.cumsum(odometries).tolist())
    ]
    # Each comes in its own order: who was sent later does not overtake.
    arrived, latest = [], {True: 0, False: 0}
    for n, reading, delay in sent:
        is_scan = isinstance(reading, Scan)
        latest[is_scan] = max(latest[is_scan], n + delay)
        arrived.append((latest[is_scan], reading))
    readings = [reading for _, reading in sorted(arrived, key=lambda entry: entry[0])]
    assert through(ReorderWindow(0.25), readings) == sorted(readings, key=key)


@given(st.lists(st.tuples(st.integers(0, 64), st.integers(0, 3), st.booleans())))
def test_readings_late_by_less_than_the_window_are_put_in_order_once_that_is_known(
    sent: list[tuple[int, int, bool]],
) -> None:
    first: list[Reading] = [scan(1.0), scan(1.0625), scan(1.0)]
    readings = [
        (sent_at + late, scan(2 + sent_at / 16.0) if is_scan else odometry(2 + sent_at / 16.0))
        for sent_at, late, is_scan in sent
    ]
    arrived = [*first, *(reading for _, reading in sorted(readings, key=lambda entry: entry[0]))]
    assert through(ReorderWindow(0.25), arrived) == sorted(arrived, key=key)


def warm(*kinds: type[Scan] | type[OdometryReading]) -> ReorderWindow:
    """Return a window that has known for two seconds, until 3.0, who sends."""
    window = ReorderWindow(0.25)
    for stamp_s in np.arange(1.0, 3.01, 0.125).tolist():
        for kind in kinds:
            window.push(scan(stamp_s) if kind is Scan else odometry(stamp_s))
    window.flush()
    return window


def test_scans_alone_wait_for_nothing_once_that_is_known() -> None:
    assert warm(Scan).push(now := scan(3.0625)) == (now,)


def test_a_scan_waits_for_odometry_as_late_as_it_is() -> None:
    window = warm(OdometryReading, Scan)
    before, now, after = odometry(3.0625), scan(3.125), odometry(3.125)
    assert window.push(before) == ()
    assert window.push(now) == (before,)
    assert window.push(after) == (after, now)
    # And no longer than the window.
    assert window.push(scan(3.1875)) == ()
    assert len(window.push(scan(3.5)) or ()) == 1


def test_odometry_that_has_fallen_silent_is_not_waited_for() -> None:
    window = warm(OdometryReading, Scan)
    assert window.push(scan(5.0)) == ()
    assert window.push(late := scan(5.0625)) is not None
    assert window.released_s == late.stamp_s


def test_odometry_of_the_same_stamp_comes_before_the_scan() -> None:
    late, early = odometry(1.0), scan(1.0)
    assert through(ReorderWindow(0.25), [early, late]) == [late, early]


def test_a_reading_older_than_a_released_one_is_refused() -> None:
    window = ReorderWindow(0.25)
    window.push(scan(1.0))
    window.push(odometry(2.0))
    assert window.released_s == 1.0
    assert window.push(scan(0.9)) is None
    assert len(window) == 1


def test_a_reading_as_old_as_a_released_one_is_taken() -> None:
    window = ReorderWindow(0.25)
    window.push(scan(1.0))
    window.flush()
    assert window.push(odometry(1.0)) == ()
    assert len(window) == 1


def test_nothing_is_released_before_the_window_has_passed() -> None:
    window = ReorderWindow(0.25)
    first, second, third = scan(1.0), scan(1.25), scan(1.26)
    assert window.released_s == -math.inf
    assert window.push(first) == ()
    assert window.push(second) == ()
    assert window.push(third) == (first,)


def test_a_stamp_far_ahead_costs_itself_and_does_not_lock_out_the_others() -> None:
    window = ReorderWindow(0.25)
    before, wrong, after = scan(1.0), scan(1e9), [scan(1.5), scan(2.0)]
    released = [*(window.push(before) or ()), *window.flush()]
    assert window.push(wrong) == ()
    assert window.flush() == ()
    for reading in after:
        released += window.push(reading) or ()
    assert [*released, *window.flush()] == [before, *after]
    assert window.refuted == 1


def test_a_pause_that_the_next_reading_confirms_costs_nothing() -> None:
    readings: list[Reading] = [scan(1.0), odometry(5000.0), scan(5000.0), scan(5000.5)]
    window = ReorderWindow(0.25)
    assert through(window, readings) == readings
    assert window.refuted == 0


def test_the_last_reading_may_have_jumped() -> None:
    window = ReorderWindow(0.25)
    window.push(first := scan(1.0))
    window.push(last := scan(1000.0))
    assert len(window) == 2
    assert window.finish() == (first, last)
