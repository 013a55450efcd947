"""Processes that die, of themselves or of what they are given, and those that go on."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hmt_service.core.config import Config, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import FloatArray, identity
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import GlobalMap, MapMethod, Reading, Scan, Tracking
from hmt_service.io.map_file import read_map
from hmt_service.runtime.messages import (
    Finish,
    Finished,
    Mapped,
    MapRequest,
    Part,
    ProcessFailure,
    ProcessName,
    RelocalizeRequest,
    Result,
    RunReport,
    SaveRequest,
    dump,
    load,
)
from hmt_service.runtime.offline import map_readings
from hmt_service.runtime.pipeline import Pipeline
from hmt_service.runtime.recovery import Session
from hmt_service.service.kept_map import KeptMap
from tests.flat import SETTINGS, readings
from tests.mapped import map_file_in
from tests.runtime.harness import DEADLINE_S, Answers, Recorder, Running, encode

SCANS = 160
BOTH = [ProcessName.ODOMETRY, ProcessName.TOPOLOGY]


def count_scans(engine: Engine, report: RunReport, _kept: Path | None) -> tuple[str, ...]:
    return (f"{engine.scans} of {report.scans} scans",)


def die(_engine: Engine, _report: RunReport, _kept: Path | None) -> tuple[str, ...]:
    os.kill(os.getpid(), signal.SIGKILL)
    return ()


@pytest.fixture
def config() -> Config:
    return load_config(text=SETTINGS)


@pytest.fixture
def running(config: Config) -> Iterator[Running]:
    recorder = Recorder()
    pipeline = Pipeline(config, encode=encode, save=count_scans)
    pipeline.start(recorder)
    yield Running(pipeline, recorder)
    pipeline.stop(0.0)


def watched(running: Running, *, failures: int = 1) -> None:
    """Look after the processes until as many have died."""
    deadline_s = time.monotonic() + DEADLINE_S
    while len(running.recorder.failures) < failures:
        assert time.monotonic() < deadline_s
        assert running.pipeline.watch(0.02) is None


def is_idle(running: Running) -> bool:
    return all(status.backlog == 0 for status in running.pipeline.status())


def wait_until_idle(running: Running) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not is_idle(running):
        assert time.monotonic() < deadline_s
        assert running.pipeline.watch(0.02) is None


def kill(running: Running, name: ProcessName) -> int:
    pid = running.pid(name)
    os.kill(pid, signal.SIGKILL)
    return pid


@pytest.mark.parametrize("is_at_rest", [True, False])
@pytest.mark.parametrize("name", BOTH)
def test_the_map_is_as_if_no_process_had_died(
    running: Running, config: Config, name: ProcessName, is_at_rest: bool
) -> None:
    sent = readings(SCANS)
    engine, _ = map_readings(sent, config)
    expected = engine.global_map(MapMethod.CONSISTENT)

    running.feed(sent[: SCANS // 2])
    if is_at_rest:
        wait_until_idle(running)
    pid = kill(running, name)
    watched(running)
    running.feed(sent[SCANS // 2 :])
    finished = running.finish()
    answer = Answers(running.pipeline, MapRequest(MapMethod.CONSISTENT)).wait()

    failure = ProcessFailure(name, pid, "was killed by SIGKILL")
    assert running.recorder.failures == [(failure, False)]
    assert running.recorder.recovered == [name]
    assert [s.restarts for s in running.pipeline.status()] == [int(name is each) for each in BOTH]
    # Nothing lost, nothing twice.
    assert finished.files == (f"{SCANS} of {SCANS} scans",)
    stamps = [tracking.stamp_s for tracking in running.recorder.trackings]
    assert stamps == [reading.stamp_s for reading in sent if isinstance(reading, Scan)]
    keyframes = [t.keyframe.index for t in running.recorder.trackings if t.keyframe]
    assert keyframes == list(range(len(keyframes)))
    told = [event for mapped in running.recorder.mapped for event in mapped.events]
    assert [event.kind for event in told] == [event.kind for event in engine.audit.events]
    assert isinstance(answer, GlobalMap)
    for mine, theirs in zip(answer.areas, expected.areas, strict=True):
        assert (mine.keyframes, mine.visits) == (theirs.keyframes, theirs.visits)
        np.testing.assert_allclose(
            mine.reference_from_area.mean, theirs.reference_from_area.mean, atol=1e-4
        )


def test_an_odometry_goes_on_where_another_was(config: Config) -> None:
    sent = readings(120)
    odometry = Odometry(config)
    expected = [t for r in sent if (t := odometry.process(r)) is not None]
    odometry, keyframes, trackings = Odometry(config), [], []
    for number, reading in enumerate(sent):
        if (tracking := odometry.process(reading)) is not None:
            trackings.append(tracking)
            keyframes += [tracking.keyframe] if tracking.keyframe else []
        if number % 7 == 0:
            memory = load(dump(odometry.memory))
            window = keyframes[-config.odometry.window_keyframes :]
            odometry = Odometry.resumed(config, memory, window)
    assert [t.failure for t in trackings] == [None] * 120
    # A window that is told holds points of single precision: a keyframe may come a scan later.
    assert abs(trackings[-1].keyframe_index - expected[-1].keyframe_index) <= 1
    np.testing.assert_allclose(travelled(trackings), travelled(expected), atol=2e-3)


def travelled(trackings: list[Tracking]) -> FloatArray:
    """Return where the scans were taken, shape (N, 4, 4)."""
    at, poses = identity(), []
    for tracking in trackings:
        if tracking.keyframe is not None:
            at = at @ tracking.keyframe.previous_from_body.mean
        poses.append(at @ tracking.keyframe_from_body.mean)
    return np.array(poses)


def test_what_the_map_file_has_is_not_taken_in_twice(config: Config, tmp_path: Path) -> None:
    known = tmp_path / "known.hmt"
    recorder = Recorder()
    pipeline = Pipeline(config, encode=encode, keeper=KeptMap(known))
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    sent = readings(SCANS)
    half = SCANS  # a scan and its odometry are two readings
    running.feed(sent[:half])
    wait_until_idle(running)
    # It writes when it has nothing to do, and tells nobody.
    deadline_s = time.monotonic() + DEADLINE_S
    while not known.exists() or len(read_map(known).scans) < SCANS // 2:
        assert time.monotonic() < deadline_s
        time.sleep(0.1)
    for _ in range(2):
        kill(running, ProcessName.TOPOLOGY)
        watched(running, failures=len(recorder.failures) + 1)
        running.feed(sent[half : half + 20])
        half += 20
        wait_until_idle(running)
    running.feed(sent[half:])
    running.finish()
    assert pipeline.stop(5.0) == ()
    held = read_map(known)
    assert [scan.stamp_s for scan in held.scans] == [r.stamp_s for r in sent if isinstance(r, Scan)]
    assert [k.index for k in held.keyframes] == list(range(len(held.keyframes)))
    assert all(k.failure is None for k in held.keyframes)
    assert not any(is_over for _, is_over in recorder.failures)


def test_who_waits_for_an_answer_learns_that_there_is_none(running: Running) -> None:
    running.feed(readings(20))
    running.finish()
    os.kill(running.pid(ProcessName.TOPOLOGY), signal.SIGSTOP)
    asked = [Answers(running.pipeline, SaveRequest()) for _ in range(4)]
    time.sleep(0.2)  # two of them are on their way
    kill(running, ProcessName.TOPOLOGY)
    watched(running)
    answers = [one.wait() for one in asked]
    # None is asked of another map, should there be one then.
    assert [str(answer) for answer in answers] == ["the topology process is gone: ask again"] * 4
    assert Answers(running.pipeline, SaveRequest()).wait() == ("20 of 20 scans",)


def test_a_reading_that_kills_the_odometry_twice_is_left_out(running: Running) -> None:
    sent = readings(40)
    poison = Scan(sent[39].stamp_s + 0.01, np.zeros((5, 2)), np.zeros(3))
    running.feed([*sent[:40], poison, *sent[40:]])
    watched(running, failures=2)
    assert running.finish().files == ("40 of 40 scans",)
    (first, _), (second, _) = running.recorder.failures
    assert first.reason == "ended with exit code 1"
    assert second.reason.endswith("of the same message, which is left out")
    assert not any(is_over for _, is_over in running.recorder.failures)


def test_a_finish_that_kills_the_topology_twice_is_answered(config: Config) -> None:
    recorder = Recorder()
    pipeline = Pipeline(config, encode=encode, save=die)
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    running.feed(readings(20))
    assert pipeline.finish(Finish(5))
    watched(running, failures=2)
    finished = recorder.wait()
    assert (finished.number, finished.files) == (5, ())
    assert finished.failure is not None
    assert "was killed by SIGKILL" in finished.failure
    # The robot goes on, in a map of its own.
    assert [is_over for _, is_over in recorder.failures] == [False, True]
    tracked = len(recorder.trackings)
    running.feed(readings(30, start_s=2000.0))
    wait_until_idle(running)
    assert len(recorder.trackings) == tracked + 30
    assert recorder.trackings[tracked].keyframe_index == 0
    snapshot = next(m.snapshot for m in reversed(recorder.mapped) if m.snapshot is not None)
    assert snapshot.keyframes == 1 + recorder.trackings[-1].keyframe_index
    assert recorder.mapped[-1].report.scans == 50
    pipeline.stop(0.0)


def test_processes_that_never_get_ready_are_given_up(running: Running) -> None:
    failure, deadline_s = None, time.monotonic() + DEADLINE_S
    while failure is None:
        assert time.monotonic() < deadline_s
        kill(running, ProcessName.ODOMETRY)
        failure = running.pipeline.watch(1.0)
    assert failure.name is ProcessName.ODOMETRY
    assert len(running.recorder.failures) in (2, 3)  # the first may have been ready
    assert not running.pipeline.is_alive(ProcessName.ODOMETRY)
    assert not running.pipeline.submit(readings(1)[0])
    assert running.pipeline.finish_map(Finish(7))


def mapped(known_scans: int, stored_scans: int) -> Mapped:
    return Mapped(None, (), RunReport(known_scans, 0.0, 0.0), known_scans, stored_scans)


def journal_of(session: Session) -> tuple[bytes, ...]:
    assert session.interrupted is not None
    assert session.interrupted.known_scans == session.known_scans
    return session.interrupted.journal


def test_a_session_keeps_what_is_not_stored() -> None:
    session = Session(first_keyframe=0)
    session.note(None, mapped(10, 10))
    for scan in (b"a", b"b", b"c"):
        session.note(scan, mapped(session.known_scans + 1, 10))
    session.note(b"finish", mapped(13, 10))
    assert journal_of(session) == (b"a", b"b", b"c")
    session.note(b"d", mapped(14, 12))
    assert journal_of(session) == (b"c", b"d")
    session.note(b"left out", mapped(14, 14))
    assert journal_of(session) == ()


def test_a_session_of_which_too_much_is_not_stored_cannot_be_gone_on_with() -> None:
    session, scan = Session(first_keyframe=0), bytes(1_000_000)
    for number in range(70):
        session.note(scan, mapped(number + 1, 0))
    assert not session.can_go_on
    session.note(scan, mapped(71, 70))
    assert session.can_go_on
    assert len(journal_of(session)) == 1


def test_input_is_taken_while_a_process_is_replaced(running: Running) -> None:
    sent: list[Reading] = readings(60)
    running.feed(sent[:20])
    kill(running, ProcessName.ODOMETRY)
    running.feed(sent[20:])  # waits for nobody
    assert len(running.recorder.trackings) < 60
    watched(running)
    assert running.finish() == Finished(1, ("60 of 60 scans",))


def test_a_process_that_is_killed_while_it_starts_has_tried_nothing(config: Config) -> None:
    recorder = Recorder()
    pipeline = Pipeline(config, encode=encode, save=count_scans)
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    running.feed(readings(60)[:80])
    wait_until_idle(running)
    running.feed(readings(60)[80:])
    # One at work, and the next one while it starts: with all that it is to go on with on its way.
    for failures in (1, 2):
        kill(running, ProcessName.TOPOLOGY)
        watched(running, failures=failures)
    assert running.finish().files == ("60 of 60 scans",)
    assert [is_over for _, is_over in recorder.failures] == [False, False]
    pipeline.stop(0.0)


@pytest.mark.parametrize("is_known", [True, False])
def test_a_topology_that_dies_before_the_session_begins_loses_nothing(
    config: Config, tmp_path: Path, is_known: bool
) -> None:
    known = map_file_in(tmp_path) if is_known else tmp_path / "new.hmt"
    before = len(read_map(known).scans) if is_known else 0
    recorder = Recorder()
    pipeline = Pipeline(config, encode=encode, keeper=KeptMap(known))
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    running.feed(readings(30, start_s=5e4))
    kill(running, ProcessName.TOPOLOGY)
    watched(running)
    assert running.finish().failure is None
    assert recorder.failures[0][1] is False
    assert pipeline.stop(5.0) == ()
    assert len(read_map(known).scans) == before + 30


def test_both_processes_may_die_at_once(running: Running) -> None:
    running.feed(readings(60)[:60])
    for name in BOTH:
        kill(running, name)
    watched(running, failures=2)
    running.feed(readings(60)[60:])
    assert running.finish().files == ("60 of 60 scans",)


def test_a_client_that_takes_no_answer_does_not_keep_others_waiting(running: Running) -> None:
    running.feed(readings(20))
    running.finish()
    is_over = threading.Event()

    def stuck(result: Result) -> None:
        if isinstance(result, Part):
            is_over.wait(DEADLINE_S)
        else:
            is_over.set()

    running.pipeline.request(MapRequest(MapMethod.CONSISTENT), stuck, timeout_s=60.0)
    time.sleep(0.3)
    kill(running, ProcessName.TOPOLOGY)
    started_s = time.monotonic()
    watched(running)
    assert time.monotonic() - started_s < 10.0
    assert is_over.is_set()


def test_an_answer_that_cannot_be_passed_on_costs_nobody_else_his(running: Running) -> None:
    running.feed(readings(20))
    running.finish()

    def broken(_: Result) -> None:
        raise ZeroDivisionError("a bug")

    running.pipeline.request(SaveRequest(), broken, timeout_s=DEADLINE_S)
    assert Answers(running.pipeline, SaveRequest()).wait() == ("20 of 20 scans",)
    assert running.pipeline.watch(0.0) is None


def test_a_robot_that_is_to_be_sought_is_sought_by_the_next_process(running: Running) -> None:
    running.feed(readings(60)[:60])
    wait_until_idle(running)
    assert Answers(running.pipeline, RelocalizeRequest()).wait() == ()
    wait_until(lambda: running.recorder.mapped[-1].wakes_up)
    kill(running, ProcessName.TOPOLOGY)
    watched(running)
    running.feed(readings(60)[60:])
    running.finish()
    told = [event.message for mapped in running.recorder.mapped for event in mapped.events]
    assert sum("the robot may be anywhere" in message for message in told) == 1


def wait_until(is_true: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + DEADLINE_S
    while not is_true():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)
