"""Names that people choose by, apart from what they stand for.

The command line knows them before numpy and pydantic are loaded.

References: own.
"""

from __future__ import annotations

from enum import StrEnum


class Preset(StrEnum):
    """Settings per kind of sensor."""

    PLANAR = "2d"
    """Planar laser."""
    INDOOR = "3d-indoor"
    """LiDAR in buildings and garages."""
    OUTDOOR = "3d-outdoor"
    """LiDAR on roads, between buildings, in the open."""


class MapMethod(StrEnum):
    """How area poses are brought into one frame (section IV-C)."""

    CONSISTENT = "consistent"
    SHORTEST_PATH = "shortest_path"


class EventKind(StrEnum):
    """What can happen to the map that somebody may want to know."""

    AREA_ENTERED = "area_entered"
    BRANCHED = "branched"
    PRUNED = "pruned"
    ACCEPTED = "accepted"
    INPUT_DROPPED = "input_dropped"
    LOST = "lost"
    PROCESS_FAILED = "process_failed"
    PRESET_DOUBTED = "preset_doubted"
    PRESET_CONFIRMED = "preset_confirmed"
    NOT_SAVED = "not_saved"
    OVER_BUDGET = "over_budget"
    PROCESS_RESTARTED = "process_restarted"
    ARC_ASSERTED = "arc_asserted"
    ARC_RETRACTED = "arc_retracted"
