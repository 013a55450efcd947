"""What a killed process costs: how long the service is not whole, and what of the map is lost.

A robot sends a recorded log at the rate of a sensor, while one process of the daemon after the
other is killed at a random moment: first odometry and topology, which the daemon replaces by
itself, then the whole of it by its gateway, which is started again as a service manager does it.

References: own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np

from benchmarks.cells import Result
from benchmarks.clients import send_forever
from benchmarks.latency import recorded_or_simulated, steady
from benchmarks.metric import Direction, Metric
from benchmarks.report import Report, Run
from hmt_service.client import HmtClient
from hmt_service.client.local import free_endpoint, is_running
from hmt_service.core.types import Reading
from hmt_service.errors import DaemonFailure, HmtError, Unavailable
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import read_map
from hmt_service.runtime.messages import ProcessName
from hmt_service.service.reports import DaemonState, Status

_RATE_HZ = 20.0
_SCANS = {False: 13_000, True: 1_500}
_KILLS = {False: {"child": 66, "gateway": 34}, True: {"child": 4, "gateway": 2}}
"""How often, by whether the run is quick."""
_LEAST_S, _MOST_S = 0.1, 3.0
"""Time from a service that is whole to the next kill."""
_RESTART_S = 0.2
"""What the service manager waits (RestartSec of `deploy/systemd/hmt.service`)."""
_DEADLINE_S = 60.0
_LOGGED = 4_000
"""Characters of its log that are told if it does not come back."""
_POLL_S = 0.02
_LOWER = Direction.LOWER_IS_BETTER
_TOLERANCE = 0.5


@dataclass(slots=True)
class _Outages:
    """What was measured of the kills of one kind."""

    whole_s: list[float] = field(default_factory=list)
    """From the kill to all processes taking work."""
    pose_s: list[float] = field(default_factory=list)
    """From the kill to the next answer to where the robot is."""


def measure(run: Run) -> Report:
    """Kill processes while a map is made."""
    source, readings, skipped = recorded_or_simulated(_SCANS[run.is_quick])
    kills = _KILLS[run.is_quick]
    sent = steady(readings, rate_hz=_RATE_HZ)
    result = run.once("kills", lambda: killed(sent, **kills))
    return Report(tuple(_metrics(source, result)), skipped)


def killed(readings: Sequence[Reading], *, child: int, gateway: int) -> Result:
    """Kill odometry and topology in turn, then the gateway, each as often as told.

    Args:
        readings: What the robot sends, at the pace of their stamps; once more when they end.
        child: Kills of odometry or topology.
        gateway: Kills of the gateway.
    """
    rng = np.random.default_rng(0)
    outages = {name: _Outages() for name in ProcessName}
    with tempfile.TemporaryDirectory() as folder:
        service = _Service(Path(folder) / "map.hmt")
        with service.running(), HmtClient(service.endpoint) as client:
            with _sending(service.endpoint, readings) as sent:
                _wait(lambda: client.status().stored_keyframes > 0)
                for _, name in zip(
                    range(child), cycle([ProcessName.ODOMETRY, ProcessName.TOPOLOGY]), strict=False
                ):
                    time.sleep(rng.uniform(_LEAST_S, _MOST_S))
                    _kill(client, _pid_of(client.status(), name), outages[name])
            finished = client.finish(timeout_s=_DEADLINE_S)
            lost = sent() - finished.processed_scans
            restarts = sum(process.restarts for process in client.status().processes)
            damaged = missing = 0
            with _sending(service.endpoint, readings, later_s=1e5):
                for _ in range(gateway):
                    time.sleep(rng.uniform(_LEAST_S, _MOST_S))
                    stored = client.status().stored_keyframes
                    died_s = time.perf_counter()
                    service.kill()
                    damaged += bool(check_map(service.map_file))
                    missing += stored - min(stored, len(read_map(service.map_file).keyframes))
                    looked_s = time.perf_counter() - died_s
                    time.sleep(_RESTART_S)
                    service.start()
                    # To look into the file is no part of what a service manager does.
                    _note(client, died_s + looked_s, outages[ProcessName.GATEWAY])
    return {
        "outages": {n: {"whole_s": o.whole_s, "pose_s": o.pose_s} for n, o in outages.items()},
        "kills": child + gateway,
        "restarts": restarts,
        "lost_scans": lost,
        "damaged_files": damaged,
        "missing_keyframes": missing,
    }


class _Service:
    """`hmt serve` with a map file, which may be killed and started again."""

    def __init__(self, map_file: Path) -> None:
        self.map_file = map_file
        self.log_file = map_file.with_suffix(".log")
        self.endpoint = free_endpoint()
        self._process: subprocess.Popen[bytes] | None = None

    @contextmanager
    def running(self) -> Iterator[None]:
        self.start()
        try:
            _wait(lambda: is_running(self.endpoint))
            yield
        except DaemonFailure as error:
            last = self.log_file.read_text()[-_LOGGED:]
            raise DaemonFailure(f"{error}; what the service said last: {last}") from error
        finally:
            self.kill()

    def start(self) -> None:
        command = [sys.executable, "-m", "hmt_service", "serve", "--listen", self.endpoint]
        command += ["--map", str(self.map_file)]
        environment = {n: text for n, text in os.environ.items() if not n.startswith("HMT_")}
        with self.log_file.open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@contextmanager
def _sending(
    endpoint: str, readings: Sequence[Reading], *, later_s: float = 0.0
) -> Iterator[Callable[[], int]]:
    """Send readings meanwhile; yields what returns, afterwards, how many scans were sent."""
    is_over, scans = threading.Event(), []
    sender = threading.Thread(
        target=lambda: scans.append(
            send_forever(endpoint, readings, is_over.is_set, later_s=later_s)
        )
    )
    sender.start()
    try:
        yield lambda: scans[0]
    finally:
        is_over.set()
        sender.join()


def _pid_of(status: Status, name: ProcessName) -> int:
    return next(process.pid for process in status.processes if process.name is name)


def _kill(client: HmtClient, pid: int, outages: _Outages) -> None:
    assert pid > 0, "a process that is not there cannot be killed"
    died_s = time.perf_counter()
    os.kill(pid, signal.SIGKILL)
    with suppress(HmtError):
        client.pose()
        outages.pose_s.append(time.perf_counter() - died_s)
    _wait(lambda: pid not in {process.pid for process in client.status().processes})
    _wait(partial(_is_whole, client))
    outages.whole_s.append(time.perf_counter() - died_s)


def _note(client: HmtClient, died_s: float, outages: _Outages) -> None:
    _wait(partial(_is_whole, client))
    outages.whole_s.append(time.perf_counter() - died_s)
    _wait(lambda: client.pose() is not None)
    outages.pose_s.append(time.perf_counter() - died_s)


def _is_whole(client: HmtClient) -> bool:
    return client.status().state is DaemonState.RUNNING


def _wait(is_true: Callable[[], bool]) -> None:
    deadline_s = time.perf_counter() + _DEADLINE_S
    why = "it answers"
    while time.perf_counter() < deadline_s:
        try:
            if is_true():
                return
            why = "it answers"
        except Unavailable as error:
            why = str(error)
        time.sleep(_POLL_S)
    raise DaemonFailure(f"the service is not whole again after {_DEADLINE_S:g} s: {why}")


def _metrics(source: str, result: Result) -> Iterator[Metric]:
    for name, outages in result["outages"].items():
        for what, times_s in outages.items():
            if times_s:
                key = f"{source}/{name}/{what.removesuffix('_s')}"
                for label, percent in (("p50", 50.0), ("max", 100.0)):
                    value = float(np.percentile(times_s, percent))
                    yield Metric(f"{key}_{label}", value, "s", _LOWER, _TOLERANCE)
    for key in ("lost_scans", "damaged_files", "missing_keyframes"):
        yield Metric(f"{source}/{key}", float(result[key]), "1", _LOWER, 0.0)
    for key in ("kills", "restarts"):
        yield Metric(f"{source}/{key}", float(result[key]), "1", _LOWER, None)
