"""`hmt sim`: a drive through a simulated world, recorded with its truth.

References: own.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hmt_service import __version__
from hmt_service.cli.settings import Seed
from hmt_service.errors import InvalidInput
from hmt_service.sim.worlds.families import RECIPES, Family

if TYPE_CHECKING:
    from rich.console import Console

    from hmt_service.io.recording import Recording
    from hmt_service.sim.sensors import Laser2d, Lidar3d, WheelOdometry
    from hmt_service.sim.simulation import Instant, Robot
    from hmt_service.sim.worlds.world import World

_POINT_BYTES = 16
_SCAN_BYTES = 600
"""Odometry, truth, place, and what surrounds the points."""
_SLIP_M, _SLIP_DEG = 0.3, 5.0
"""Size of a slip of wheels that usually do not slip."""
_WORLD, _SENSOR, _ODOMETRY = "World", "Sensor", "Odometry"
_FAMILIES = " ".join(f"{family}: {recipe.description}" for family, recipe in RECIPES.items())


def _choice(name: str) -> Any:
    """Return the option of a parameter of some families; its text comes from their recipes."""
    families = {
        family: parameter
        for family, recipe in RECIPES.items()
        for parameter in recipe.parameters
        if parameter.name == name
    }
    ranges = ", ".join(f"{family} {p.low:g} to {p.high:g}" for family, p in families.items())
    texts = " ".join(dict.fromkeys(p.description for p in families.values()))
    return typer.Option(help=f"{texts} ({ranges})", rich_help_panel=_WORLD)


class SensorKind(StrEnum):
    """What a simulated robot may carry."""

    LASER = "laser"
    LIDAR = "lidar"


def sim(
    world: Annotated[str, typer.Argument(metavar="WORLD", help=f"Family of worlds. {_FAMILIES}")],
    out: Annotated[Path, typer.Option(help="Folder to write log, truth and places to.")],
    seed: Seed = 0,
    severity: Annotated[float | None, _choice("severity")] = None,
    areas: Annotated[int | None, _choice("areas")] = None,
    floors: Annotated[int | None, _choice("floors")] = None,
    relief_m: Annotated[float | None, _choice("relief_m")] = None,
    laps: Annotated[int | None, _choice("laps")] = None,
    people: Annotated[
        int, typer.Option(help="People who walk beside the route.", rich_help_panel=_WORLD)
    ] = 0,
    sensor: Annotated[
        SensorKind | None,
        typer.Option(help="Planar laser or spinning LiDAR.", rich_help_panel=_SENSOR),
    ] = None,
    beams: Annotated[
        int | None, typer.Option(help="Beams of a laser.", rich_help_panel=_SENSOR)
    ] = None,
    rows: Annotated[
        int | None, typer.Option(help="Rows of a LiDAR.", rich_help_panel=_SENSOR)
    ] = None,
    columns: Annotated[
        int | None, typer.Option(help="Columns of a LiDAR per turn.", rich_help_panel=_SENSOR)
    ] = None,
    fov_deg: Annotated[
        float | None,
        typer.Option(
            help="Field of view, deg: across for a laser, up and down for a LiDAR.",
            rich_help_panel=_SENSOR,
        ),
    ] = None,
    max_range_m: Annotated[
        float | None, typer.Option(help="Farthest return, m.", rich_help_panel=_SENSOR)
    ] = None,
    range_noise_m: Annotated[
        float | None,
        typer.Option(help="Standard deviation of a range, m.", rich_help_panel=_SENSOR),
    ] = None,
    rate_hz: Annotated[
        float | None, typer.Option(help="Scans per second.", rich_help_panel=_SENSOR)
    ] = None,
    drop: Annotated[
        float | None, typer.Option(help="Share of scans that are lost.", rich_help_panel=_SENSOR)
    ] = None,
    odometry_scale: Annotated[
        float | None,
        typer.Option(help="Measured over true distance.", rich_help_panel=_ODOMETRY),
    ] = None,
    odometry_drift_deg_per_m: Annotated[
        float | None,
        typer.Option(help="Systematic error of the heading.", rich_help_panel=_ODOMETRY),
    ] = None,
    slips_per_100m: Annotated[
        float | None,
        typer.Option(
            help=f"How often the wheels slip, by {_SLIP_M:g} m and {_SLIP_DEG:g} deg.",
            rich_help_panel=_ODOMETRY,
        ),
    ] = None,
    no_odometry: Annotated[
        bool, typer.Option("--no-odometry", help="Leave it out.", rich_help_panel=_ODOMETRY)
    ] = False,
) -> None:
    """Drive through a simulated world, and record what the robot sends, with the truth.

    Writes log.mcap (for `hmt run` and `hmt replay`), truth.tum and places.csv (true pose and place
    of every scan) and world.json (everything declared). Without options, the world and the robot
    are those that are usual for the family. The same seed and options give the same files, byte
    for byte.
    """
    from rich.console import Console

    from hmt_service.io.recording import recording, refuse_foreign
    from hmt_service.sim.simulation import simulate
    from hmt_service.sim.usual import USUAL_ROBOTS, preset_for
    from hmt_service.sim.worlds.families import draw

    family = Family.of(world)
    usual = USUAL_ROBOTS[family]
    robot = replace(
        usual,
        sensor=_sensor(
            usual.sensor,
            sensor,
            only_laser=_given(beams=beams),
            only_lidar=_given(rows=rows, columns=columns),
            fov_rad=_radians(fov_deg),
            ranges=_given(max_range_m=max_range_m, range_sigma_m=range_noise_m),
        ),
        odometry=replace(
            usual.odometry,
            **_given(scale=odometry_scale, drift_rad_per_m=_radians(odometry_drift_deg_per_m)),
            **_slips(usual.odometry, slips_per_100m),
        ),
        **_given(scan_period_s=_period_s(rate_hz), drop_share=drop),
    )
    preset = preset_for(robot, family)
    chosen = _given(severity=severity, areas=areas, floors=floors, relief_m=relief_m, laps=laps)
    console = Console(stderr=True)
    with console.status(f"drawing {family}"):
        drawn = draw(family, seed, **chosen)
        refuse_foreign(out)
        scans = expected_scans(drawn, robot)
        _check_room(out, scans, robot)
        instants = simulate(drawn, robot, seed, people=people)
    with recording(out) as files:
        drive = _record(_shown(instants, scans, console), files, has_odometry=not no_odometry)
        parameters = {p.name: chosen.get(p.name, p.default) for p in RECIPES[family].parameters}
        files.finish(
            {
                "version": __version__,
                "family": family,
                "seed": seed,
                "parameters": parameters,
                "people": people,
                "robot": _declared(robot, has_odometry=not no_odometry),
                "preset": preset,
                **asdict(drive),
            }
        )
    _report(console, out, drive, preset)


@dataclass(slots=True)
class _Drive:
    """What a drive comes to."""

    scans: int = 0
    lost_scans: int = 0
    odometry: int = 0
    places: int = 0
    duration_s: float = 0.0
    length_m: float = 0.0


def _record(instants: Iterable[Instant], files: Recording, *, has_odometry: bool) -> _Drive:
    """Write a drive to its files, and return what it came to."""
    from hmt_service.core.types import Scan

    drive, before = _Drive(), None
    for instant in instants:
        position = instant.truth.reference_from_body[:3, 3]
        if before is not None:
            drive.length_m += math.dist(before, position)
        before, drive.duration_s = position, instant.truth.stamp_s
        is_seen = False
        for reading in instant.readings:
            is_scan = isinstance(reading, Scan)
            is_seen |= is_scan
            if is_scan or has_odometry:
                files.send(reading)
                drive.odometry += not is_scan
        drive.lost_scans += not is_seen
        if is_seen:
            files.reveal(instant.truth, instant.place)
            drive.scans += 1
            drive.places = max(drive.places, instant.place + 1)
    return drive


def _shown(instants: Iterable[Instant], total: int, console: Console) -> Iterator[Instant]:
    """Yield the instants with a progress bar beside them."""
    from rich.progress import Progress

    with Progress(console=console) as progress:
        task, count = progress.add_task("driving", total=total), 0
        for count, instant in enumerate(instants, 1):
            yield instant
            progress.update(task, completed=count, total=max(count, total))
        progress.update(task, total=count)


def _sensor(
    usual: Laser2d | Lidar3d,
    kind: SensorKind | None,
    *,
    only_laser: dict[str, Any],
    only_lidar: dict[str, Any],
    fov_rad: float | None,
    ranges: dict[str, Any],
) -> Laser2d | Lidar3d:
    """Return a sensor of this kind, the usual one if it is, with what was chosen.

    Raises:
        InvalidInput: If a choice does not fit the kind or is out of range.
    """
    from hmt_service.sim.sensors import Laser2d, Lidar3d

    if kind is None:
        kind = SensorKind.LIDAR if isinstance(usual, Lidar3d) else SensorKind.LASER
    if foreign := only_lidar if kind is SensorKind.LASER else only_laser:
        raise InvalidInput(f"a {kind} has no {' and no '.join(foreign)}")
    if kind is SensorKind.LASER:
        laser = usual if isinstance(usual, Laser2d) else Laser2d()
        return replace(laser, **only_laser, **_given(field_of_view_rad=fov_rad), **ranges)
    lidar = usual if isinstance(usual, Lidar3d) else Lidar3d()
    return replace(lidar, **only_lidar, **_given(vertical_fov_rad=fov_rad), **ranges)


def _slips(usual: WheelOdometry, per_100m: float | None) -> dict[str, Any]:
    """Return how often and how far the wheels slip."""
    if per_100m is None:
        return {}
    slips_per_m = per_100m / 100.0
    if usual.slip_m or usual.slip_sigma_rad:
        return {"slips_per_m": slips_per_m}
    sigma_rad = math.radians(_SLIP_DEG)
    return {"slips_per_m": slips_per_m, "slip_m": _SLIP_M, "slip_sigma_rad": sigma_rad}


def _given(**values: float | None) -> dict[str, Any]:
    """Return what was given."""
    return {name: value for name, value in values.items() if value is not None}


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def _period_s(rate_hz: float | None) -> float | None:
    if rate_hz is None:
        return None
    if not rate_hz > 0.0:
        raise InvalidInput(f"{rate_hz:g} scans per second")
    return 1.0 / rate_hz


def expected_scans(world: World, robot: Robot) -> int:
    """Return about how many scans the drive will have: corners cut make up for slow turns."""
    import numpy as np

    length_m = float(np.linalg.norm(np.diff(world.route_m[:, :2], axis=0), axis=1).sum())
    return math.ceil(length_m / robot.follower.speed_m_s / robot.scan_period_s)


def _check_room(out: Path, scans: int, robot: Robot) -> None:
    """Check that a recording will fit on the disk.

    Raises:
        InvalidInput: If it will not.
    """
    each = robot.sensor.rays * _POINT_BYTES + _SCAN_BYTES
    disk = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    free = shutil.disk_usage(disk).free
    if scans * each > free:
        raise InvalidInput(
            f"about {scans} scans of up to {each} bytes are {scans * each / 1e9:.1f} GB, and "
            f"{free / 1e9:.1f} GB are free at {disk}"
        )


def _declared(robot: Robot, *, has_odometry: bool) -> dict[str, object]:
    """Return what a robot is, in the types of JSON."""
    values = asdict(robot)
    return values if has_odometry else values | {"odometry": None}


def _report(console: Console, out: Path, drive: _Drive, preset: str) -> None:
    from hmt_service.io.recording import LOG

    console.print(
        f"{drive.scans} scans, {drive.odometry} odometry readings, {drive.places} places over "
        f"{drive.length_m:.0f} m in {drive.duration_s:.0f} s",
        soft_wrap=True,
    )
    console.print(
        f"saved in {out}; to map it: hmt run {out / LOG} --preset {preset} --out DIR",
        soft_wrap=True,
        markup=False,
    )
