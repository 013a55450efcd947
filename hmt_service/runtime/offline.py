"""The stages in one process, one after the other: what the daemon does, reproducibly.

References:
    own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from hmt_service.core.config import Config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import Event, Reading
from hmt_service.runtime.messages import RunReport


def map_readings(
    readings: Iterable[Reading],
    config: Config,
    *,
    seed: int = 0,
    known: Engine | None = None,
    on_scan: Callable[[], object] = lambda: None,
    on_event: Callable[[Event], object] = lambda _: None,
) -> tuple[Engine, RunReport]:
    """Return the finished engine, and what it has cost.

    Args:
        readings: In the order of time.
        config: Settings of all stages.
        seed: Seed of all randomness of one that begins.
        known: Engine to go on with, of these settings; None to begin one.
        on_scan: Called after each scan.
        on_event: Called with everything that happens to the map, before `on_scan`.
    """
    odometry, engine = Odometry(config), known or Engine(config, seed=seed)
    scans, odometry_busy_s, topology_busy_s = 0, 0.0, 0.0
    for reading in readings:
        started_s = time.perf_counter()
        tracking = odometry.process(reading)
        tracked_s = time.perf_counter()
        odometry_busy_s += tracked_s - started_s
        if tracking is None:
            continue
        events = engine.process(tracking)
        topology_busy_s += time.perf_counter() - tracked_s
        scans += 1
        for event in events:
            on_event(event)
        on_scan()
    started_s = time.perf_counter()
    events = engine.finish()
    topology_busy_s += time.perf_counter() - started_s
    for event in events:
        on_event(event)
    return engine, RunReport(scans, odometry_busy_s, topology_busy_s)
