"""Options that every command which talks to a daemon has.

References: own.
"""

from __future__ import annotations

from typing import Annotated

import typer

Connect = Annotated[
    str, typer.Option(envvar="HMT_CONNECT", help="Zenoh endpoint of the daemon or of a router.")
]
Site = Annotated[str, typer.Option(envvar="HMT_SITE", help="Site that the robot works at.")]
Robot = Annotated[str, typer.Option(envvar="HMT_ROBOT", help="Name of the robot.")]
Timeout = Annotated[
    float, typer.Option("--timeout", min=0.1, help="Longest wait for an answer, s.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
