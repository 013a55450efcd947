"""`hmt report`: a run as one page.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

REPORT = "report.html"
"""Name of the page in the folder of the run."""


def report(
    run: Annotated[
        Path, typer.Argument(metavar="DIR", help="What `hmt run` or a daemon has saved.")
    ],
    out: Annotated[
        Path | None, typer.Option(help=f"Page to write; {REPORT} in DIR if not given.")
    ] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="Map file of the run, if it is not in DIR.")
    ] = None,
) -> None:
    """Write one HTML page that holds all of a run, and needs nothing else: no server, no scripts.

    How probable the map and its rivals are, both global maps, what was believed over time, what was
    decided and why, times, memory and settings.
    """
    from rich.console import Console

    from hmt_service.io.saved_run import read_run
    from hmt_service.viz.report import write_report

    path = out or run / REPORT
    console = Console(stderr=True)
    with console.status(f"writing {path}"):
        write_report(read_run(run, map_file=map_file), path)
    console.print(f"saved {path}", soft_wrap=True, markup=False)
