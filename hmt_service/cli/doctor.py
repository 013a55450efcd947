"""`hmt doctor`: whether this machine can run a daemon, and reach one.

References: own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from hmt_service.cli.connection import Connect, Json, Robot, Site, ZenohConfig

if TYPE_CHECKING:
    from rich.console import Console

    from hmt_service.client.diagnosis import Finding

UNSOUND = 1
"""Exit code when something that is needed does not work."""
_COLOURS = {"ok": "green", "warn": "yellow", "fail": "red"}


def doctor(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Look at versions, memory, clock and Zenoh, and ask for a daemon; say what to do next.

    Exit codes: 0 nothing has failed, 1 something has. That no daemon answers is a failure only with
    --connect or --zenoh-config.
    """
    from rich.console import Console

    from hmt_service.cli.plain import to_json
    from hmt_service.client.diagnosis import Verdict, diagnose

    console = Console()
    findings = []
    for finding in diagnose(connect, site, robot, zenoh_config):
        findings.append(finding)
        if not as_json:
            _print(console, finding)
    has_failed = any(finding.verdict is Verdict.FAIL for finding in findings)
    if as_json:
        typer.echo(to_json({"is_healthy": not has_failed, "findings": tuple(findings)}))
    raise typer.Exit(UNSOUND if has_failed else 0)


def _print(console: Console, finding: Finding) -> None:
    from rich.text import Text

    line = Text.assemble(
        (f"{finding.verdict:<5}", _COLOURS[finding.verdict]), f"{finding.check}: {finding.found}"
    )
    console.print(line, soft_wrap=True)
    if finding.next_step:
        console.print(Text(f"      next: {finding.next_step}"), soft_wrap=True)
