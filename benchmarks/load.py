"""The daemon under full load for long: sensors at their rate, revisits all the time, many clients.

A simulated robot drives the same way there and back, again and again, so that there is always a
loop to close and the map has no reason to grow. Meanwhile one client asks where the robot is a
hundred times a second, and ten others fetch the whole map every second.

References: own.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import count, takewhile
from multiprocessing import get_context
from types import MappingProxyType
from typing import TypeVar

import numpy as np
import psutil

from benchmarks.cells import Result
from benchmarks.clients import Question, ask, ask_together, received_poses, send, stamp_of
from benchmarks.latency import percentiles_ms
from benchmarks.metric import Direction, Metric
from benchmarks.report import Report, Run
from benchmarks.serving import serving
from hmt_service.client import HmtClient
from hmt_service.core.geometry import Pose, inverse, log
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput
from hmt_service.sim.sensors import Lidar3d
from hmt_service.sim.simulation import INDOOR_LASER, LIDAR, Instant, Robot, simulate
from hmt_service.sim.usual import preset_for
from hmt_service.sim.worlds.families import Family, draw
from hmt_service.sim.worlds.world import World

_FULL_S, _QUICK_S = 1800.0, 20.0
_CLIENTS, _MAP_PERIOD_S = 10, 1.0
_BEGUN_S = 2.5
"""Sensor time after which a daemon knows who sends."""
_SAMPLE_S = 1.0
T = TypeVar("T")
_SETTLED_SHARE = 1.0 / 3.0
"""Of the time: after that the map knows the way, and memory must not grow."""
_WINDOW = 60
"""Samples that a median of memory is over."""
_GROWTH_TOLERANCE = 0.1
_SEAM_M, _SEAM_RAD = 0.3, 0.2
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


@dataclass(frozen=True, slots=True)
class Workload:
    """A robot on its way there and back."""

    family: Family
    """Of the world, seed 0."""
    rows: int
    """Of a LiDAR; 0 for a planar laser."""
    rate_hz: float
    """Scans per second."""
    way_m: float
    """How far there."""


WORKLOADS = MappingProxyType(
    {
        "laser": Workload(Family.OFFICE, 0, 40.0, 100.0),
        "lidar": Workload(Family.GARAGE, 64, 20.0, 40.0),
    }
)


@dataclass(frozen=True, slots=True, eq=False)
class Lap:
    """What a robot sends on one lap, at whose end it is where it began."""

    readings: tuple[Reading, ...]
    """In the order of time, odometry before the scan of the same stamp."""
    period_s: float
    """Time between two scans."""
    end_from_begin: Pose
    """Pose of the first scan in the body frame of the last, shape (4, 4), m."""


def measure(run: Run) -> Report:
    """Load a daemon with each sensor, one after the other."""
    metrics: list[Metric] = []
    for_s = _QUICK_S if run.is_quick else _FULL_S
    for name in ("laser",) if run.is_quick else WORKLOADS:
        result = run.once(name, partial(loaded, WORKLOADS[name], for_s))
        metrics += [replace(metric, key=f"{name}/{metric.key}") for metric in _metrics(result)]
    return Report(tuple(metrics))


# ---------------------------------------------------------------------------- what is sent


@cache
def lap_of(workload: Workload) -> Lap:
    """Return what the robot of a workload sends on a lap."""
    world = there_and_back(draw(workload.family, 0), workload.way_m)
    return closed(tuple(simulate(world, robot_of(workload), 0)), 1.0 / workload.rate_hz)


def robot_of(workload: Workload) -> Robot:
    """Return the robot of a workload."""
    period_s = 1.0 / workload.rate_hz
    if not workload.rows:
        return Robot(sensor=INDOOR_LASER.sensor, scan_period_s=period_s)
    sensor = Lidar3d(rows=workload.rows, columns=1024)
    return Robot(follower=LIDAR.follower, sensor=sensor, scan_period_s=period_s)


def there_and_back(world: World, way_m: float) -> World:
    """Return a world whose route goes there and back, three times, and nowhere else.

    Args:
        world: The world.
        way_m: Length of the part of its route that is driven, from its begin.
    """
    steps_m = np.linalg.norm(np.diff(world.route_m, axis=0), axis=1)
    there = world.route_m[: int(np.searchsorted(np.cumsum(steps_m), way_m)) + 2]
    lap = np.concatenate([there, there[-2:0:-1]])
    return replace(world, route_m=np.concatenate([lap, lap, lap, lap[:1]]))


def closed(drive: Sequence[Instant], period_s: float) -> Lap:
    """Return a lap out of a drive that is several: its end is nearest to where it began.

    Args:
        drive: What happens at each scan.
        period_s: Time between two of them.

    Raises:
        InvalidInput: If the robot is never again where it has been.
    """
    poses = np.array([instant.truth.reference_from_body for instant in drive])
    begin = len(drive) // 3
    apart = [inverse(poses[begin]) @ pose for pose in poses[begin + len(drive) // 6 :]]
    gaps_m = np.array([np.linalg.norm(each[:3, 3]) for each in apart])
    turns_rad = np.array([np.linalg.norm(log(each)[:3]) for each in apart])
    gaps_m[turns_rad > _SEAM_RAD] = np.inf
    if gaps_m.min() > _SEAM_M:
        raise InvalidInput(
            f"none of {len(drive)} scans is within {_SEAM_M:g} m and {_SEAM_RAD:g} rad of scan "
            f"{begin} again: the drive has no lap"
        )
    end = begin + len(drive) // 6 + int(np.argmin(gaps_m))
    readings = tuple(r for instant in drive[begin:end] for r in instant.readings)
    return Lap(readings, period_s, inverse(poses[end - 1]) @ poses[begin])


def endless(lap: Lap) -> Iterator[Reading]:
    """Yield a lap again and again: stamps and odometry go on."""
    first_s, last_s = lap.readings[0].stamp_s, lap.readings[-1].stamp_s
    odometry = [r.odom_from_body for r in lap.readings if isinstance(r, OdometryReading)]
    over: Pose = odometry[-1] @ lap.end_from_begin @ inverse(odometry[0])
    moved: Pose = np.eye(4)
    for number in count():
        later_s = number * (last_s - first_s + lap.period_s) - first_s
        for reading in lap.readings:
            # Whole nanoseconds, as on the wire: stamps come back as they were sent.
            stamped = replace(reading, stamp_s=round(reading.stamp_s + later_s, 9))
            if isinstance(stamped, OdometryReading):
                stamped = replace(stamped, odom_from_body=moved @ stamped.odom_from_body)
            yield stamped
        moved = moved @ over


# ----------------------------------------------------------------------- units of work


def loaded(workload: Workload, for_s: float) -> Result:
    """Load a daemon for a time.

    Args:
        workload: What is sent.
        for_s: How long.
    """
    spawn = get_context("spawn")
    preset = preset_for(robot_of(workload), workload.family)
    with (
        ProcessPoolExecutor(1, spawn) as sender,
        ProcessPoolExecutor(1, spawn) as asker,
        ProcessPoolExecutor(1, spawn) as viewers,
    ):
        sender.submit(_prepare, workload).result()
        with serving("--preset", preset) as endpoint, received_poses(endpoint) as received:
            sending = sender.submit(_send, endpoint, workload, for_s)
            poses = asker.submit(ask, endpoint, Question.POSE, for_s=for_s)
            maps = viewers.submit(
                ask_together,
                endpoint,
                Question.MAP_POINTS,
                clients=_CLIENTS,
                period_s=_MAP_PERIOD_S,
                for_s=for_s,
            )
            with HmtClient(endpoint, site="site", robot="robot") as client:
                memory_mb = list(_memory_mb(client, sending))
                put_s, processed = sending.result()
                areas, hypotheses = client.areas(), client.posterior().hypotheses
        arrived_s = {stamp_of(payload, encoding): at_s for at_s, payload, encoding in received}
        answers = {"pose": poses.result(), "map": maps.result()}
    begun = {stamp_s: at_s for stamp_s, at_s in put_s.items() if stamp_s >= _BEGUN_S}
    settled = memory_mb[int(len(memory_mb) * _SETTLED_SHARE) :]
    return {
        "scans": len(put_s),
        "lost": len(put_s) - processed,
        "without_pose": sum(stamp_s not in arrived_s for stamp_s in begun),
        "ms": {
            kind: percentiles_ms(latencies_s)
            for kind, latencies_s in {
                "scan_to_pose": [arrived_s[s] - at for s, at in begun.items() if s in arrived_s],
                **answers,
            }.items()
        },
        "maps": len(answers["map"]),
        "areas": len(areas.areas),
        "hypotheses": len(hypotheses),
        "memory_mb": memory_mb[-1],
        "growth": float(np.median(settled[-_WINDOW:]) / np.median(settled[:_WINDOW])),
    }


def _prepare(workload: Workload) -> None:
    """Simulate in the process that sends, before it does."""
    lap_of(workload)


def _send(endpoint: str, workload: Workload, for_s: float) -> tuple[dict[float, float], int]:
    """Send laps; return when each scan was sent, s, by its stamp, and how many are in the map."""
    laps = endless(lap_of(workload))
    readings = tuple(takewhile(lambda reading: reading.stamp_s < for_s, laps))
    sent = send(endpoint, readings, is_paced=True)
    times = zip(readings, sent.put_s, strict=True)
    return {r.stamp_s: at_s for r, at_s in times if isinstance(r, Scan)}, sent.processed


def _memory_mb(client: HmtClient, sending: Future[T]) -> Iterator[float]:
    """Yield what all processes of the daemon take together, every second while there is input."""
    children = [psutil.Process(process.pid) for process in client.status().processes]
    daemon = [psutil.Process(children[0].ppid()), *children]
    while not sending.done():
        yield sum(process.memory_info().rss for process in daemon) / 1e6
        time.sleep(_SAMPLE_S)


# ------------------------------------------------------------------------------ numbers


def _metrics(result: Result) -> Iterator[Metric]:
    for kind, latencies_ms in result["ms"].items():
        for name, value_ms in latencies_ms.items():
            yield Metric(f"{kind}/{name}", value_ms, "ms", _LOWER, None)
    yield Metric("scans_lost", float(result["lost"]), "1", _LOWER, 0.0)
    yield Metric("memory_growth", result["growth"], "1", _LOWER, _GROWTH_TOLERANCE)
    yield Metric("memory", result["memory_mb"], "MB", _LOWER, None)
    for key in ("scans", "maps", "areas", "hypotheses"):
        yield Metric(key, float(result[key]), "1", _HIGHER, None)
    yield Metric("scans_without_pose", float(result["without_pose"]), "1", _LOWER, None)
