"""What the tests of the pipeline share: a listener, and a pipeline that is fed."""

from __future__ import annotations

import threading

from hmt_service.core.types import Reading, Tracking
from hmt_service.errors import HmtError
from hmt_service.runtime.messages import (
    Answer,
    Finish,
    Finished,
    Mapped,
    Part,
    ProcessFailure,
    ProcessName,
    Request,
    Result,
    Wire,
    dump,
    load,
)
from hmt_service.runtime.pipeline import Pipeline

DEADLINE_S = 20.0


class Recorder:
    """Keeps what the pipeline tells."""

    def __init__(self) -> None:
        self.trackings: list[Tracking] = []
        self.mapped: list[Mapped] = []
        self.finished: list[Finished] = []
        self.failures: list[tuple[ProcessFailure, bool]] = []
        self.recovered: list[ProcessName] = []
        self.sessions = 0
        self._has_finished = threading.Event()

    def on_tracking(self, tracking: Tracking) -> None:
        self.trackings.append(tracking)

    def on_map(self, mapped: Mapped) -> None:
        self.mapped.append(mapped)
        if mapped.finished is not None:
            self.finished.append(mapped.finished)
            self._has_finished.set()

    def on_failure(self, failure: ProcessFailure, *, is_session_over: bool) -> None:
        self.failures.append((failure, is_session_over))

    def on_session_over(self) -> None:
        self.sessions += 1

    def on_recovery(self, name: ProcessName, outage_s: float) -> None:
        assert outage_s > 0.0
        self.recovered.append(name)

    def wait(self) -> Finished:
        assert self._has_finished.wait(DEADLINE_S)
        self._has_finished.clear()
        return self.finished[-1]


def encode(answer: Answer) -> Wire:
    """Stand for the messages of the service."""
    return Wire(dump(answer), type(answer).__name__)


class Answers:
    """Collects the one answer to a request, which may come in parts."""

    def __init__(
        self,
        pipeline: Pipeline,
        request: Request,
        timeout_s: float = DEADLINE_S,
        part_bytes: int | None = None,
    ) -> None:
        self.results: list[Answer | tuple[str, ...] | HmtError] = []
        self.parts: list[Part] = []
        self._is_there = threading.Event()
        pipeline.request(request, self._take, timeout_s=timeout_s, part_bytes=part_bytes)

    def _take(self, result: Result) -> None:
        if not isinstance(result, Part):
            self.results.append(result)
        else:
            self.parts.append(result)
            if not result.is_last:
                return
            assert [part.number for part in self.parts] == list(range(result.count))
            self.results.append(load(b"".join(part.wire.payload for part in self.parts)))
        self._is_there.set()

    def wait(self) -> Answer | tuple[str, ...] | HmtError:
        assert self._is_there.wait(DEADLINE_S)
        return self.results[0]


class Running:
    """A pipeline with both processes, its listener, and what it is fed."""

    def __init__(self, pipeline: Pipeline, recorder: Recorder) -> None:
        self.pipeline = pipeline
        self.recorder = recorder
        self._finishes = 0

    def feed(self, sent: list[Reading]) -> None:
        for reading in sent:
            assert self.pipeline.submit(reading)

    def finish(self) -> Finished:
        self._finishes += 1
        assert self.pipeline.finish(Finish(self._finishes))
        return self.recorder.wait()

    def pid(self, name: ProcessName) -> int:
        return next(status.pid for status in self.pipeline.status() if status.name == name)
