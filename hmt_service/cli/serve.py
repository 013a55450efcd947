"""`hmt serve`: the daemon.

References: own.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import Robot, Site, ZenohConfig
from hmt_service.cli.logs import LogFormat, Say, logging_as
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
        typer.Option(
            help="Zenoh endpoint to listen on; those of --zenoh-config, or "
            f"{DEFAULT_ENDPOINT}, if none is given. May be repeated."
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(help="Zenoh endpoint to connect to, such as a router's. May be repeated."),
    ] = None,
    zenoh_config: ZenohConfig = None,
    allow_unauthenticated: Annotated[
        bool,
        typer.Option(
            "--allow-unauthenticated",
            help="Let other machines in without asking who they are: to read, to send scans, to "
            "shut the daemon down.",
        ),
    ] = False,
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
            help="How long readings wait for earlier ones at most, s of sensor time; scans and "
            "odometry that each come in order wait for each other only.",
        ),
    ] = 0.25,
    metrics: Annotated[
        int | None,
        typer.Option(
            min=1, max=65535, help="Port on loopback that serves Prometheus metrics by HTTP."
        ),
    ] = None,
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
    log_format: Annotated[
        LogFormat,
        typer.Option(help="What is logged: lines for people, or one JSON object per line."),
    ] = LogFormat.TEXT,
) -> None:
    """Build the map of one robot from what it sends, and answer questions about it.

    Stops within 5 s on SIGINT or SIGTERM, after saving. Exit codes: 0 stopped and saved, 2 wrong
    options or no session, 3 a process died, 4 the map could not be saved.
    """
    from hmt_service.io.ros_messages import RosType
    from hmt_service.service.daemon import Daemon, DaemonSettings
    from hmt_service.service.intake import IntakeLimits
    from hmt_service.service.results import save_results
    from hmt_service.service.ros2 import Ros2Input
    from hmt_service.service.session import daemon_endpoints

    with logging_as(log_format) as say:
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
        endpoints = daemon_endpoints(
            listen or (),
            connect or (),
            has_scouting=scouting,
            zenoh_config=zenoh_config,
            allows_strangers=allow_unauthenticated,
        )
        save = None
        if out is not None:
            save = partial(save_results, directory=out, config=settings, seed=seed)
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
                metrics_port=metrics,
            )
        )
        with _signals_to(daemon.request_stop):
            report = daemon.run(
                on_open=lambda: say(f"serving site {site}, robot {robot} {endpoints}", False)
            )
        _tell(say, report)
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


def _tell(say: Say, report: StopReport) -> None:
    counts, finished = report.status.input, report.finished
    refused = ", ".join(f"{count} {reason}" for reason, count in counts.refused.items()) or "none"
    say(
        f"stopped by {report.reason}: {counts.received} samples received, refused {refused}; "
        f"{report.status.processed_scans} scans in the map, {report.unprocessed} samples not in it",
        report.failure is not None,
    )
    if counts.received == 0:
        say("nothing to save", False)
    elif finished is None:
        say("the map was not saved: nobody was left to do it in time", True)
    elif finished.failure:
        say(finished.failure, True)
    elif finished.files:
        say(f"saved {', '.join(finished.files)}", False)


def _exit_code(report: StopReport, *, is_saving: bool) -> int:
    if report.failure is not None:
        return PROCESS_FAILED
    is_saved = report.finished is not None and report.finished.failure is None
    has_map = report.status.keyframes > 0
    return NOT_SAVED if is_saving and has_map and not is_saved else 0
