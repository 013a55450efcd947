"""`hmt datasets`: the recorded public logs that this project is measured on.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hmt_service.cli.connection import Json

app = typer.Typer()


@app.callback(invoke_without_command=True)
def datasets(context: typer.Context, as_json: Json = False) -> None:
    """List the recorded public logs that this project is measured on, and fetch them.

    Checksums are those of the copies that were measured on, uncompressed.
    """
    if context.invoked_subcommand is not None:
        return
    from rich.console import Console
    from rich.text import Text

    from hmt_service.io.datasets import DATASETS

    if as_json:
        from hmt_service.cli.plain import to_json

        typer.echo(to_json(DATASETS))
        return
    console = Console()
    for name, dataset in DATASETS.items():
        console.print(Text.assemble((name, "bold"), f"  {dataset.title}"), soft_wrap=True)
        rows = {"origin": dataset.origin, "licence": dataset.licence}
        if dataset.changed:
            rows["here"] = f"{dataset.changed}; cannot be fetched"
        for label, text in rows.items():
            console.print(Text(f"  {label:<8}{text}"), soft_wrap=True)
        for file in dataset.files:
            numbers = f"{file.size:>10} bytes  SHA-256 {file.sha256}"
            console.print(Text(f"  {file.original:<20}{numbers}"), soft_wrap=True)
            if file.url:
                console.print(Text(f"  {'':<20}{file.url}"), soft_wrap=True)


@app.command()
def fetch(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Log, such as intel.")],
    out: Annotated[
        Path, typer.Option(help="Folder of recorded logs; what is there already is checked.")
    ],
    mirror: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="Folder on a server that has the originals, instead of their own."
        ),
    ] = None,
) -> None:
    """Fetch a log, check it, and put it where HMT_DATA=OUT has it for tests and benchmarks.

    CARMEN logs are compressed as they come. A file appears when it is complete and the right one.
    """
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn

    from hmt_service.io import datasets as recorded

    console = Console(stderr=True)
    total = sum(file.size for file in recorded.dataset_of(name).files)
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(f"fetching {name}", total=total)
        for path, is_new in recorded.fetch(
            name, out, mirror=mirror, on_bytes=lambda count: progress.advance(task, count)
        ):
            if not is_new:
                progress.advance(task, path.stat().st_size)
            what = "fetched" if is_new else "already there"
            console.print(f"{path}: {what}, checksum right", soft_wrap=True, markup=False)
