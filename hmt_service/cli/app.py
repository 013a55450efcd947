"""The `hmt` command: every module beside this one is one command, added to the list at the end.

References: own.
"""

from __future__ import annotations

from typing import Annotated

import typer

from hmt_service import __version__
from hmt_service.cli import (
    control,
    datasets,
    demo,
    doctor,
    evaluate,
    inspect,
    map_files,
    query,
    replay,
    report,
    run,
    serve,
    sim,
    view,
)

app = typer.Typer(
    name="hmt",
    help="Hybrid metric-topological SLAM.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


def _print_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"hmt {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    _: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Hybrid metric-topological SLAM."""


app.command("demo")(demo.demo)
app.command("doctor")(doctor.doctor)
app.command("run")(run.run)
app.command("inspect")(inspect.inspect)
app.command("sim")(sim.sim)
app.command("serve")(serve.serve)
app.command("replay")(replay.replay)
app.command("status")(query.status)
app.command("health")(query.health)
app.command("pose")(query.pose)
app.command("posterior")(query.posterior)
app.command("events")(query.events)
app.command("areas")(query.areas)
app.command("map")(query.map_)
app.command("compare")(query.compare)
app.command("view")(view.view)
app.add_typer(control.app, name="ctl")
app.add_typer(datasets.app, name="datasets")
app.command("eval")(evaluate.evaluate)
app.command("report")(report.report)
app.command("info")(map_files.info)
app.command("check")(map_files.check)
app.command("export")(map_files.export)
