from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from hmt_service.core.config import SensorConfig
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.runtime.messages import Finish, Wire
from hmt_service.service.codec import encoding_of
from hmt_service.service.intake import Intake, IntakeLimits
from hmt_service.service.keys import Input
from hmt_service.service.readings import ReadingDecoder, encode_reading
from tests.flat import readings
from tests.messages import laser_scan
from tests.service.harness import wait_until

LIMITS = IntakeLimits(sample_bytes=20_000, queue_bytes=250_000, silence_s=0.05)


class Sink:
    """Takes readings, one by one once the gate is open."""

    def __init__(self) -> None:
        self.taken: list[Reading] = []
        self.finished: list[tuple[int, int]] = []
        self.gate = threading.Event()
        self.gate.set()

    def submit(self, reading: Reading) -> bool:
        assert self.gate.wait(5.0)
        self.taken.append(reading)
        return True

    def finish(self, finish: Finish) -> bool:
        self.finished.append((finish.number, len(self.taken)))
        return True


@pytest.fixture
def sink() -> Sink:
    return Sink()


@pytest.fixture
def intake(sink: Sink) -> Iterator[Intake]:
    intake = Intake(ReadingDecoder(SensorConfig()), LIMITS, submit=sink.submit, finish=sink.finish)
    intake.start()
    yield intake
    sink.gate.set()
    intake.stop()


def send(intake: Intake, reading: Reading) -> None:
    name = Input.ODOMETRY if isinstance(reading, OdometryReading) else Input.SCAN
    offer(intake, name, encode_reading(reading))


def offer(intake: Intake, name: Input | None, message: Wire) -> None:
    intake.offer(name, len(message.payload), lambda: (message.payload, message.encoding))


def finished(intake: Intake, sink: Sink, number: int) -> None:
    intake.finish(Finish(number))
    wait_until(lambda: bool(sink.finished) and sink.finished[-1][0] == number)


def test_readings_pass_in_order_and_finish_comes_behind_them(intake: Intake, sink: Sink) -> None:
    sent = readings(20)
    for reading in sent:
        send(intake, reading)
    finished(intake, sink, 1)
    assert sink.finished == [(1, 40)]
    assert [(r.stamp_s, type(r)) for r in sink.taken] == [(r.stamp_s, type(r)) for r in sent]
    counts = intake.counts()
    assert (counts.received, counts.accepted, counts.queued, counts.reordering) == (40, 40, 0, 0)


def test_readings_wait_no_longer_once_nothing_follows(intake: Intake, sink: Sink) -> None:
    send(intake, readings(1)[0])
    wait_until(lambda: len(sink.taken) == 1)


def test_every_sample_is_counted_once(intake: Intake, sink: Sink) -> None:
    for reading in reversed(readings(2)):
        send(intake, reading)
    laser = laser_scan([1.0, float("nan"), 1.0], stamp_s=2000.0)
    encoding = encoding_of(type(laser))
    offer(intake, Input.SCAN, Wire(laser.SerializeToString(), encoding))
    offer(intake, Input.SCAN, Wire(b"\xff\xff", encoding))
    offer(intake, Input.SCAN, Wire(b"", "text/plain"))
    offer(intake, Input.SCAN, Wire(bytes(20_001), encoding))
    offer(intake, None, Wire(b"", "text/plain"))
    finished(intake, sink, 1)
    counts = intake.counts()
    assert (counts.received, counts.accepted) == (9, 5)
    assert counts.dropped_beams == {"nan_ranges": 1}
    reasons = ["not_protobuf", "wrong_encoding", "too_large", "unknown_key"]
    assert counts.refused == dict.fromkeys(reasons, 1)


def test_time_going_backwards_is_refused(intake: Intake, sink: Sink) -> None:
    sent = readings(40)
    for reading in sent[40:]:
        send(intake, reading)
    finished(intake, sink, 1)
    for reading in sent[:10]:
        send(intake, reading)
    finished(intake, sink, 2)
    assert intake.counts().refused == {"time_backwards": 10}
    assert sink.finished == [(1, 40), (2, 40)]


def test_what_does_not_fit_is_dropped_and_counted_and_the_rest_kept(
    intake: Intake, sink: Sink
) -> None:
    sink.gate.clear()
    sent = [reading for reading in readings(60) if isinstance(reading, Scan)]
    for reading in sent:
        send(intake, reading)
    counts = intake.counts()
    dropped = counts.refused["queue_full"]
    assert dropped > 0
    assert counts.queued_bytes <= LIMITS.queue_bytes
    assert counts.received == counts.accepted + dropped + counts.queued
    sink.gate.set()
    finished(intake, sink, 1)
    assert len(sink.taken) == 60 - dropped


def test_discarded_samples_are_counted(intake: Intake, sink: Sink) -> None:
    sink.gate.clear()
    for reading in readings(10):
        send(intake, reading)
    intake.discard()
    sink.gate.set()
    finished(intake, sink, 1)
    counts = intake.counts()
    assert counts.discarded > 0
    assert counts.received == counts.accepted + counts.discarded == 20
    assert counts.queued == 0


def test_what_comes_late_does_not_pass_the_last_finish(intake: Intake, sink: Sink) -> None:
    early, late = readings(1)
    send(intake, early)
    intake.close()
    send(intake, late)
    finished(intake, sink, 1)
    assert sink.finished == [(1, 1)]
    assert intake.counts().refused == {"stopping": 1}


def test_nothing_is_taken_after_the_end(intake: Intake) -> None:
    intake.stop()
    send(intake, readings(1)[0])
    assert intake.counts().refused == {"stopping": 1}
    wait_until(lambda: not any(t.name == "intake" and t.is_alive() for t in threading.enumerate()))
    assert not intake.is_broken
