"""`hmt info`, `check`, `export`: map files without a daemon.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import Json
from hmt_service.io.exporters.formats import Format

if TYPE_CHECKING:
    from rich.table import Table

    from hmt_service.io.map_info import MapInfo

MapFile = Annotated[Path, typer.Argument(metavar="FILE", help="Map file, such as map.hmt.")]
NOT_SOUND = 1
"""Exit code of `hmt check` on a damaged map."""


def info(file: MapFile, as_json: Json = False) -> None:
    """Show what a map file holds: sensor, sizes, time span, and every hypothesis."""
    from hmt_service.io.map_info import map_info

    held = map_info(file)
    if as_json:
        from hmt_service.cli.plain import to_json

        typer.echo(to_json(held))
        return
    from rich.console import Console

    console = Console()
    console.print(_table(str(file), held))
    console.print(_hypotheses_table(held))


def check(file: MapFile) -> None:
    """Check that a map file is sound; prints one line for everything that is wrong.

    Exit code 0: sound; 1: damaged; 2: no map file of this version.
    """
    from hmt_service.io.map_check import check_map

    violations = check_map(file)
    for violation in violations:
        typer.echo(violation)
    if violations:
        raise typer.Exit(NOT_SOUND)
    typer.echo(f"{file}: sound")


def export(
    file: MapFile,
    form: Annotated[
        Format,
        typer.Option(
            "--format",
            help="tum, kitti: trajectory of all scans; g2o: pose graph; ply, pcd: points; "
            "ros-map: occupancy grid of a planar map (.yaml, with its .pgm beside it); mcap: "
            "areas and trajectory for Foxglove; rrd: areas, arcs, trajectory and topology for "
            "Rerun (needs the extra `view`).",
        ),
    ],
    out: Annotated[Path, typer.Option(help="File to write; replaced as a whole.")],
    hypothesis: Annotated[
        int | None, typer.Option(min=0, help="Hypothesis; the most probable one if not given.")
    ] = None,
    reference: Annotated[
        int | None, typer.Option(min=0, help="Area whose frame all is in; the first if not given.")
    ] = None,
) -> None:
    """Write a map file in the format of another program.

    Poses are those of the map: globally consistent, every keyframe where its visit is. The smoothed
    trajectory of a run is in its trajectory.tum.
    """
    from rich.console import Console

    from hmt_service.io.exporters.registry import export_map

    console = Console(stderr=True)
    with console.status(f"writing {out}"):
        placed = export_map(file, out, form, hypothesis=hypothesis, reference_area=reference)
    console.print(
        f"saved {out}: hypothesis {placed.hypothesis.hypothesis}, in the frame of area "
        f"{placed.reference_area}",
        soft_wrap=True,
        markup=False,
    )


def _table(title: str, held: MapInfo) -> Table:
    from rich.table import Table

    if held.first_stamp_s is None or held.last_stamp_s is None:
        span = "no scan"
    else:
        duration_s = held.last_stamp_s - held.first_stamp_s
        span = f"{duration_s:.1f} s, {held.first_stamp_s:.3f} to {held.last_stamp_s:.3f}"
    rows = {
        "file": f"{held.file_bytes / 1e6:.2f} MB, schema version {held.schema_version}",
        "made by": f"{held.created_by}, seed {held.seed}",
        "settings": f"{held.config_hash}, {held.preset or 'none of the presets'}",
        "sensor": held.sensor,
        "revision": f"{held.revision}",
        "scans": f"{held.scans} in {held.keyframes} keyframes, {held.visits} visits",
        "time": span,
        "path": f"{held.length_m:.1f} m",
        "points": f"{held.points}, to {1e3 * held.point_resolution_m:g} mm",
    }
    table = Table(title=title, title_justify="left", show_header=False)
    for name, text in rows.items():
        table.add_row(name, text)
    return table


def _hypotheses_table(held: MapInfo) -> Table:
    from rich.table import Table

    table = Table(title="hypotheses", title_justify="left")
    for heading in ("hypothesis", "probability", "areas", "arcs", "loop closures"):
        table.add_column(heading)
    for h in held.hypotheses:
        numbers = (h.hypothesis, f"{h.probability:.4f}", h.areas, h.arcs, h.loop_closures)
        table.add_row(*map(str, numbers))
    return table
