"""`hmt demo`: the whole chain on a simulated building, with a real daemon and nothing to download.

References: own.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.cli import query
from hmt_service.cli.replay import replay_readings
from hmt_service.cli.settings import Seed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from hmt_service.core.types import StampedPose

PICTURE = "map.png"
"""Name of the figure in the output folder."""


def demo(
    out: Annotated[Path, typer.Option(help="Folder to write the results to.")] = Path("out/demo"),
    seed: Seed = 0,
) -> None:
    """Simulate a building, send its scans to a daemon over Zenoh, and compare the global maps."""
    from rich.console import Console

    from hmt_service.client import HmtClient
    from hmt_service.client.local import local_daemon
    from hmt_service.io.saved_run import TRAJECTORY
    from hmt_service.sim.simulation import INDOOR_LASER, simulate
    from hmt_service.sim.worlds.office import office

    console = Console()
    with console.status("simulating an office building"):
        instants = tuple(simulate(office(seed), INDOOR_LASER, seed))
    console.print(f"simulated {len(instants)} scans and the wheel odometry of a robot in an office")
    out.mkdir(parents=True, exist_ok=True)
    with local_daemon("--out", str(out)) as endpoint:
        with HmtClient(endpoint) as client:
            readings = tuple(reading for instant in instants for reading in instant.readings)
            replay_readings(client, readings, console, total=len(readings))
        query.posterior(connect=endpoint)
        query.compare(connect=endpoint)
        query.map_(connect=endpoint, out=out / PICTURE)
    _report_truth(console, out / TRAJECTORY, [instant.truth for instant in instants])
    console.print(f"picture of both maps: {out / PICTURE}", soft_wrap=True)


def _report_truth(console: Console, trajectory: Path, truth: Sequence[StampedPose]) -> None:
    """Print how far the map's trajectory is from the simulated one, start poses laid together."""
    import numpy as np

    from hmt_service.io.trajectory import read_tum

    world_from_reference = truth[0].reference_from_body
    errors = [
        np.linalg.norm(
            (world_from_reference @ pose.reference_from_body)[:3, 3]
            - true.reference_from_body[:3, 3]
        )
        for pose, true in zip(read_tum(trajectory), truth, strict=True)
    ]
    console.print(
        f"distance from the true trajectory, start laid on start: mean {np.mean(errors):.3f} m, "
        f"largest {np.max(errors):.3f} m over {len(errors)} scans"
    )
