"""`hmt ctl`: tell a daemon what to do with its map, or to end.

References: own.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import Connect, Json, Robot, Site, ZenohConfig, connected
from hmt_service.cli.settings import pose_of_numbers
from hmt_service.cli.tables import print_json, print_tables, table_of

if TYPE_CHECKING:
    from hmt_service.core.types import StatementEffect
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
def assert_arc(
    area_a: Annotated[int, typer.Argument(min=0, help="An area that the robot has left.")],
    area_b: Annotated[int, typer.Argument(min=0, help="Another one.")],
    pose: Annotated[
        tuple[float, float, float, float, float, float],
        typer.Option(
            metavar="X Y Z ROLL PITCH YAW",
            help="Pose of the second area in the frame of the first, m and degrees.",
        ),
    ],
    sigma_m: Annotated[float, typer.Option(help="How well its position is known, m.")] = 0.1,
    sigma_deg: Annotated[float, typer.Option(help="The same of its orientation.")] = 1.0,
    probability: Annotated[float, typer.Option(help="How probably it is right.")] = 0.95,
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Tell where one area is beside another: evidence that weighs hypotheses; shows what it did."""
    with connected(connect, site, robot, zenoh_config) as client:
        effect = client.assert_arc(
            area_a,
            area_b,
            pose_of_numbers(pose),
            sigma_m=sigma_m,
            sigma_rad=math.radians(sigma_deg),
            probability=probability,
        )
    _print_effect(effect, as_json=as_json)


@app.command()
def retract_arc(
    statement: Annotated[int, typer.Argument(min=0, help="Number that `assert-arc` has shown.")],
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Take back what was told of two areas; what was decided because of it stays decided."""
    with connected(connect, site, robot, zenoh_config) as client:
        effect = client.retract_arc(statement)
    _print_effect(effect, as_json=as_json)


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


def _print_effect(effect: StatementEffect, *, as_json: bool) -> None:
    if print_json(effect, is_wanted=as_json):
        return
    rows = (
        (
            one.hypothesis,
            one.parent,
            "right" if one.is_right else "wrong",
            f"{one.before:.3f}",
            f"{one.after:.3f}",
            f"{one.apart_m:.2f}",
            f"{math.degrees(one.apart_rad):.1f}",
            "knew nothing" if one.distance is None else f"{one.distance:.1f} σ",
        )
        for one in effect.hypotheses
    )
    title = f"statement {effect.statement}: areas {effect.area_a} and {effect.area_b}"
    headings = ("hypothesis", "from", "it is", "before", "after", "apart m", "apart deg", "that is")
    print_tables(table_of(title, headings, rows))


def _print(ack: Ack) -> None:
    saved = f"; saved {', '.join(ack.files)}" if ack.files else ""
    typer.echo(
        f"{ack.received} samples received, {ack.accepted} accepted, {ack.refused} refused, "
        f"{ack.processed_scans} scans in the map{saved}"
    )
