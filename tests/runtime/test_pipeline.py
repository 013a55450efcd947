from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_service.core.config import Config, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Event, GlobalMap, MapMethod, Scan
from hmt_service.errors import DaemonFailure, DeadlineExceeded, NotFound, Unavailable
from hmt_service.runtime.messages import (
    CompareRequest,
    Finish,
    Finished,
    MapRequest,
    Result,
    RunReport,
    SaveRequest,
    Wire,
    parts_of,
)
from hmt_service.runtime.pipeline import Pipeline
from tests.flat import SETTINGS, readings
from tests.runtime.harness import DEADLINE_S, Answers, Recorder, Running, encode


def save_area_count(engine: Engine, report: RunReport, _kept: Path | None) -> tuple[str, ...]:
    """Stand for the files: what is known here is told in a name."""
    snapshot = engine.snapshot()
    assert snapshot is not None
    return (f"{snapshot.areas} areas of {report.scans} scans",)


def fail_to_save(_engine: Engine, _report: RunReport, _kept: Path | None) -> tuple[str, ...]:
    raise OSError(28, "No space left on device")


def append_trajectory(
    log: Path, engine: Engine, _report: RunReport, _kept: Path | None
) -> tuple[str, ...]:
    with log.open("a") as file:
        file.write(f"{len(engine.trajectory())} poses\n")
    return ()


def stumble(_engine: Engine, _report: RunReport, _kept: Path | None) -> tuple[str, ...]:
    raise ZeroDivisionError("a bug")


@pytest.fixture
def config() -> Config:
    return load_config(text=SETTINGS)


@pytest.fixture
def running(config: Config) -> Iterator[Running]:
    pipeline, recorder = Pipeline(config, encode=encode, save=save_area_count), Recorder()
    pipeline.start(recorder)
    yield Running(pipeline, recorder)
    pipeline.stop(0.0)


def test_the_processes_make_the_map_that_one_process_makes(
    running: Running, config: Config
) -> None:
    sent = readings(160)
    odometry, engine = Odometry(config), Engine(config)
    events: list[Event] = []
    for reading in sent:
        if (tracking := odometry.process(reading)) is not None:
            events += engine.process(tracking)
    events += engine.finish()
    expected = engine.global_map(MapMethod.CONSISTENT)

    running.feed(sent)
    finished = running.finish()
    answer = Answers(running.pipeline, MapRequest(MapMethod.CONSISTENT)).wait()

    assert finished.files == (f"{len(expected.areas)} areas of 160 scans",)
    assert isinstance(answer, GlobalMap)
    assert [event for mapped in running.recorder.mapped for event in mapped.events] == events
    for mine, theirs in zip(answer.areas, expected.areas, strict=True):
        assert (mine.area, mine.keyframes, mine.visits) == (
            theirs.area,
            theirs.keyframes,
            theirs.visits,
        )
        # Here the linear algebra has more threads than in the children: equal up to rounding.
        np.testing.assert_allclose(
            mine.reference_from_area.mean, theirs.reference_from_area.mean, atol=1e-9
        )
        np.testing.assert_allclose(mine.points_in_area, theirs.points_in_area, atol=1e-6)


def test_readings_come_back_in_order_and_are_counted(running: Running) -> None:
    sent = readings(40)
    running.feed(sent)
    running.finish()
    stamps = [tracking.stamp_s for tracking in running.recorder.trackings]
    assert stamps == [reading.stamp_s for reading in sent if isinstance(reading, Scan)]
    odometry, topology = running.pipeline.status()
    assert (odometry.processed, topology.processed) == (80, 40)
    assert (odometry.backlog, topology.backlog) == (0, 0)
    assert running.pipeline.tracked_scans == 40


def test_input_may_follow_a_finish(running: Running) -> None:
    sent = readings(40)
    running.feed(sent[:40])
    assert running.finish() == Finished(1, ("1 areas of 20 scans",))
    running.feed(sent[40:])
    assert running.finish() == Finished(2, ("1 areas of 40 scans",))


def test_questions_are_answered_with_typed_errors(running: Running) -> None:
    before = Answers(running.pipeline, CompareRequest()).wait()
    assert isinstance(before, Unavailable)
    running.feed(readings(20))
    running.finish()
    unknown = Answers(running.pipeline, MapRequest(MapMethod.CONSISTENT, reference_area=99)).wait()
    assert isinstance(unknown, NotFound)
    assert "99" in str(unknown)


def test_a_late_answer_is_an_error_and_the_next_one_belongs_to_its_question(
    running: Running,
) -> None:
    running.feed(readings(20))
    late = Answers(running.pipeline, MapRequest(MapMethod.CONSISTENT), timeout_s=-1.0)
    running.pipeline.tick()
    assert isinstance(late.wait(), DeadlineExceeded)
    running.finish()
    assert Answers(running.pipeline, SaveRequest()).wait() == ("1 areas of 20 scans",)
    assert len(late.results) == 1


