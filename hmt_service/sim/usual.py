"""Which robot usually drives in which family of worlds, and which settings map what it sees.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from hmt_service.core.config import Preset
from hmt_service.sim.sensors import Lidar3d
from hmt_service.sim.simulation import INDOOR_LASER, LIDAR, OUTDOOR_LASER, SHORT_SIGHTED, Robot
from hmt_service.sim.worlds.families import Family

USUAL_ROBOTS: Mapping[Family, Robot] = MappingProxyType(
    {
        Family.OFFICE: INDOOR_LASER,
        Family.ALIASED: SHORT_SIGHTED,
        Family.NESTED_LOOPS: INDOOR_LASER,
        Family.CAMPUS: OUTDOOR_LASER,
        Family.WAREHOUSE: INDOOR_LASER,
        Family.GARAGE: LIDAR,
        Family.LONG: INDOOR_LASER,
    }
)
"""The robot of each family."""


def preset_for(robot: Robot, family: Family) -> Preset:
    """Return the settings that fit a robot's sensor and where it drives."""
    if not isinstance(robot.sensor, Lidar3d):
        return Preset.PLANAR
    return Preset.OUTDOOR if family is Family.CAMPUS else Preset.INDOOR
