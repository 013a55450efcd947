"""Factories of the service's tests: real daemons on loopback, and gateways without a map."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hmt_service.client import HmtClient
from hmt_service.client.local import free_endpoint, is_running
from hmt_service.core.config import Config, Preset, SensorConfig
from hmt_service.core.types import Reading
from hmt_service.io import foxglove
from hmt_service.io.decoding import Decoded
from hmt_service.runtime.messages import (
    Finish,
    Finished,
    Mapped,
    ProcessStatus,
    Request,
    Result,
    RunReport,
)
from hmt_service.runtime.pipeline import Pipeline
from hmt_service.service.codec import encode
from hmt_service.service.gateway import Gateway
from hmt_service.service.intake import IntakeLimits
from hmt_service.service.keys import Keys
from hmt_service.service.reports import DaemonState
from hmt_service.service.ros2 import Ros2Input
from hmt_service.service.session import Endpoints, open_session
from tests.flat import SETTINGS

DEADLINE_S = 20.0
SAVED = ("map.hmt",)


def wait_until(is_true: Callable[[], bool], *, timeout_s: float = DEADLINE_S) -> None:
    """Return as soon as the condition holds; fail when it does not in time."""
    deadline_s = time.monotonic() + timeout_s
    while not is_true():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s"
        time.sleep(0.01)


@dataclass
class RunningDaemon:
    """`hmt serve` in a process of its own."""

    endpoint: str
    out: Path
    process: subprocess.Popen[str]
    zenoh_config: Path | None = None
    """What its clients are let in with."""

    def client(self) -> HmtClient:
        return HmtClient(self.endpoint, zenoh_config=self.zenoh_config)

    def output(self) -> str:
        """Wait for the end and return what was printed."""
        text, _ = self.process.communicate(timeout=DEADLINE_S)
        return " ".join(text.split())


@contextmanager
def running_daemon(
    out: Path,
    *,
    router: str | None = None,
    listen: str | None = None,
    zenoh_config: Path | None = None,
    is_awaited: bool = True,
    preset: Preset = Preset.PLANAR,
    map_file: Path | None = None,
    options: Sequence[str] = (),
) -> Iterator[RunningDaemon]:
    """Run a daemon that is killed at the end.

    Args:
        out: Folder to save to.
        router: Endpoint of a router to reach it through, instead of its own.
        listen: Its own endpoint; a free one on loopback if not given.
        zenoh_config: What its clients are let in with.
        is_awaited: Whether it shall be ready for work.
        preset: Kind of sensor that it expects.
        map_file: Map file to go on with.
        options: More of `hmt serve`.
    """
    endpoint = router or listen or free_endpoint()
    settings = out.parent / "settings.yaml"
    settings.write_text(SETTINGS)
    command = [sys.executable, "-m", "hmt_service", "serve", "--out", str(out), *options]
    if map_file is not None:
        command += ["--map", str(map_file)]
    if map_file is None or not map_file.exists():
        command += ["--preset", preset, "--config", str(settings)]
    meeting = ["--connect", router] if router else ["--listen", endpoint]
    with subprocess.Popen(
        [*command, *meeting],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        daemon = RunningDaemon(endpoint, out, process, zenoh_config)
        try:
            if is_awaited:
                wait_until(lambda: _is_running(daemon))
            yield daemon
        finally:
            process.kill()


def _is_running(daemon: RunningDaemon) -> bool:
    assert daemon.process.poll() is None, daemon.output()
    return is_running(daemon.endpoint, daemon.zenoh_config)


def as_received(reading: Reading, sensor: SensorConfig) -> Reading:
    """Return a reading as the daemon receives it, to the last bit."""
    message = foxglove.encode(reading)
    received = foxglove.decode(
        message.DESCRIPTOR.full_name,
        message.SerializeToString(),
        min_range_m=sensor.min_range_m,
        max_range_m=sensor.max_range_m,
    )
    assert isinstance(received, Decoded)
    return received.reading


class NoMap(Pipeline):
    """Takes readings and saves nothing: who may ask is settled before the map is."""

    gateway: Gateway

    def __init__(self) -> None:
        super().__init__(Config(), encode=encode)
        self.shut_downs = 0
        self.is_loaded = True

    def shut_down(self) -> None:
        self.shut_downs += 1

    @property
    def is_ready(self) -> bool:
        return self.is_loaded

    def status(self) -> tuple[ProcessStatus, ...]:
        return ()

    def submit(self, _: Reading) -> bool:
        return True

    def finish(self, finish: Finish) -> bool:
        finished = Finished(finish.number, SAVED)
        self.gateway.on_map(Mapped(None, (), RunReport(0, 0.0, 0.0), 0, 0, finished))
        return True

    def request(
        self,
        _: Request,
        on_result: Callable[[Result], None],
        *,
        timeout_s: float,
        part_bytes: int | None = None,
    ) -> None:
        del timeout_s, part_bytes
        on_result(SAVED)


@contextmanager
def serving(endpoints: Endpoints, *, robot: str = "robot") -> Iterator[NoMap]:
    """Serve one robot, without a map."""
    pipeline = NoMap()
    with open_session(endpoints) as session:
        pipeline.gateway = Gateway(
            session,
            Keys("site", robot),
            Config(),
            pipeline,
            ros2=Ros2Input(),
            limits=IntakeLimits(),
            shut_down=pipeline.shut_down,
            change_map=lambda change: change.answer(SAVED),
        )
        pipeline.gateway.open()
        try:
            yield pipeline
        finally:
            if pipeline.gateway.status().state is not DaemonState.STOPPING:
                pipeline.gateway.close_input()
            pipeline.gateway.close()
