"""Options that every command which builds a map has.

References: own.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hmt_service.core.choices import Preset
from hmt_service.errors import InvalidInput, NotFound

if TYPE_CHECKING:
    from hmt_service.core.config import Config
    from hmt_service.core.geometry import Pose
    from hmt_service.core.visits import MemoryBudget
    from hmt_service.service.kept_map import KeptMap

PresetName = Annotated[Preset, typer.Option("--preset", help="Kind of sensor.")]
OwnPreset = Annotated[
    Preset | None,
    typer.Option("--preset", help=f"Kind of sensor; {Preset.PLANAR} if none is given."),
]
MeasuredPreset = Annotated[
    Preset | None,
    typer.Option(
        "--preset", help="Kind of sensor; if none is given, the one that fits what the log sees."
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="YAML file of settings that differ from the preset."),
]
Frozen = Annotated[
    bool,
    typer.Option(
        "--frozen", help="Find the robot's place in the map of --map and leave it as it is."
    ),
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of all randomness.")]


BudgetSize = Annotated[
    str | None,
    typer.Option(
        "--memory-budget",
        metavar="SIZE",
        help="Memory that submaps may take, such as 256MB; those that were not used for the "
        "longest time are in a temporary file (TMPDIR) meanwhile. The map is the same. All of them "
        "are in memory if none is given.",
    ),
]
SensorPose = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(
        "--sensor-pose",
        metavar="X Y Z ROLL PITCH YAW",
        help="Pose of the sensor on the body, m and degrees, for scans of ROS and in folders. "
        "Without it a log's `tf_static` says it; where nothing does, only odometry of the scans' "
        "own frame is taken.",
    ),
]
ScanRate = Annotated[
    float | None,
    typer.Option(
        "--scan-rate",
        min=1e-3,
        metavar="HZ",
        help="Scans per second of a folder of scans that have no stamps; 10 if none is given.",
    ),
]
_UNITS = {"KB": 1e3, "MB": 1e6, "GB": 1e9}


def budget_of(size: str | None) -> MemoryBudget | None:
    """Return a memory budget, None for none.

    Raises:
        InvalidInput: If the text is no size, or too small a one.
    """
    if size is None:
        return None
    from hmt_service.core.visits import MemoryBudget
    from hmt_service.io.shelf import DiskShelf

    found = re.fullmatch(r"(\d+(?:\.\d+)?) *([KMG]B)", size.strip().upper())
    if found is None:
        raise InvalidInput(f"{size!r} is no size of memory: a number with kB, MB or GB, as 256MB")
    return MemoryBudget(int(float(found[1]) * _UNITS[found[2]]), DiskShelf())


def pose_on_body(numbers: tuple[float, float, float, float, float, float] | None) -> Pose | None:
    """Return `body_from_sensor` of `SensorPose`, None for none.

    Raises:
        InvalidInput: If a number is not finite.
    """
    return None if numbers is None else pose_of_numbers(numbers)


def pose_of_numbers(numbers: tuple[float, float, float, float, float, float]) -> Pose:
    """Return the pose of x, y, z, roll, pitch, yaw, m and degrees, shape (4, 4).

    Raises:
        InvalidInput: If a number is not finite.
    """
    import numpy as np

    from hmt_service.core.geometry import exp, identity

    if not np.all(np.isfinite(numbers)):
        raise InvalidInput(f"pose {numbers} is not finite")
    x, y, z, *angles_deg = numbers
    roll, pitch, yaw = np.radians(angles_deg)
    pose = identity()
    # About fixed axes (REP 103).
    for turn in ([0.0, 0.0, yaw], [0.0, pitch, 0.0], [roll, 0.0, 0.0]):
        pose = pose @ exp(np.array([*turn, 0.0, 0.0, 0.0]))
    pose[:3, 3] = x, y, z
    return pose


def settings_of_map(map_file: Path | None, preset: Preset | None, config: Path | None) -> Config:
    """Return the settings of a map that goes on; of one that begins, those that are asked for.

    Raises:
        InvalidInput: If the map has settings and others are asked for, or the file is no map file.
        NotFound: If the file of settings cannot be read.
        InvalidConfig: If its content is refused.
    """
    if map_file is None or not map_file.exists():
        return load_settings(preset or Preset.PLANAR, config)
    if preset is not None or config is not None:
        raise InvalidInput(f"{map_file} has settings of its own: leave out --preset and --config")
    from hmt_service.io.map_file import read_config

    return read_config(map_file)


def kept_map(map_file: Path | None, *, is_frozen: bool, is_known: bool) -> KeptMap | None:
    """Return the map that goes on, if one is named.

    Args:
        map_file: The file.
        is_frozen: Whether it stays as it is.
        is_known: Whether it must be there already.

    Raises:
        InvalidInput: If there is nothing that could be frozen.
        NotFound: If a map that must be there is not.
    """
    from hmt_service.service.kept_map import KeptMap

    if map_file is None:
        if is_frozen:
            raise InvalidInput("--frozen needs the map that --map names")
        return None
    if is_known and not map_file.is_file():
        raise NotFound(f"map file {map_file} does not exist")
    return KeptMap(map_file, is_frozen=is_frozen)


def load_settings(preset: Preset, config: Path | None) -> Config:
    """Return a preset, changed by a YAML file when there is one.

    Raises:
        NotFound: If the file cannot be read.
        InvalidConfig: If its content is refused.
    """
    from hmt_service.core.config import load_config

    if config is None:
        return load_config(preset)
    try:
        return load_config(preset, config.read_text())
    except OSError as error:
        raise NotFound(f"configuration {config}: {error.strerror}") from error
