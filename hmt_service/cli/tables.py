"""How commands show what a daemon has answered: as tables, or as JSON.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rich.table import Table


def print_json(value: object, *, is_wanted: bool) -> bool:
    """Print a value as JSON if that is wanted, and return whether it is."""
    if is_wanted:
        from hmt_service.cli.plain import to_json

        typer.echo(to_json(value))
    return is_wanted


def table_of(title: str, headings: Iterable[str], rows: Iterable[Iterable[object]]) -> Table:
    """Return a table."""
    from rich.table import Table

    table = Table(title=title, title_justify="left", show_header=any(headings))
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*map(str, row))
    return table


def print_tables(*tables: Table) -> None:
    """Print tables, one below the other."""
    from rich.console import Console

    console = Console()
    for table in tables:
        console.print(table)
