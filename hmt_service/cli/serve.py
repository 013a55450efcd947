"""`hmt serve`: the daemon.

References: own.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import Robot, Site
from hmt_service.cli.settings import (
    BudgetSize,
    ConfigFile,
    Frozen,
    OwnPreset,
    Seed,
    SensorPose,
    budget_of,
    kept_map,
    pose_on_body,
    settings_of_map,
)
from hmt_service.errors import NotFound
from hmt_service.service.keys import DEFAULT_ENDPOINT, Keys

if TYPE_CHECKING:
    from rich.console import Console

    from hmt_service.service.daemon import StopReport

PROCESS_FAILED = 3
"""Exit code after a process of the daemon has died."""
NOT_SAVED = 4
"""Exit code when there was a map and it could not be saved."""


def serve(
    site: Site = "site",
    robot: Robot = "robot",
    listen: Annotated[
        list[str] | None,
        typer.Option(help=f"Zenoh endpoint to listen on; {DEFAULT_ENDPOINT} if none is given."),
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option(help="Zenoh endpoint to connect to, such as a router's.")
    ] = None,
    scouting: Annotated[
        bool, typer.Option("--scouting", help="Look for others on the network by multicast.")
    ] = False,
    preset: OwnPreset = None,
    config: ConfigFile = None,
    seed: Seed = 0,
    ros2_laser: Annotated[
        str | None,
        typer.Option(
            metavar="TOPIC",
            help="Topic of ROS 2, such as /scan, to take LaserScan messages from, as rmw_zenoh or "
            "zenoh-bridge-ros2dds publishes them.",
        ),
    ] = None,
    ros2_cloud: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="The same for PointCloud2.")
    ] = None,
    ros2_odometry: Annotated[
        str | None, typer.Option(metavar="TOPIC", help="The same for Odometry, such as /odom.")
    ] = None,
    ros2_domain: Annotated[
        int, typer.Option(envvar="ROS_DOMAIN_ID", help="Domain of the robot, for rmw_zenoh.")
    ] = 0,
    sensor_pose: SensorPose = None,
    reorder_window: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="How long readings wait for earlier ones, s of sensor time; poses are that late.",
        ),
    ] = 0.25,
    out: Annotated[
        Path | None, typer.Option(help="Folder to save the results to when the map is finished.")
    ] = None,
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Map file to go on with, from an unknown place; made if it does not exist. It is "
            "written as the map grows: what `status` calls stored survives anything.",
        ),
    ] = None,
    frozen: Frozen = False,
    memory_budget: BudgetSize = None,
) -> None:
    """Build the map of one robot from what it sends, and answer questions about it.

    Stops within 5 s on SIGINT or SIGTERM, after saving. Exit codes: 0 stopped and saved, 2 wrong
    options or no session, 3 a process died, 4 the map could not be saved.
    """
    from rich.console import Console
    from rich.logging import RichHandler

    from hmt_service.io.ros_messages import RosType
    from hmt_service.service.daemon import Daemon, DaemonSettings
    from hmt_service.service.intake import IntakeLimits
    from hmt_service.service.results import save_results
    from hmt_service.service.ros2 import Ros2Input
    from hmt_service.service.session import Endpoints, Mode

    console = Console(stderr=True)
    handler = RichHandler(console=console, show_path=False)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[handler])
    kept = kept_map(map_file, is_frozen=frozen, is_known=frozen)
    settings = settings_of_map(map_file, preset, config)
    budget = budget_of(memory_budget)
    if map_file is not None and not map_file.absolute().parent.is_dir():
        raise NotFound(f"folder {map_file.absolute().parent} of the map file does not exist")
    topics = {
        RosType.LASER_SCAN: ros2_laser,
        RosType.POINT_CLOUD: ros2_cloud,
        RosType.ODOMETRY: ros2_odometry,
    }
    ros2 = Ros2Input(
        topics={kind: topic for kind, topic in topics.items() if topic is not None},
        domain=ros2_domain,
        body_from_sensor=pose_on_body(sensor_pose),
    )
    listening = listen or ([] if connect else [DEFAULT_ENDPOINT])
    endpoints = Endpoints(
        # A router passes nothing between peers that cannot find each other: be its client.
        mode=Mode.PEER if listening else Mode.CLIENT,
        listen=tuple(listening),
        connect=tuple(connect or []),
        has_scouting=scouting,
    )
    save = None
    if out is not None:
        save = partial(save_results, directory=out, config=settings, seed=seed, kept=map_file)
    daemon = Daemon(
        DaemonSettings(
            keys=Keys(site, robot),
            endpoints=endpoints,
            config=settings,
            ros2=ros2,
            seed=seed,
            save=save,
            keeper=kept,
            budget=budget,
            limits=IntakeLimits(reorder_s=reorder_window),
        )
    )
    with _signals_to(daemon.request_stop):
        report = daemon.run(
            on_open=lambda: console.print(f"serving site {site}, robot {robot} {endpoints}")
        )
    _print(console, report)
    is_saving = save is not None or (map_file is not None and not frozen)
    raise typer.Exit(_exit_code(report, is_saving=is_saving))


@contextmanager
def _signals_to(request_stop: Callable[[str], None]) -> Iterator[None]:
    """Have SIGINT and SIGTERM ask for a stop instead of causing one."""
    before = {
        number: signal.signal(number, lambda n, _: request_stop(signal.Signals(n).name))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _print(console: Console, report: StopReport) -> None:
    counts, finished = report.status.input, report.finished
    refused = ", ".join(f"{count} {reason}" for reason, count in counts.refused.items()) or "none"
    console.print(
        f"stopped by {report.reason}: {counts.received} samples received, refused {refused}; "
        f"{report.status.processed_scans} scans in the map, {report.unprocessed} samples not in it",
        soft_wrap=True,
    )
    if counts.received == 0:
        console.print("nothing to save")
    elif finished is None:
        console.print("[red]the map was not saved: nobody was left to do it in time")
    elif finished.failure:
        console.print(f"[red]{finished.failure}")
    elif finished.files:
        console.print(f"saved {', '.join(finished.files)}")


def _exit_code(report: StopReport, *, is_saving: bool) -> int:
    if report.failure is not None:
        return PROCESS_FAILED
    is_saved = report.finished is not None and report.finished.failure is None
    has_map = report.status.keyframes > 0
    return NOT_SAVED if is_saving and has_map and not is_saved else 0
