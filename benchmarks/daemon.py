"""What the daemon costs over the same work in one process, and how fast it answers meanwhile.

References: own.
"""

from __future__ import annotations

import multiprocessing
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice

import numpy as np

from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.report import Report, Run
from hmt_service.core.config import Config, load_config
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import DaemonFailure, Unavailable
from hmt_service.runtime.offline import map_readings
from hmt_service.service.client import HmtClient
from hmt_service.service.reports import DaemonState

_LOG = "intel"
_SCANS = 1_500
_QUICK_SCANS = 1_000
_IDLE_QUERIES = 500
_QUERY_PERIOD_S = 0.01
_START_S = 30.0
_STOP_S = 10.0
_POLL_S = 0.05
_OVERHEAD_TOLERANCE = 0.3
_LATENCY_TOLERANCE = 1.0
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


@dataclass(frozen=True, slots=True)
class _Sent:
    """One piece of a log sent through a daemon."""

    duration_s: float
    """From the first reading published to the map completed."""
    processed: int
    """Scans in the map then."""


def measure(run: Run) -> Report:
    """Send one piece of a log through a daemon, and through one process before and after."""
    config = load_config()
    source, readings, skipped = _readings(run, config)
    scans = sum(isinstance(reading, Scan) for reading in readings)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as sender:
        run.say(f"{source}: one process, before")
        before_s = map_readings(readings, config)[1].busy_s
        run.say(f"{source}: daemon")
        with _serving() as endpoint:
            sent = sender.submit(_send, endpoint, readings).result()
        run.say(f"{source}: one process, after")
        after_s = map_readings(readings, config)[1].busy_s
        run.say(f"{source}: daemon with queries")
        with _serving() as endpoint, HmtClient(endpoint) as client:
            sending = sender.submit(_send, endpoint, readings)
            loaded_s = _latencies(client, lambda: _is_over(sending))
            queried = sending.result()
            queries = iter(range(_IDLE_QUERIES))
            idle_s = _latencies(client, lambda: next(queries, None) is None)
    offline_s = 0.5 * (before_s + after_s)  # on either side of it, so that drift cancels
    lost = 2 * scans - sent.processed - queried.processed
    metrics = [
        Metric("over_one_process", sent.duration_s / offline_s, "1", _LOWER, _OVERHEAD_TOLERANCE),
        Metric("one_process_time", offline_s, "s", _LOWER, None),
        Metric("daemon_time", sent.duration_s, "s", _LOWER, None),
        Metric("scans_lost", float(lost), "1", _LOWER, 0.0),
        Metric("pose_queries_under_load", float(len(loaded_s)), "1", _HIGHER, None),
        *_latency_metrics(loaded_s, idle_s),
    ]
    return Report(
        tuple(
            Metric(f"{source}/{m.key}", m.value, m.unit, m.direction, m.rel_tol) for m in metrics
        ),
        skipped,
    )


def _readings(run: Run, config: Config) -> tuple[str, tuple[Reading, ...], tuple[str, ...]]:
    """Return the name and the readings of a log, and what could not be used."""
    scans = _QUICK_SCANS if run.is_quick else _SCANS
    path = recorded_file(f"{_LOG}.clf.bz2")
    if not isinstance(path, Missing):
        run.say(f"{_LOG}: reading")
        return _LOG, first_scans(read_recorded(path, config), scans), ()
    # Ray casting loads slowly, and only this branch needs it.
    from hmt_service.sim.simulation import INDOOR_LASER, simulate
    from hmt_service.sim.worlds.office import office

    run.say("simulating an office")
    instants = islice(simulate(office(0), INDOOR_LASER, 0), scans)
    readings = tuple(reading for instant in instants for reading in instant.readings)
    return "office", readings, (f"{_LOG}, simulated office instead: {path.reason}",)


@contextmanager
def _serving() -> Iterator[str]:
    """Run `hmt serve` in a process of its own, ready for work, and yield its endpoint."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    command = [sys.executable, "-m", "hmt_service", "serve", "--listen", endpoint]
    with (
        tempfile.TemporaryFile("w+") as output,
        subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT) as process,
    ):
        try:
            deadline_s = time.monotonic() + _START_S
            while not _is_running(endpoint):
                if process.poll() is not None or time.monotonic() > deadline_s:
                    output.seek(0)
                    raise DaemonFailure(f"no daemon within {_START_S:g} s: {output.read()}")
                time.sleep(_POLL_S)
            yield endpoint
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _is_running(endpoint: str) -> bool:
    try:
        with HmtClient(endpoint) as client:
            return client.status().state is DaemonState.RUNNING
    except Unavailable:
        return False


def _send(endpoint: str, readings: Sequence[Reading]) -> _Sent:
    """Publish at full speed and wait for the map; runs in a process that does nothing else."""
    with HmtClient(endpoint) as client:
        started = time.perf_counter()
        for reading in readings:
            client.publish(reading)
        processed = client.finish().processed_scans
        return _Sent(time.perf_counter() - started, processed)


def _is_over(sending: Future[_Sent]) -> bool:
    return not wait([sending], timeout=0.0).not_done


def _latencies(client: HmtClient, is_over: Callable[[], bool]) -> list[float]:
    """Ask for the pose at a steady pace until it is over; return the time of each answer, s.

    The time before the first pose exists does not count.
    """
    latencies_s: list[float] = []
    while not is_over():
        started = time.perf_counter()
        try:
            client.pose()
        except Unavailable:
            pass
        else:
            latencies_s.append(time.perf_counter() - started)
        time.sleep(_QUERY_PERIOD_S)
    return latencies_s


def _latency_metrics(loaded_s: Sequence[float], idle_s: Sequence[float]) -> Iterator[Metric]:
    if not loaded_s:
        raise DaemonFailure("no pose was answered while readings were coming in")
    for percentile in (50, 99):
        loaded, idle = (float(np.percentile(s, percentile)) for s in (loaded_s, idle_s))
        name = f"pose_p{percentile}"
        yield Metric(f"{name}_load_over_idle", loaded / idle, "1", _LOWER, _LATENCY_TOLERANCE)
        yield Metric(f"{name}_load", 1e3 * loaded, "ms", _LOWER, None)
        yield Metric(f"{name}_idle", 1e3 * idle, "ms", _LOWER, None)
