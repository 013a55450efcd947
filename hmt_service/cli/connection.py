"""Options that every command which talks to a daemon has.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.service.keys import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from hmt_service.client import HmtClient

Connect = Annotated[
    str | None,
    typer.Option(
        envvar="HMT_CONNECT",
        help="Zenoh endpoint of the daemon or of a router; that of --zenoh-config, or "
        f"{DEFAULT_ENDPOINT}, if none is given.",
    ),
]
ZenohConfig = Annotated[
    Path | None,
    typer.Option(
        envvar="HMT_ZENOH_CONFIG",
        help="File of Zenoh settings, JSON5 or YAML: certificates, passwords, access control.",
    ),
]
Site = Annotated[str, typer.Option(envvar="HMT_SITE", help="Site that the robot works at.")]
Robot = Annotated[str, typer.Option(envvar="HMT_ROBOT", help="Name of the robot.")]
Timeout = Annotated[
    float, typer.Option("--timeout", min=0.1, help="Longest wait for an answer, s.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def connected(
    connect: str | None,
    site: str,
    robot: str,
    zenoh_config: Path | None,
    *,
    timeout_s: float = 10.0,
) -> HmtClient:
    """Return a connection to the daemon that these options name."""
    from hmt_service.client import HmtClient

    return HmtClient(
        connect, site=site, robot=robot, timeout_s=timeout_s, zenoh_config=zenoh_config
    )
