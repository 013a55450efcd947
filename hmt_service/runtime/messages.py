"""What the processes of the daemon say to each other: frozen values, pickled over pipes.

Every message that the parent sends is answered by exactly one message of the child on the same
pipe, in order; answers to requests may come in several parts. That makes the number of messages
under way known, and a bound on it a bound on memory.

References:
    own.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

from hmt_service.core.config import Config
from hmt_service.core.geometry import GaussianPose
from hmt_service.core.types import (
    AreaDetails,
    Comparison,
    Event,
    GlobalMap,
    MapMethod,
    Snapshot,
    StatementEffect,
    Tracking,
    Trajectory,
)
from hmt_service.errors import HmtError

if TYPE_CHECKING:
    from hmt_service.core.engine import Engine
    from hmt_service.core.visits import MemoryBudget


class ProcessName(StrEnum):
    """The processes of the daemon."""

    GATEWAY = "gateway"
    ODOMETRY = "odometry"
    TOPOLOGY = "topology"


@dataclass(frozen=True, slots=True)
class Ready:
    """A child takes work; like `News` no answer to anything."""

    first_keyframe: int = 0
    """Keyframes that the map had when the session began."""


@dataclass(frozen=True, slots=True, eq=False)
class News:
    """What the topology has to tell although it was told nothing."""

    mapped: Mapped
    """The map as it is, and what has happened to it."""


@dataclass(frozen=True, slots=True)
class Stop:
    """End; the only message without an answer."""


@dataclass(frozen=True, slots=True)
class Finish:
    """Complete and save the map; travels behind the readings so far through every process."""

    number: int
    """Grows with every one."""
    is_urgent: bool = False
    """Whether there is no time to smooth the trajectory."""
    is_last: bool = False
    """Whether readings behind it wait until they are let go on, for another map."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """The odometry has processed one reading."""

    tracking: Tracking | None
    """What it says of the scan; None for odometry readings."""
    processed: int
    """Readings processed so far."""
    busy_s: float
    """Time spent on them, s of the wall clock."""
    memory: Mapping[str, Any] | None = None
    """What the odometry remembers, for one that has to go on in its place; not passed on."""


@dataclass(frozen=True, slots=True)
class RunReport:
    """What the run has cost so far."""

    scans: int
    """Scans that went into the map."""
    odometry_busy_s: float
    """Time that the odometry has worked, s of the wall clock."""
    topology_busy_s: float
    """Time that the topology has worked, s of the wall clock."""
    stored_keyframes: int = 0
    """Keyframes that are in the map file, whatever happens now."""

    @property
    def busy_s(self) -> float:
        """Time that both have worked, s of the wall clock."""
        return self.odometry_busy_s + self.topology_busy_s


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """The topology has processed one scan, or a `Finish`."""

    snapshot: Snapshot | None
    """What readers may know now; None when nothing changed."""
    events: tuple[Event, ...]
    """What happened to the map."""
    report: RunReport
    """What the run has cost so far."""
    known_scans: int
    """Scans in the map, of all sessions."""
    stored_scans: int
    """How many of them are in the map file, whatever happens now."""
    finished: Finished | None = None
    """Set in the answer to `Finish`."""
    wakes_up: bool = False
    """Whether the robot may be anywhere from the next keyframe on."""


@dataclass(frozen=True, slots=True)
class Finished:
    """The map is complete and saved."""

    number: int
    """Of the `Finish` that it answers."""
    files: tuple[str, ...]
    """Names of the files written."""
    failure: str | None = None
    """Why they could not be written, if so."""


@dataclass(frozen=True, slots=True)
class MapRequest:
    """Compose a global map."""

    method: MapMethod
    """How."""
    reference_area: int | None = None
    """Area whose frame it shall be in; None for the engine's choice."""
    hypothesis: int | None = None
    """Hypothesis; None for the most probable one."""
    with_points: bool = True
    """Whether to include the submaps."""
    known: Mapping[int, int] = field(default_factory=dict)
    """Versions of submaps, by area, whose points are left out: who asks has them."""


@dataclass(frozen=True, slots=True)
class AreaRequest:
    """Tell everything of one area."""

    area: int
    """Which one."""
    reference_area: int | None = None
    """Area whose frame its pose shall be in; None for the engine's choice."""
    hypothesis: int | None = None
    """Hypothesis; None for the most probable one."""
    with_points: bool = True
    """Whether to include the submap."""
    known: Mapping[int, int] = field(default_factory=dict)
    """As in `MapRequest`."""


@dataclass(frozen=True, slots=True)
class TrajectoryRequest:
    """Tell where the scans of an interval were taken."""

    start_s: float
    """Its begin, sensor time, included."""
    end_s: float
    """Its end, included."""
    hypothesis: int | None = None
    """Hypothesis; None for the most probable one."""


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """Compare both global maps."""

    reference_area: int | None = None
    """Area whose frame both shall be in; None for the engine's choice."""
    hypothesis: int | None = None
    """Hypothesis; None for the most probable one."""


@dataclass(frozen=True, slots=True)
class SaveRequest:
    """Save the map as it is now."""


