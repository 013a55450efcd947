"""`hmt status`, `health`, `pose`, `posterior`, `events`, `areas`, `map`, `compare`: ask a daemon.

`posterior` and `events` also read what a run has saved.

References: own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import (
    Connect,
    Json,
    Robot,
    Site,
    Timeout,
    ZenohConfig,
    connected,
)
from hmt_service.cli.tables import print_json, print_tables, table_of
from hmt_service.core.choices import EventKind, MapMethod

if TYPE_CHECKING:
    from rich.table import Table

    from hmt_service.client import HmtClient
    from hmt_service.core.geometry import GaussianPose
    from hmt_service.core.types import Belief, GlobalMap, Localization
    from hmt_service.service.reports import Status

NOT_RUNNING = 1
"""Exit code of `hmt health` for a daemon that is there and takes no work."""

Run = Annotated[
    Path | None,
    typer.Argument(
        metavar="[DIR]", help="What `hmt run` or a daemon has saved; a daemon if not given."
    ),
]
Reference = Annotated[int | None, typer.Option(min=0, help="Area whose frame the map is in.")]
Hypothesis = Annotated[
    int | None, typer.Option(min=0, help="Hypothesis; the most probable one if not given.")
]


def status(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Show what the daemon has received, refused and processed."""
    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        answer = client.status()
    if not print_json(answer, is_wanted=as_json):
        print_tables(_pairs(f"{site}/{robot}", _status_rows(answer)))


def health(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 3.0,
) -> None:
    """Show whether the daemon takes work: for whoever restarts it.

    Exit codes: 0 it does, 1 it is starting or stopping, 2 nobody answers in time.
    """
    from hmt_service.service.reports import DaemonState

    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        state = client.status().state
    typer.echo(state)
    raise typer.Exit(0 if state is DaemonState.RUNNING else NOT_RUNNING)


def pose(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    as_json: Json = False,
) -> None:
    """Show where the robot is, and how sure that is."""
    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        answer = client.pose()
    if print_json(answer, is_wanted=as_json):
        return
    rows = {
        "stamp": f"{answer.stamp_s:.3f} s",
        "area": f"{answer.area}, probability {answer.probability:.3f}",
        "localised": _localised(answer.localization, answer.stamp_s),
        "pose in the area": _pose(answer.area_from_body),
        f"pose in the frame of area {answer.reference_area}": _pose(answer.reference_from_body),
        "hypothesis": f"{answer.hypothesis}, revision {answer.revision}",
    }
    print_tables(_pairs("pose", rows))


def posterior(
    run: Run = None,
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Figure to draw, such as posterior.png: effective sample size and probabilities "
            "of topologies and areas over time."
        ),
    ] = None,
    start: Annotated[float | None, typer.Option(help="Sensor time at its left, s.")] = None,
    end: Annotated[float | None, typer.Option(help="Sensor time at its right, s.")] = None,
    as_json: Json = False,
) -> None:
    """Show the topologies that the robot may have travelled, with their probabilities.

    Of a saved run (DIR), and with --out, --start or --end: how they and the probabilities of the
    areas that it may have been in changed over time.
    """
    if any(each is not None for each in (run, out, start, end)):
        beliefs = _history(run, connect, site, robot, zenoh_config, timeout)
        _show_history(beliefs, out, start, end, as_json)
        return
    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        answer = client.posterior()
    if print_json(answer, is_wanted=as_json):
        return
    ess = answer.effective_sample_size
    print_tables(
        table_of(
            f"revision {answer.revision}, effective sample size {ess:.1f}",
            ("hypothesis", "probability", "areas", "loop closures", "current area", "path"),
            (
                (
                    summary.hypothesis,
                    f"{summary.probability:.4f}",
                    summary.areas,
                    summary.loop_closures,
                    summary.current_area,
                    _path(summary.topological_path),
                )
                for summary in answer.hypotheses
            ),
        )
    )


