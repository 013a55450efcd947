"""What every command that reads a log says about it.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from hmt_service.io.logs import Log

LogPath = Annotated[
    Path,
    typer.Argument(
        help="Recorded log: CARMEN, MCAP, bag of ROS, or folder of scans (KITTI, PCD, PLY)."
    ),
]
_SHOWN = 5
"""Malformed places that are printed with their reason."""


def print_contents(console: Console, log: Log) -> None:
    """Print what a log holds."""
    console.print(f"{log.scans} scans, {log.odometry} odometry readings")
    for note in log.notes:
        console.print(f"{note.what}: {note.step}", soft_wrap=True, markup=False)
    if log.unread:
        console.print(f"not read: {', '.join(log.unread)}", soft_wrap=True, markup=False)


def print_malformed(console: Console, log: Log) -> None:
    """Print what was left out of a log while it was read."""
    if not log.malformed:
        return
    total = sum(malformed.count for malformed in log.malformed)
    console.print(f"[yellow]malformed and left out: {total}")
    for malformed in log.malformed[:_SHOWN]:
        times = f", {malformed.count} times" if malformed.count > 1 else ""
        text = f"  {malformed.place}: {malformed.reason}{times}"
        console.print(text, soft_wrap=True, markup=False)
    if len(log.malformed) > _SHOWN:
        places = ", ".join(malformed.place for malformed in log.malformed[_SHOWN:])
        console.print(f"  and {places}", markup=False)
