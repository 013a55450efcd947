"""`hmt run`: a recorded log to a map, offline and reproducible.

References: own.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.recorded import LogPath, print_contents, print_malformed
from hmt_service.cli.settings import (
    BudgetSize,
    ConfigFile,
    Frozen,
    MeasuredPreset,
    ScanRate,
    Seed,
    SensorPose,
    budget_of,
    kept_map,
    pose_on_body,
    settings_of_map,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rich.console import Console

    from hmt_service.core.config import Config, Preset
    from hmt_service.core.engine import Engine
    from hmt_service.core.types import Event, Reading
    from hmt_service.io.logs import Log
    from hmt_service.runtime.messages import RunReport


def run(
    log: LogPath,
    out: Annotated[Path, typer.Option(help="Folder to write trajectory, map and summary to.")],
    preset: MeasuredPreset = None,
    config: ConfigFile = None,
    seed: Seed = 0,
    sensor_pose: SensorPose = None,
    scan_rate: ScanRate = None,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", help="Map file to go on with, from an unknown place; it is not changed."
        ),
    ] = None,
    frozen: Frozen = False,
    memory_budget: BudgetSize = None,
) -> None:
    """Build the map of a recorded log; the same log and seed give the same files, bit for bit."""
    from rich.console import Console

    from hmt_service.core.engine import Engine
    from hmt_service.io.logs import read_log
    from hmt_service.service.results import save_results

    console = Console(stderr=True)
    kept = kept_map(map_file, is_frozen=frozen, is_known=True)
    budget = budget_of(memory_budget)
    read = partial(
        read_log, log, body_from_sensor=pose_on_body(sensor_pose), scan_rate_hz=scan_rate
    )
    with console.status(f"reading {log}"):
        if preset is None and map_file is None:
            preset = _measured_preset(console, read(min_range_m=0.0, max_range_m=math.inf))
        settings = settings_of_map(map_file, preset, config)
        recorded = read(
            min_range_m=settings.sensor.min_range_m, max_range_m=settings.sensor.max_range_m
        )
    print_contents(console, recorded)
    begin = Engine if kept is None else kept.engine
    engine = begin(settings, seed=seed, budget=budget)
    report = _map(recorded.readings, recorded.scans, settings, engine, console)
    print_malformed(console, recorded)
    files = save_results(engine, report, directory=out, config=settings, seed=seed)
    _report_map(console, engine, report)
    console.print(f"saved {', '.join(files)} in {out}", soft_wrap=True)


def _measured_preset(console: Console, recorded: Log) -> Preset | None:
    """Return the preset for what the sensor sees, and say why; None if it sees nothing."""
    from hmt_service.io.inspection import choose_preset

    fit = choose_preset(recorded)
    if fit is None:
        return None
    console.print(str(fit), soft_wrap=True, markup=False, highlight=False)
    return fit.preset


def _map(
    readings: Iterable[Reading],
    scans: int,
    settings: Config,
    engine: Engine,
    console: Console,
) -> RunReport:
    """Return what finishing the map has cost, with a progress bar meanwhile."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    from hmt_service.runtime.offline import map_readings

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), Remaining())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("mapping", total=scans)
        _, report = map_readings(
            readings,
            settings,
            known=engine,
            on_scan=lambda: progress.advance(task),
            on_event=lambda event: _warn(console, event),
        )
    return report


def _warn(console: Console, event: Event) -> None:
    """Print an event when it says something of the settings or of this machine."""
    from hmt_service.core.types import EventKind

    if event.kind in (EventKind.PRESET_DOUBTED, EventKind.OVER_BUDGET):
        text = f"warning: {event.message}"
        console.print(text, style="yellow", soft_wrap=True, markup=False, highlight=False)
    elif event.kind is EventKind.PRESET_CONFIRMED:
        console.print(event.message, soft_wrap=True, markup=False)


def _report_map(console: Console, engine: Engine, report: RunReport) -> None:
    snapshot = engine.snapshot()
    if snapshot is None:
        return
    best = snapshot.posterior.hypotheses[0]
    console.print(
        f"{best.areas} areas, {snapshot.arcs} arcs, {best.loop_closures} loop closures, "
        f"probability {best.probability:.3f}; {report.scans / report.busy_s:.0f} scans/s "
        f"(odometry {report.odometry_busy_s:.1f} s, topology {report.topology_busy_s:.1f} s)",
        soft_wrap=True,
    )
    if (usage := engine.memory_usage) is not None:
        console.print(
            f"submaps take {usage.held_bytes / 1e6:.1f} MB of memory, "
            f"{usage.shelf_bytes / 1e6:.1f} MB of disk",
            soft_wrap=True,
        )
