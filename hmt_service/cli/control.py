"""`hmt ctl`: tell a daemon what to do with its map, or to end.

References: own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import Connect, Robot, Site, ZenohConfig, connected

if TYPE_CHECKING:
    from hmt_service.service.reports import Ack

app = typer.Typer(no_args_is_help=True, help="Tell a daemon what to do with its map, or to end.")


@app.command()
def finish(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
) -> None:
    """Wait until all input is in the map, and have the map completed and saved."""
    with connected(connect, site, robot, zenoh_config) as client:
        _print(client.finish())


@app.command()
def save(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
) -> None:
    """Have the map saved as it is."""
    with connected(connect, site, robot, zenoh_config) as client:
        _print(client.save())


@app.command()
def relocalize(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
) -> None:
    """Tell that the robot was carried: from its next keyframe on it may be anywhere in the map."""
    with connected(connect, site, robot, zenoh_config) as client:
        _print(client.relocalize())


@app.command()
def load(
    name: Annotated[str, typer.Argument(help="Map file, in the folder of the daemon's.")],
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
) -> None:
    """Have the map saved, and go on with another one, where the robot may be anywhere."""
    with connected(connect, site, robot, zenoh_config) as client:
        _print(client.load(name))


@app.command()
def reset(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
) -> None:
    """Have the map saved and its file set aside under another name, and begin an empty one."""
    with connected(connect, site, robot, zenoh_config) as client:
        _print(client.reset())


@app.command()
def shutdown(
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
) -> None:
    """Have the map saved, and the daemon end."""
    with connected(connect, site, robot, zenoh_config) as client:
        _print(client.shut_down())


def _print(ack: Ack) -> None:
    saved = f"; saved {', '.join(ack.files)}" if ack.files else ""
    typer.echo(
        f"{ack.received} samples received, {ack.accepted} accepted, {ack.refused} refused, "
        f"{ack.processed_scans} scans in the map{saved}"
    )
