"""Factories of the service's tests: real daemons on loopback."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hmt_service.core.config import Preset, SensorConfig
from hmt_service.core.types import Reading
from hmt_service.io import foxglove
from hmt_service.io.decoding import Decoded
from hmt_service.service.client import HmtClient
from hmt_service.service.local import free_endpoint, is_running
from tests.flat import SETTINGS

DEADLINE_S = 20.0


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

    def client(self) -> HmtClient:
        return HmtClient(self.endpoint)

    def output(self) -> str:
        """Wait for the end and return what was printed."""
        text, _ = self.process.communicate(timeout=DEADLINE_S)
        return " ".join(text.split())


@contextmanager
def running_daemon(
    out: Path,
    *,
    router: str | None = None,
    is_awaited: bool = True,
    preset: Preset = Preset.PLANAR,
    map_file: Path | None = None,
    options: Sequence[str] = (),
) -> Iterator[RunningDaemon]:
    """Run a daemon that is killed at the end.

    Args:
        out: Folder to save to.
        router: Endpoint of a router to reach it through, instead of its own.
        is_awaited: Whether it shall be ready for work.
        preset: Kind of sensor that it expects.
        map_file: Map file to go on with.
        options: More of `hmt serve`.
    """
    endpoint = router or free_endpoint()
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
        daemon = RunningDaemon(endpoint, out, process)
        try:
            if is_awaited:
                wait_until(lambda: _is_running(daemon))
            yield daemon
        finally:
            process.kill()


def _is_running(daemon: RunningDaemon) -> bool:
    assert daemon.process.poll() is None, daemon.output()
    return is_running(daemon.endpoint)


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
