"""What a recorded log holds besides readings in order: streams, frames, readings as they stand.

References: own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Reading


class Use(StrEnum):
    """What a stream is read for."""

    SCANS = "scans"
    ODOMETRY = "odometry"
    SCANS_AND_ODOMETRY = "scans, odometry"
    FRAMES = "frames"
    NOTHING = "-"


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Messages of one kind in a log."""

    name: str
    """Topic, tag or file pattern."""
    kind: str
    """Type of the messages."""
    encoding: str
    """How they are serialised."""
    use: Use
    """What it is read for."""
    why: str
    """Why for that, or for nothing; empty where nothing else could be."""
    messages: int
    """How many there are."""
    times_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    """When each was recorded, in the order of the log, shape (N,); empty where nothing says it."""


class Says(StrEnum):
    """Who says where the sensor sits on the body."""

    EVERY_SCAN = "every_scan"
    STATIC_FRAMES = "tf_static"
    CALLER = "caller"
    """Whoever reads the log."""
    SAME_FRAME = "same_frame"
    """Scans are in the frame of the body."""
    NOBODY = "nobody"
    """It is taken to be the centre of the body."""


@dataclass(frozen=True, slots=True)
class Mounting:
    """Where the sensor sits on the robot, and who says so."""

    scan_frame: str | None
    """Frame that the scans are in; None where the format names none."""
    body_frame: str | None
    """Frame that the odometry is of; None where the format names none."""
    says: Says
    """Who says it."""


class Note(NamedTuple):
    """Something that is assumed because a log does not say it."""

    what: str
    """What."""
    step: str
    """How to say it."""


IN_EVERY_SCAN = Mounting(None, None, Says.EVERY_SCAN)
"""Of formats without frames, whose scans say where their sensor sits."""


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """A reading as it stands in the log, before readings are put in order."""

    stream: str
    """Name of its stream."""
    place: str
    """Where it stands."""
    reading: Reading
    """What it says."""
    recorded_s: float | None = None
    """When it was recorded, by the recorder's clock; None where nothing says it."""
