"""What the daemon says of itself.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from hmt_service.core.types import Localization
from hmt_service.runtime.messages import ProcessStatus
from hmt_service.service.keys import Input


class DaemonState(StrEnum):
    """Phase of the daemon's life."""

    STARTING = "starting"
    """Processes are loading; input is already queued."""
    RUNNING = "running"
    """Input is taken, queries are answered."""
    STOPPING = "stopping"
    """No more input; the map is being saved."""


@dataclass(frozen=True, slots=True)
class InputCounts:
    """What became of the input: received = accepted + refused + queued + discarded."""

    received: int
    """Samples that arrived."""
    accepted: int
    """Readings that passed every check."""
    refused: Mapping[str, int]
    """Samples refused, by reason."""
    queued: int
    """Samples that wait to be decoded."""
    queued_bytes: int
    """The memory that they take."""
    discarded: int
    """Samples thrown away because the daemon had to stop."""
    reordering: int
    """Accepted readings that wait for earlier ones to arrive."""
    dropped_beams: Mapping[str, int]
    """Single beams dropped from accepted scans, by reason."""


@dataclass(frozen=True, slots=True)
class SenderCounts:
    """What arrived of one sender under one key."""

    sender: int
    """Number that it has drawn for itself."""
    input: Input
    """What it sends."""
    received: int
    """Samples that arrived."""
    lost: int
    """Samples before the last one of these that did not."""


@dataclass(frozen=True, slots=True)
class Status:
    """Everything that an operator may ask of the daemon."""

    version: str
    """Version of this package."""
    config_hash: str
    """Hash of the settings of the mapping core."""
    state: DaemonState
    """Phase of its life."""
    uptime_s: float
    """Time since the start, wall clock."""
    input: InputCounts
    """What became of the input."""
    tracked_scans: int
    """Scans that the odometry has processed."""
    processed_scans: int
    """Scans in the map."""
    processes: tuple[ProcessStatus, ...]
    """What the children are doing."""
    revision: int
    """Map revision; zero, as all below, before the first keyframe."""
    areas: int
    """Areas of the best hypothesis."""
    arcs: int
    """Arcs of the best hypothesis."""
    keyframes: int
    """Keyframes in the map."""
    hypotheses: int
    """Hypotheses alive."""
    hypothesis: int | None
    """The best one; None before the first keyframe."""
    stored_keyframes: int
    """Keyframes that are in the map file, whatever happens now; zero without one."""
    localization: Localization | None
    """How sure it is where the robot is; None before the first keyframe."""
    senders: tuple[SenderCounts, ...]
    """What arrived of senders that number what they send; of the last hundred."""
    clock_s: float
    """Wall clock of the daemon's machine when it answered, s since 1970-01-01 UTC; 0: an older one,
    which does not tell."""


@dataclass(frozen=True, slots=True)
class Ack:
    """Answer to a call that changes state."""

    received: int
    """Samples that arrived so far."""
    accepted: int
    """Readings that passed every check."""
    refused: int
    """Samples refused."""
    processed_scans: int
    """Scans in the map."""
    files: tuple[str, ...] = ()
    """Names of the files written."""