@dataclass(frozen=True, slots=True)
class RelocalizeRequest:
    """Forget where in the map the robot is."""


@dataclass(frozen=True, slots=True, eq=False)
class AssertArcRequest:
    """Take what somebody says of two areas as evidence."""

    area_a: int
    """One of them."""
    area_b: int
    """The other one."""
    a_from_b: GaussianPose
    """Pose of its frame in that of the first, as well as it is known."""
    probability: float
    """How probably that is right."""


@dataclass(frozen=True, slots=True)
class RetractArcRequest:
    """Forget what somebody said."""

    statement: int
    """Identifier of what was said."""


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """What one child is doing."""

    name: ProcessName
    """Which one."""
    pid: int
    """Its number in the operating system."""
    is_ready: bool
    """Whether it has loaded its libraries."""
    backlog: int
    """Messages handed to it and not yet answered."""
    processed: int
    """Readings (odometry) or scans (topology) processed."""
    busy_s: float
    """Time spent on them, s of the wall clock."""
    restarts: int = 0
    """How often it has taken the place of one that died."""


@dataclass(frozen=True, slots=True)
class ProcessFailure:
    """A child ended although nobody asked it to."""

    name: ProcessName
    """Which one."""
    pid: int
    """Its number in the operating system."""
    reason: str
    """How it ended."""

    def __str__(self) -> str:
        """Return one sentence for a person."""
        return f"process {self.name} (pid {self.pid}) {self.reason}"


Request = (
    MapRequest
    | AreaRequest
    | CompareRequest
    | TrajectoryRequest
    | SaveRequest
    | RelocalizeRequest
    | AssertArcRequest
    | RetractArcRequest
)
"""What the topology process can be asked."""
Answer = GlobalMap | AreaDetails | Comparison | Trajectory | StatementEffect
"""What it can tell."""


@dataclass(frozen=True, slots=True)
class Wire:
    """One payload as it travels."""

    payload: bytes
    """A serialised message."""
    encoding: str
    """Which one it is."""


Encode = Callable[[Answer], Wire]
"""Serialises answers, in the topology process, which alone may work for long; picklable."""


@dataclass(frozen=True, slots=True)
class Asked:
    """A request on its way to the topology process."""

    number: int
    """Which one it is."""
    request: Request
    """What is asked."""
    deadline_s: float
    """Time of the monotonic clock, which all processes share, when nobody waits any more."""
    part_bytes: int | None
    """Largest part that the answer may be cut into; None if it must be whole."""


@dataclass(frozen=True, slots=True)
class Part:
    """A piece of a serialised answer: joined in order, the payloads of all parts are it."""

    number: int
    """Its place, from 0."""
    count: int
    """How many there are."""
    wire: Wire
    """Its bytes, with the encoding of the whole."""

    @property
    def is_last(self) -> bool:
        """Whether the answer is complete with it."""
        return self.number == self.count - 1


def parts_of(whole: Wire, part_bytes: int) -> Iterator[Part]:
    """Yield the parts of an answer, at least one.

    Args:
        whole: The answer.
        part_bytes: Largest size of one, > 0.
    """
    size = len(whole.payload)
    count = max(1, -(-size // part_bytes))
    for number in range(count):
        piece = whole.payload[number * part_bytes : (number + 1) * part_bytes]
        yield Part(number, count, Wire(piece, whole.encoding))


Result = Part | tuple[str, ...] | HmtError
"""What comes back: an answer part by part, the names of saved files, or why not."""


@dataclass(frozen=True, slots=True)
class Answered:
    """A result on its way back."""

    number: int
    """Of the request."""
    result: Result
    """The answer, or a part of it."""

    @property
    def is_last(self) -> bool:
        """Whether nothing more comes."""
        return not isinstance(self.result, Part) or self.result.is_last


class Keeper(Protocol):
    """Owner of a map file, in the topology process: picklable."""

    @property
    def path(self) -> Path:
        """The file."""

    @property
    def is_frozen(self) -> bool:
        """Whether it is only read."""

    def engine(
        self,
        config: Config,
        *,
        seed: int,
        budget: MemoryBudget | None,
        first_of_session: int | None,
    ) -> Engine:
        """Return an engine that goes on with the map in the file, or begins one."""

    def write(self, engine: Engine) -> None:
        """Write the map: the file holds either the one before or all of this one."""

    def close(self) -> None:
        """Leave the file at rest."""


Save = Callable[["Engine", RunReport, Path | None], tuple[str, ...]]
"""Writes the results, beside the map file that has just been written if there is one, and returns
the files' names; picklable, for the topology process runs it."""


def _rebuild_mapping(items: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(items)


# Events hold read-only views of dictionaries, which pickle refuses.
ForkingPickler.register(MappingProxyType, lambda mapping: (_rebuild_mapping, (dict(mapping),)))


def dump(message: object) -> bytes:
    """Return a message as bytes."""
    return bytes(ForkingPickler.dumps(message))


def load(data: bytes) -> Any:
    """Return the message in bytes that `dump` made: trusted, both ends are this program."""
    return pickle.loads(data)
