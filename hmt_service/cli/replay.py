"""`hmt replay`: send a recorded log to a daemon.

References: own.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli.connection import Connect, Robot, Site, ZenohConfig, connected
from hmt_service.cli.recorded import LogPath, print_contents, print_malformed
from hmt_service.cli.settings import ScanRate, SensorPose, pose_on_body
from hmt_service.errors import DaemonFailure

if TYPE_CHECKING:
    from rich.console import Console

    from hmt_service.client import HmtClient
    from hmt_service.core.types import Reading
    from hmt_service.service.reports import Status

_FARTHEST_M = 1e6
"""Everything finite is sent: what is a return is the daemon's settings' business."""
_POLL_S = 0.1


def replay(
    log: LogPath,
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    rate: Annotated[
        float | None,
        typer.Option(min=1e-3, help="Speed in multiples of real time; without it, full speed."),
    ] = None,
    sensor_pose: SensorPose = None,
    scan_rate: ScanRate = None,
    finish: Annotated[
        bool, typer.Option(help="Wait until all is in the map, and have it completed and saved.")
    ] = True,
) -> None:
    """Send a recorded log to a daemon, and wait for the map."""
    from rich.console import Console

    from hmt_service.io.logs import read_log

    console = Console(stderr=True)
    with connected(connect, site, robot, zenoh_config) as client:
        client.status()
        with console.status(f"reading {log}"):
            recorded = read_log(
                log,
                min_range_m=0.0,
                max_range_m=_FARTHEST_M,
                body_from_sensor=pose_on_body(sensor_pose),
                scan_rate_hz=scan_rate,
            )
        print_contents(console, recorded)
        replay_readings(
            client,
            recorded.readings,
            console,
            total=recorded.scans + recorded.odometry,
            rate=rate,
            has_finish=finish,
        )
    print_malformed(console, recorded)


def replay_readings(
    client: HmtClient,
    readings: Iterable[Reading],
    console: Console,
    *,
    total: int,
    rate: float | None = None,
    has_finish: bool = True,
) -> None:
    """Send readings to a daemon with a progress bar, and say what became of them.

    Args:
        client: Connection to the daemon.
        readings: In the order of time.
        console: Where the progress is shown.
        total: How many readings there are, about: for the progress only.
        rate: Speed in multiples of real time; None for full speed.
        has_finish: Whether to wait for the complete map.

    Raises:
        DaemonFailure: If a reading did not reach the daemon.
    """
    from rich.progress import Progress

    from hmt_service.core.types import Scan

    before = client.status()
    sent = scans = 0
    with Progress(console=console) as progress:
        sending = progress.add_task("sending", total=total)
        for reading in _paced(readings, rate):
            client.publish(reading)
            sent += 1
            scans += isinstance(reading, Scan)
            progress.update(sending, completed=sent)
        if has_finish:
            mapping = progress.add_task("mapping", total=scans)
            known = before.processed_scans
            _finish(client, lambda n: progress.update(mapping, completed=n - known))
    _report(console, sent, sum(client.lost().values()), before, client.status())


def _paced(readings: Iterable[Reading], rate: float | None) -> Iterator[Reading]:
    """Yield readings when their time has come, at `rate` times real time; at once without it."""
    if rate is None:
        yield from readings
        return
    zero_s: float | None = None
    for reading in readings:
        if zero_s is None:
            zero_s = time.monotonic() - reading.stamp_s / rate
        due_s = zero_s + reading.stamp_s / rate
        time.sleep(max(0.0, due_s - time.monotonic()))
        yield reading


def _finish(client: HmtClient, show: Callable[[int], None]) -> None:
    """Have the map completed, and show the number of scans in it meanwhile."""
    with ThreadPoolExecutor(max_workers=1) as pool:
        ack = pool.submit(client.finish)
        while not wait([ack], timeout=_POLL_S).done:
            show(client.status().processed_scans)
        show(ack.result().processed_scans)


def _report(console: Console, sent: int, lost: int, before: Status, after: Status) -> None:
    if lost:
        raise DaemonFailure(f"{lost} of {sent} readings did not reach the daemon")
    new = Counter(after.input.refused) - Counter(before.input.refused)
    refused = ", ".join(f"{count} {reason}" for reason, count in new.items()) or "none"
    scans = after.processed_scans - before.processed_scans
    console.print(f"{sent} readings sent, refused {refused}; {scans} scans new in the map")