def test_an_answer_comes_in_parts_and_counts_once(running: Running) -> None:
    running.feed(readings(20))
    running.finish()
    request = MapRequest(MapMethod.CONSISTENT)
    pieces = [Answers(running.pipeline, request, part_bytes=1000) for _ in range(5)]
    whole = Answers(running.pipeline, request)
    expected = whole.wait()
    assert isinstance(expected, GlobalMap)
    assert len(whole.parts) == 1
    for one in pieces:
        answer = one.wait()
        assert isinstance(answer, GlobalMap)
        assert len(one.parts) > 2
        assert all(len(part.wire.payload) <= 1000 for part in one.parts)
        np.testing.assert_array_equal(
            answer.areas[0].points_in_area, expected.areas[0].points_in_area
        )


def test_what_nobody_waits_for_any_more_is_not_worked_on(running: Running) -> None:
    running.feed(readings(20))
    running.finish()
    late = Answers(running.pipeline, SaveRequest(), timeout_s=-1.0).wait()
    assert isinstance(late, DeadlineExceeded)
    assert "until its deadline" in str(late)


@given(st.binary(max_size=50), st.integers(1, 60))
def test_parts_joined_are_the_whole(payload: bytes, part_bytes: int) -> None:
    parts = list(parts_of(Wire(payload, "bytes"), part_bytes))
    assert b"".join(part.wire.payload for part in parts) == payload
    assert [part.number for part in parts] == list(range(len(parts)))
    assert {part.count for part in parts} == {len(parts)}
    assert [part.is_last for part in parts] == [False] * (len(parts) - 1) + [True]
    assert all(len(part.wire.payload) <= part_bytes for part in parts)


def test_too_many_questions_at_once_are_refused(running: Running) -> None:
    running.feed(readings(20))
    asked = [
        Answers(running.pipeline, MapRequest(MapMethod.SHORTEST_PATH, with_points=False))
        for _ in range(100)
    ]
    answers = [one.wait() for one in asked]
    refused = [answer for answer in answers if isinstance(answer, Unavailable)]
    assert refused
    assert all("32 wait" in str(answer) or "keyframe" in str(answer) for answer in refused)


@pytest.mark.parametrize(("is_urgent", "saves"), [(True, 1), (False, 2)])
def test_the_map_is_saved_before_it_is_smoothed(
    config: Config, tmp_path: Path, is_urgent: bool, saves: int
) -> None:
    log = tmp_path / "saved"
    pipeline, recorder = (
        Pipeline(config, encode=encode, save=partial(append_trajectory, log)),
        Recorder(),
    )
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    running.feed(readings(60))
    assert pipeline.finish(Finish(1, is_urgent))
    recorder.wait()
    assert log.read_text().splitlines() == ["60 poses"] * saves
    assert pipeline.stop(5.0) == ()


def test_a_map_that_cannot_be_saved_is_reported_and_kept(config: Config) -> None:
    pipeline, recorder = Pipeline(config, encode=encode, save=fail_to_save), Recorder()
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    running.feed(readings(20))
    finished = running.finish()
    assert finished.files == ()
    assert finished.failure is not None
    assert "No space left on device" in finished.failure
    assert isinstance(
        Answers(pipeline, MapRequest(MapMethod.CONSISTENT, with_points=False)).wait(), GlobalMap
    )
    assert pipeline.stop(5.0) == ()


def test_questions_without_end_do_not_stop_the_map(running: Running) -> None:
    is_over = threading.Event()
    request = MapRequest(MapMethod.CONSISTENT)

    def ask_again(_: Result) -> None:
        if not is_over.is_set():
            running.pipeline.request(request, ask_again, timeout_s=DEADLINE_S)

    running.feed(readings(20))
    running.finish()
    for _ in range(8):
        ask_again(())
    running.feed(readings(60)[40:])
    assert running.finish().files == ("1 areas of 60 scans",)
    is_over.set()


def test_a_bug_in_an_answer_costs_the_answer_and_not_the_map(config: Config) -> None:
    pipeline, recorder = Pipeline(config, encode=encode, save=stumble), Recorder()
    pipeline.start(recorder)
    running = Running(pipeline, recorder)
    running.feed(readings(20))
    answer = Answers(pipeline, SaveRequest()).wait()
    assert isinstance(answer, DaemonFailure)
    assert "a bug" in str(answer)
    failure = running.finish().failure
    assert failure is not None
    assert "a bug" in failure
    assert pipeline.watch(0.0) is None
    assert pipeline.stop(5.0) == ()


def test_stop_ends_processes_and_answers_what_waits(running: Running) -> None:
    running.feed(readings(100))
    pids = [status.pid for status in running.pipeline.status()]
    asked = [Answers(running.pipeline, MapRequest(MapMethod.CONSISTENT)) for _ in range(8)]
    running.pipeline.stop(0.2)
    assert all(len(one.results) == 1 for one in asked)
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
