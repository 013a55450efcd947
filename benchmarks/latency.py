"""How long a robot and its users wait for the daemon, and what the daemon costs over one process.

Three waits: from a scan sent to its pose received, for the answer to "where is the robot", and for
a global map; while readings come in at the rate of a sensor, while they come in as fast as they can
be sent, and with nothing else to do. The daemon, the sender and the client that asks each question
are processes of their own.

References: own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import islice
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.cells import Result
from benchmarks.clients import Question, ask, received_poses, rest, send, stamp_of
from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.serving import serving
from hmt_service.core.config import load_config
from hmt_service.core.types import Reading, Scan
from hmt_service.errors import DaemonFailure
from hmt_service.runtime.offline import map_readings

RATE_HZ = 50.0
"""Scans per second of the sensor: a fast safety laser."""
FIGURE = "latency.png"
"""Name of the figure."""

_LOG, _WORLD = "intel", "office"
_BEGUN_S = 2.5
"""Sensor time after which a daemon knows who sends."""
_LAPS = 10
"""Enough of them for all scans."""
_SENSOR_RATE, _FULL_SPEED, _IDLE = "sensor_rate", "full_speed", "idle"
_SCAN_TO_POSE = "scan_to_pose"
_PERCENTILES = {"p50": 50.0, "p99": 99.0, "max": 100.0}
_OVERHEAD_TOLERANCE = 0.3
_LATENCY_TOLERANCE = 1.0
_LOWER = Direction.LOWER_IS_BETTER
_COLOURS = {_SENSOR_RATE: "#0072B2", _FULL_SPEED: "#D55E00", _IDLE: "#009E73"}
_PANELS: Mapping[str, Mapping[str, str]] = {
    "pose of a scan": {_SCAN_TO_POSE: "-"},
    "answer to ro/pose": {Question.POSE: "-"},
    "answer to ro/map": {Question.MAP: "-", Question.MAP_POINTS: ":"},
}
"""What the panels of the figure show, and in which style."""


@dataclass(frozen=True, slots=True)
class ScanToPose:
    """What became of the scans that were sent."""

    latencies_s: tuple[float, ...]
    """From a scan sent to its pose received."""
    unmatched: int
    """Scans whose pose never arrived: those before the first map, and what was lost."""


@dataclass(frozen=True, slots=True)
class _Effort:
    """How much is measured."""

    scans_at_sensor_rate: int
    scans_at_full_speed: int
    idle_s: float


_QUICK = _Effort(scans_at_sensor_rate=300, scans_at_full_speed=300, idle_s=1.5)
_FULL = _Effort(scans_at_sensor_rate=1_500, scans_at_full_speed=6_000, idle_s=6.0)


def measure(run: Run) -> Report:
    """Send the readings of a laser through daemons, and ask questions meanwhile."""
    effort = _QUICK if run.is_quick else _FULL
    source, read, skipped = _source()

    with ProcessPoolExecutor(1 + len(Question), get_context("spawn")) as processes:

        @cache
        def readings() -> tuple[Reading, ...]:  # a resumed run may need neither them nor processes
            run.say(f"{source}: reading")
            processes.map(rest, range(1 + len(Question)))  # loads the libraries meanwhile
            return steady(read(effort.scans_at_full_speed), rate_hz=RATE_HZ)

        cost = run.once("throughput", lambda: throughput(readings(), processes))
        sensor_rate = run.once(
            _SENSOR_RATE,
            lambda: under_load(
                first_scans(readings(), effort.scans_at_sensor_rate),
                processes,
                is_paced=True,
                idle_s=effort.idle_s,
            ),
        )
        full_speed = run.once(
            _FULL_SPEED,
            lambda: under_load(readings(), processes, is_paced=False, idle_s=effort.idle_s),
        )
    loads = {_SENSOR_RATE: sensor_rate, _FULL_SPEED: full_speed}
    _draw(loads, run.out / FIGURE)
    metrics = (*_cost_metrics(cost, loads), *_latency_metrics(cost, loads))
    named = tuple(replace(metric, key=f"{source}/{metric.key}") for metric in metrics)
    return Report(named, skipped, (run.out / FIGURE,))


# ------------------------------------------------------------------------ what is sent


def steady(readings: Sequence[Reading], *, rate_hz: float) -> tuple[Reading, ...]:
    """Return readings as a sensor of a steady rate would have sent them.

    Recorded logs are slower, and their stamps uneven; what there is to do per scan stays the same.

    Args:
        readings: In the order of time.
        rate_hz: Scans per second; odometry gets the stamp of the scan that follows it.
    """
    scan, result = 0, []
    for reading in readings:
        # Whole nanoseconds, as on the wire: stamps come back as they were sent.
        result.append(replace(reading, stamp_s=round(scan / rate_hz, 9)))
        scan += isinstance(reading, Scan)
    return tuple(result)


def recorded_or_simulated(scans: int) -> tuple[str, Sequence[Reading], tuple[str, ...]]:
    """Return the name of what is sent, its first scans, and what could not be used."""
    source, read, skipped = _source()
    return source, read(scans), skipped


def _source() -> tuple[str, Callable[[int], Sequence[Reading]], tuple[str, ...]]:
    """Return the name of what is sent, how to get its first scans, and what could not be used."""
    path = recorded_file(f"{_LOG}.clf.bz2")
    if isinstance(path, Missing):
        return _WORLD, _simulated, (f"{_LOG}, simulated {_WORLD} instead: {path.reason}",)
    return _LOG, partial(_recorded, path), ()


def _recorded(path: Path, scans: int) -> tuple[Reading, ...]:
    return first_scans(tuple(read_recorded(path, load_config())), scans)


def _simulated(scans: int) -> tuple[Reading, ...]:
    # Ray casting loads slowly, and only this branch needs it.
    from hmt_service.sim.simulation import INDOOR_LASER, simulate
    from hmt_service.sim.worlds.families import Family, draw

    instants = simulate(draw(Family.OFFICE, 0, laps=_LAPS), INDOOR_LASER, 0)
    return tuple(reading for instant in islice(instants, scans) for reading in instant.readings)


def _scans_in(readings: Sequence[Reading]) -> int:
    return sum(isinstance(reading, Scan) for reading in readings)


# ----------------------------------------------------------------------- units of work


def throughput(readings: Sequence[Reading], processes: ProcessPoolExecutor) -> Result:
    """Send readings as fast as they go, and map them in one process before and after."""
    config = load_config()
    before_s = map_readings(readings, config)[1].busy_s
    with serving() as endpoint:
        sent = processes.submit(send, endpoint, readings, is_paced=False).result()
    after_s = map_readings(readings, config)[1].busy_s
    scans = _scans_in(readings)
    return {
        "one_process_s": 0.5 * (before_s + after_s),  # on either side, so that drift cancels
        "daemon_s": sent.duration_s,
        "scans": scans,
        "lost": scans - sent.processed,
    }


def under_load(
    readings: Sequence[Reading], processes: ProcessPoolExecutor, *, is_paced: bool, idle_s: float
) -> Result:
    """Send readings and ask all questions meanwhile, then ask them with nothing else to do."""
    with serving() as endpoint, received_poses(endpoint) as received:
        sending = processes.submit(send, endpoint, readings, is_paced=is_paced)
        loaded = _ask_all(endpoint, processes, is_over=lambda: sending.done())
        sent = sending.result()
        ending_s = time.perf_counter() + idle_s
        idle = _ask_all(endpoint, processes, is_over=lambda: time.perf_counter() > ending_s)
    arrived_s = {stamp_of(payload, encoding): at_s for at_s, payload, encoding in received}
    poses = scan_to_pose(readings, sent.put_s, arrived_s, from_s=readings[0].stamp_s + _BEGUN_S)
    return {
        "load": {_SCAN_TO_POSE: poses.latencies_s, **loaded},
        "idle": idle,
        "unmatched": poses.unmatched,
        "lost": _scans_in(readings) - sent.processed,
    }


def _ask_all(
    endpoint: str, processes: ProcessPoolExecutor, *, is_over: Callable[[], bool]
) -> dict[str, list[float]]:
    """Have a client ask each question until it is over; return how long the answers took, s."""
    latencies_s: dict[str, list[float]] = {question: [] for question in Question}
    while not is_over():
        turn = {question: processes.submit(ask, endpoint, question) for question in Question}
        for question, asking in turn.items():
            latencies_s[question] += asking.result()
    return latencies_s


# -------------------------------------------------------------------------- arithmetic


def scan_to_pose(
    readings: Sequence[Reading],
    put_s: Sequence[float],
    arrived_s: Mapping[float, float],
    *,
    from_s: float,
) -> ScanToPose:
    """Match scans with the poses that carry their stamps.

    Args:
        readings: What was sent, in the order of time.
        put_s: When each reading was sent, s.
        arrived_s: When a pose arrived, by its stamp, s.
        from_s: Stamp of the first scan of interest: while a daemon does not know who sends, it
            holds readings back.
    """
    latencies_s, unmatched = [], 0
    for reading, sent_s in zip(readings, put_s, strict=True):
        if not isinstance(reading, Scan) or reading.stamp_s < from_s:
            continue
        at_s = arrived_s.get(reading.stamp_s)
        if at_s is None:
            unmatched += 1
            continue
        latencies_s.append(at_s - sent_s)
    return ScanToPose(tuple(latencies_s), unmatched)


def percentiles_ms(latencies_s: Sequence[float]) -> dict[str, float]:
    """Return the median, the 99th percentile and the largest latency, ms.

    Raises:
        DaemonFailure: If there is none.
    """
    if not latencies_s:
        raise DaemonFailure("not one answer came in the time of the benchmark")
    values_ms = 1e3 * np.percentile(latencies_s, list(_PERCENTILES.values()))
    return dict(zip(_PERCENTILES, values_ms.tolist(), strict=True))


# ------------------------------------------------------------------ numbers and figure


def _cost_metrics(cost: Result, loads: Mapping[str, Result]) -> Iterator[Metric]:
    daemon_s, offline_s = cost["daemon_s"], cost["one_process_s"]
    lost = cost["lost"] + sum(load["lost"] for load in loads.values())
    yield Metric("over_one_process", daemon_s / offline_s, "1", _LOWER, _OVERHEAD_TOLERANCE)
    yield Metric("one_process_time", offline_s, "s", _LOWER, None)
    yield Metric("daemon_time", daemon_s, "s", _LOWER, None)
    yield Metric("scans_lost", float(lost), "1", _LOWER, 0.0)


def _latency_metrics(cost: Result, loads: Mapping[str, Result]) -> Iterator[Metric]:
    for load, result in loads.items():
        unmatched = float(result["unmatched"])
        yield Metric(f"{load}/scans_without_pose", unmatched, "1", _LOWER, None)
        for kind, latencies_s in result["load"].items():
            for name, value_ms in percentiles_ms(latencies_s).items():
                yield Metric(f"{load}/{kind}/{name}", value_ms, "ms", _LOWER, None)
        for question in Question:
            loaded_ms = percentiles_ms(result["load"][question])
            idle_ms = percentiles_ms(result["idle"][question])["p50"]
            yield Metric(f"{load}/{question}/p50_idle", idle_ms, "ms", _LOWER, None)
            # Medians are gated: rare delays say as much about what else the machine does.
            for name, tolerance in (("p50", _LATENCY_TOLERANCE), ("p99", None)):
                key, ratio = f"{load}/{question}/{name}_over_idle", loaded_ms[name] / idle_ms
                yield Metric(key, ratio, "1", _LOWER, tolerance)
    scan_ms = 1e3 * cost["one_process_s"] / cost["scans"]
    pose_ms = percentiles_ms(loads[_SENSOR_RATE]["load"][_SCAN_TO_POSE])["p50"]
    key = f"{_SCAN_TO_POSE}_over_one_process"
    yield Metric(key, pose_ms / scan_ms, "1", _LOWER, _LATENCY_TOLERANCE)


def _draw(loads: Mapping[str, Result], path: Path) -> None:
    """Draw the share of answers that came within a time: one panel per kind of wait."""
    figure = Figure(figsize=(13.0, 4.8), layout="constrained")
    panels = figure.subplots(1, len(_PANELS), sharex=True, sharey=True)
    for axes, (title, styles) in zip(panels, _PANELS.items(), strict=True):
        for kind, style in styles.items():
            states = {load: result["load"] for load, result in loads.items()}
            states[_IDLE] = loads[_FULL_SPEED]["idle"]
            for state, latencies_s in states.items():
                if kind in latencies_s:
                    label = f"{kind}, {state}".replace("_", " ")
                    _draw_shares(axes, latencies_s[kind], label, _COLOURS[state], style)
        axes.set(title=title, xscale="log", xlabel="time / ms", ylim=(0.0, 1.02))
        axes.grid(color="0.92", linewidth=0.6)
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14)}
        axes.legend(fontsize=8, ncols=2, frameon=False, **below)
    panels[0].set_ylabel("share of answers within this time")
    figure.savefig(path, dpi=150)


def _draw_shares(
    axes: Axes, latencies_s: Sequence[float], label: str, colour: str, style: str
) -> None:
    at_ms = 1e3 * np.sort([min(latencies_s), *latencies_s])
    shares = np.linspace(0.0, 1.0, len(at_ms))
    axes.step(at_ms, shares, where="post", label=label, color=colour, linestyle=style)
