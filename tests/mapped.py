"""A small map of the flat, made by the engine: what files and exports of maps are tested with."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from hmt_service.core.config import Preset, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.io.map_file import write_map
from tests.flat import SETTINGS, readings

SCANS = 300
"""From the left room to the right one, back, and a little further."""


@cache
def mapped() -> Engine:
    """Return the engine after the drive, not smoothed; nobody may change it."""
    config = load_config(Preset.PLANAR, SETTINGS)
    engine, odometry = Engine(config), Odometry(config)
    for reading in readings(SCANS):
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    engine.finish(is_urgent=True)
    return engine


def map_file_in(folder: Path) -> Path:
    """Write that map."""
    path = folder / "map.hmt"
    write_map(path, mapped().stored())
    return path
