"""`hmt inspect`: what a recorded log holds, what is wrong with it, and which preset is for it.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

from hmt_service.cli.connection import Json
from hmt_service.cli.recorded import LogPath
from hmt_service.cli.settings import ScanRate, SensorPose, pose_on_body
from hmt_service.errors import BAD_INPUT

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from hmt_service.io.inspection import Inspection, StreamReport
    from hmt_service.io.log_statistics import ScanStatistics, Timing

_SAYS = {
    "every_scan": "every scan says",
    "tf_static": "tf_static says",
    "caller": "--sensor-pose says",
    "same_frame": "they are in its frame",
    "nobody": "nobody says where",
}
DOUBTFUL = 1
"""Exit code of a log that can be mapped, with something wrong in it."""


def inspect(
    log: LogPath,
    sensor_pose: SensorPose = None,
    scan_rate: ScanRate = None,
    as_json: Json = False,
) -> None:
    """Say what a recorded log holds, what is wrong with it, and which preset is for it.

    Exit code 0: nothing is wrong; 1: `hmt run` maps it, but read the warnings; 2: no log that can
    be mapped.
    """
    from rich.console import Console
    from rich.progress import Progress

    from hmt_service.io.inspection import Verdict, inspect_log

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("reading", total=None)
        inspection = inspect_log(
            log,
            body_from_sensor=pose_on_body(sensor_pose),
            scan_rate_hz=scan_rate,
            on_open=lambda readings: progress.update(task, total=readings),
            on_reading=lambda: progress.advance(task),
        )
    if as_json:
        from hmt_service.cli.plain import to_json

        typer.echo(to_json(inspection))
    else:
        _print(Console(), inspection)
    if inspection.verdict is not Verdict.USABLE:
        raise typer.Exit(DOUBTFUL if inspection.verdict is Verdict.DOUBTFUL else BAD_INPUT)


def _print(console: Console, inspection: Inspection) -> None:
    from rich.text import Text

    from hmt_service.cli.tables import table_of
    from hmt_service.io.findings import Severity

    headings = ("stream", "type", "messages", "rate", "span", "gaps", "read for")
    streams = (_stream(stream) for stream in inspection.streams)
    console.print(table_of(f"{inspection.log}: {inspection.form}", headings, streams))
    if inspection.scans is not None:
        console.print(_contents(inspection))
    styles = {Severity.ERROR: "red", Severity.WARNING: "yellow", Severity.NOTE: ""}
    for finding in inspection.findings:
        text = Text(f"{finding.severity}: {finding.message}", style=styles[finding.severity])
        console.print(text, soft_wrap=True)
        console.print(Text(f"  next: {finding.advice}"), soft_wrap=True)
    console.print(Text(f"{inspection.log}: {inspection.verdict}"), soft_wrap=True)


def _stream(stream: StreamReport) -> Iterator[str]:
    timing = stream.recorded
    yield stream.name
    yield stream.kind
    yield str(stream.messages)
    yield _rate(timing)
    yield "-" if timing.first_s is None else f"{_duration_s(timing):.1f} s"
    yield f"{timing.gaps}, to {timing.longest_gap_s:.1f} s" if timing.gaps else "-"
    yield f"{stream.use} ({stream.why})" if stream.why else stream.use


def _contents(inspection: Inspection) -> Table:
    from hmt_service.cli.tables import table_of

    rows = {"scans": "", "sensor": "", "ranges": "", "on the body": "", "odometry": "none"}
    if (scans := inspection.scans) is not None:
        rows["scans"] = (
            f"{scans.scans}, {_rate(scans.timing)}, {_span(scans.timing)}; "
            f"{scans.points_p50} returns in the median"
        )
        rows["sensor"] = _sensor(scans)
        rows["ranges"] = (
            f"half of the returns within {scans.range_p50_m:.2f} m, all within "
            f"{scans.range_max_m:.2f} m"
        )
    if (mounting := inspection.mounting) is not None and scans is not None:
        x, y, z = scans.sensor_in_body_m
        frames = "".join(
            f"; {what} '{frame}'"
            for what, frame in (("scans in", mounting.scan_frame), ("body", mounting.body_frame))
            if frame is not None
        )
        place = f"sensor at {x:.3f}, {y:.3f}, {z:.3f} m, as {_SAYS[mounting.says]}"
        rows["on the body"] = f"{place}{frames}"
    if (odometry := inspection.odometry) is not None:
        rows["odometry"] = (
            f"{odometry.readings} readings, {_rate(odometry.timing)}, {_span(odometry.timing)}; "
            f"path {odometry.path_m:.1f} m, largest step {odometry.jump_m:.2f} m in "
            f"{odometry.jump_s:.2f} s"
        )
    rows["preset"] = str(inspection.fit or "none: nothing is seen")
    return table_of("", ("", ""), rows.items())


def _sensor(scans: ScanStatistics) -> str:
    across = f"{scans.width_deg:.1f} deg across"
    times = "points have times" if scans.with_point_times else "points have no times of their own"
    if scans.ground is None:
        beams = "planar" if scans.beams is None else f"planar, {scans.beams} beams"
        return f"{beams}, {across}; {times}"
    rows = "rows not told apart" if scans.rows is None else f"{scans.rows} rows"
    return (
        f"LiDAR, {rows}, {across}, {scans.lowest_deg:.1f} to {scans.highest_deg:.1f} deg up; "
        f"{times}"
    )


def _rate(timing: Timing) -> str:
    return "-" if timing.rate_hz is None else f"{timing.rate_hz:.4g} Hz"


def _span(timing: Timing) -> str:
    return (
        "-" if timing.first_s is None else f"{_duration_s(timing):.1f} s from {timing.first_s:.3f}"
    )


def _duration_s(timing: Timing) -> float:
    return (timing.last_s or 0.0) - (timing.first_s or 0.0)