def events(
    run: Run = None,
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    kind: Annotated[
        list[EventKind] | None, typer.Option(help="Only events of this kind; may be repeated.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show what was decided, with the numbers that caused it: the oldest first.

    The latest ones: of a daemon 1,000, of a saved run (DIR) 10,000.
    """
    if run is not None:
        from hmt_service.io.audit_files import read_events
        from hmt_service.io.saved_run import EVENTS

        answer = read_events(run / EVENTS)
    else:
        with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
            answer = client.events()
    answer = tuple(event for event in answer if not kind or event.kind in kind)
    if print_json(answer, is_wanted=as_json):
        return
    rows = (
        (
            f"{event.stamp_s:.2f}",
            event.kind,
            event.message,
            ", ".join(f"{name} {value:.4g}" for name, value in sorted(event.numbers.items())),
        )
        for event in answer
    )
    print_tables(table_of(f"{len(answer)} events", ("stamp s", "kind", "what", "numbers"), rows))


def areas(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    reference: Reference = None,
    hypothesis: Hypothesis = None,
    as_json: Json = False,
) -> None:
    """Show all areas: where they are, how often they were visited, what they border on."""
    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        answer = client.areas(reference=reference, hypothesis=hypothesis)
    if not print_json(answer, is_wanted=as_json):
        print_tables(_areas_table(answer))


def map_(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    method: Annotated[
        MapMethod | None,
        typer.Option(
            help="How areas are brought into one frame; a figure shows both if not given."
        ),
    ] = None,
    reference: Reference = None,
    hypothesis: Hypothesis = None,
    out: Annotated[
        Path | None, typer.Option(help="Figure to draw, such as map.png; without it, a table.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show a global map, as a table or as a figure."""
    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        if out is not None:
            _draw(client, out, method, reference, hypothesis)
            return
        answer = client.map(
            method or MapMethod.CONSISTENT,
            reference=reference,
            hypothesis=hypothesis,
            with_points=False,
        )
    if not print_json(answer, is_wanted=as_json):
        print_tables(_areas_table(answer))


def compare(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    reference: Reference = None,
    hypothesis: Hypothesis = None,
    as_json: Json = False,
) -> None:
    """Show how far the shortest-path map is from the consistent one, area by area."""
    with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
        answer = client.compare(reference=reference, hypothesis=hypothesis)
    if print_json(answer, is_wanted=as_json):
        return
    title = f"frame of area {answer.reference_area}, hypothesis {answer.hypothesis}"
    print_tables(
        table_of(
            f"{title}: shortest paths against consistent",
            ("area", "distance m", "angle deg", "σ consistent m", "σ shortest path m"),
            (
                (
                    area.area,
                    f"{area.translation_m:.3f}",
                    f"{math.degrees(area.rotation_rad):.2f}",
                    f"{area.sigma_consistent_m:.3f}",
                    f"{area.sigma_shortest_path_m:.3f}",
                )
                for area in answer.areas
            ),
        ),
        table_of(
            "contradiction between arc and areas",
            ("arc", "consistent m", "shortest path m"),
            (
                (
                    f"{arc.area_a} – {arc.area_b}",
                    f"{arc.consistent_m:.3f}",
                    f"{arc.shortest_path_m:.3f}",
                )
                for arc in answer.arcs
            ),
        ),
    )


def _history(
    run: Path | None,
    connect: str | None,
    site: str,
    robot: str,
    zenoh_config: Path | None,
    timeout_s: float,
) -> tuple[Belief, ...]:
    """Return what was believed over time, by a saved run or by a daemon."""
    if run is None:
        with connected(connect, site, robot, zenoh_config, timeout_s=timeout_s) as client:
            return client.history().beliefs
    from hmt_service.io.audit_files import read_beliefs
    from hmt_service.io.saved_run import BELIEFS

    return read_beliefs(run / BELIEFS)


def _likely(probabilities: Mapping[int, float]) -> str:
    likely = sorted(probabilities.items(), key=lambda item: -item[1])
    return "  ".join(f"{number}: {p:.3f}" for number, p in likely)


def _show_history(
    beliefs: tuple[Belief, ...],
    out: Path | None,
    start_s: float | None,
    end_s: float | None,
    as_json: bool,
) -> None:
    from hmt_service.core.audit import between

    first_s = -math.inf if start_s is None else start_s
    last_s = math.inf if end_s is None else end_s
    beliefs = between(beliefs, first_s, last_s)
    if out is not None:
        from hmt_service.viz.posterior import draw_history

        draw_history(beliefs, out)
    elif not print_json(beliefs, is_wanted=as_json):
        print_tables(_history_table(beliefs))


def _history_table(beliefs: tuple[Belief, ...]) -> Table:
    rows = (
        (
            f"{belief.stamp_s:.2f}",
            f"{belief.effective_sample_size:.2f}",
            _likely(belief.current_area),
            _likely(belief.hypotheses),
        )
        for belief in beliefs
    )
    headings = (
        "stamp s",
        "effective sample size",
        "area: probability",
        "hypothesis: probability",
    )
    return table_of("where the robot was believed to be, where that changed", headings, rows)


def _draw(
    client: HmtClient,
    path: Path,
    method: MapMethod | None,
    reference: int | None,
    hypothesis: int | None,
) -> None:
    from hmt_service.viz.figures import draw_maps

    methods = [method] if method is not None else list(MapMethod)
    maps: list[GlobalMap] = []
    for each in methods:
        known = maps[0] if maps else None  # both maps have the same submaps
        maps.append(client.map(each, reference=reference, hypothesis=hypothesis, known=known))
    comparison = client.compare(reference=reference, hypothesis=hypothesis)
    draw_maps(maps, comparison, path)


def _status_rows(answer: Status) -> dict[str, str]:
    counts = answer.input
    rows = {
        "state": f"{answer.state}, version {answer.version}, up {answer.uptime_s:.0f} s",
        "received": f"{counts.received} samples",
        "accepted": f"{counts.accepted} readings, {counts.reordering} being ordered",
        "refused": _counted(counts.refused),
        "lost": f"{sum(sender.lost for sender in answer.senders)} samples on their way",
        "waiting": f"{counts.queued} samples, {counts.queued_bytes / 1e6:.1f} MB",
        "dropped beams": _counted(counts.dropped_beams),
        "scans": f"{answer.tracked_scans} tracked, {answer.processed_scans} in the map",
        "map": f"revision {answer.revision}: {answer.areas} areas, {answer.arcs} arcs, "
        f"{answer.keyframes} keyframes, {answer.hypotheses} hypotheses",
        "stored": f"{answer.stored_keyframes} keyframes in the map file",
    }
    if answer.localization is not None:
        rows["localised"] = _localised(answer.localization, answer.localization.stamp_s)
    for process in answer.processes:
        readiness = "ready" if process.is_ready else "loading"
        rows[process.name] = (
            f"pid {process.pid}, {readiness}, {process.processed} processed in "
            f"{process.busy_s:.1f} s, {process.backlog} waiting"
            + (f", restarted {process.restarts} times" if process.restarts else "")
        )
    return rows


def _localised(localization: Localization, stamp_s: float) -> str:
    evidence = "the robot has not come back to a known place"
    if localization.evidence_stamp_s is not None:
        age_s = max(0.0, stamp_s - localization.evidence_stamp_s)
        evidence = f"last at a known place {age_s:.1f} s ago"
    return (
        f"probability {localization.probability:.3f}, entropy {localization.entropy_nat:.2f} nat, "
        f"{evidence}"
    )


def _areas_table(answer: GlobalMap) -> Table:
    neighbours: dict[int, list[int]] = {area.area: [] for area in answer.areas}
    for arc in answer.arcs:
        neighbours[arc.area_a].append(arc.area_b)
        neighbours[arc.area_b].append(arc.area_a)
    return table_of(
        f"{answer.method} map in the frame of area {answer.reference_area}, hypothesis "
        f"{answer.hypothesis} (probability {answer.probability:.3f}), revision {answer.revision}",
        ("area", "pose", "keyframes", "visits", "neighbours"),
        (
            (
                area.area,
                _pose(area.reference_from_area),
                area.keyframes,
                area.visits,
                " ".join(map(str, sorted(neighbours[area.area]))),
            )
            for area in answer.areas
        ),
    )


def _pose(gaussian: GaussianPose) -> str:
    """Return position and heading with their standard deviations."""
    x, y, z = gaussian.mean[:3, 3]
    sigma_deg = math.degrees(math.sqrt(max(0.0, gaussian.covariance[2, 2])))
    from hmt_service.core.geometry import yaw_of

    yaw_deg = math.degrees(yaw_of(gaussian.mean))
    return (
        f"({x:.3f}, {y:.3f}, {z:.3f}) ±{gaussian.sigma_m:.3f} m, {yaw_deg:.2f} ±{sigma_deg:.2f} deg"
    )


def _path(areas: tuple[int, ...], *, shown: int = 12) -> str:
    latest = " ".join(map(str, areas[-shown:]))
    return latest if len(areas) <= shown else f"… {latest}"


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in sorted(counts.items())) or "none"


def _pairs(title: str, rows: Mapping[str, str]) -> Table:
    return table_of(title, ("", ""), rows.items())
