"""The key table: under which names a robot, its daemon and their clients meet on Zenoh.

| key | kind | content |
|---|---|---|
| `hmt/{site}/{robot}/in/{scan,odometry}` | put | input |
| `hmt/{site}/{robot}/{pose,posterior,event}` | publication | see `Topic` |
| `hmt/{site}/{robot}/ro/{name}` | query | read-only calls, see `Call` |
| `hmt/{site}/{robot}/@ctl/{name}` | query | calls that change state, see `Control` |
| `hmt/@live/{site}/{robot}` | liveliness | there while the daemon is |

`@` chunks match no wildcard, so that access control can grant `hmt/**` without granting control.

References:
    own; Zenoh's key expressions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum

from hmt_service.errors import InvalidInput

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where a daemon listens, and clients look for it, unless told otherwise."""

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")


class Input(StrEnum):
    """What a robot sends."""

    SCAN = "scan"
    ODOMETRY = "odometry"


class Topic(StrEnum):
    """What the daemon publishes."""

    POSE = "pose"
    POSTERIOR = "posterior"
    EVENT = "event"


class Call(StrEnum):
    """What the daemon can be asked."""

    STATUS = "status"
    POSE = "pose"
    POSTERIOR = "posterior"
    EVENTS = "events"
    HISTORY = "history"
    HYPOTHESES = "hypotheses"
    MAP = "map"
    AREAS = "areas"
    AREA = "area"
    TRAJECTORY = "trajectory"
    COMPARE = "compare"


class Control(StrEnum):
    """What the daemon can be told."""

    FINISH = "finish"
    SAVE = "save"
    RELOCALIZE = "relocalize"
    LOAD = "load"
    RESET = "reset"
    ASSERT_ARC = "assert_arc"
    RETRACT_ARC = "retract_arc"
    SHUTDOWN = "shutdown"


@dataclass(frozen=True, slots=True)
class Keys:
    """All keys of one robot."""

    site: str
    """Where the robot works: letters, digits, `_`, `.` and `-`."""
    robot: str
    """Which one it is: the same characters."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            InvalidInput: If a name is empty, too long, or has a character with a meaning to Zenoh.
        """
        for kind, name in (("site", self.site), ("robot", self.robot)):
            if not _NAME.fullmatch(name):
                raise InvalidInput(
                    f"{kind} {name!r} is not a name of 1 to 64 letters, digits, '_', '.' or '-'"
                )

    @property
    def inputs(self) -> str:
        """Key expression of everything that the robot sends."""
        return f"{self._base}/in/*"

    def input(self, name: Input) -> str:
        """Return the key that the robot sends this under."""
        return f"{self._base}/in/{name}"

    def topic(self, name: Topic) -> str:
        """Return the key that the daemon publishes this under."""
        return f"{self._base}/{name}"

    @property
    def calls(self) -> str:
        """Key expression of all read-only calls."""
        return f"{self._base}/ro/*"

    def call(self, name: Call) -> str:
        """Return the key of a read-only call."""
        return f"{self._base}/ro/{name}"

    @property
    def controls(self) -> str:
        """Key expression of all calls that change state."""
        return f"{self._base}/@ctl/*"

    def control(self, name: Control) -> str:
        """Return the key of a call that changes state."""
        return f"{self._base}/@ctl/{name}"

    @property
    def liveliness(self) -> str:
        """Key of the token that exists while the daemon does."""
        return f"hmt/@live/{self.site}/{self.robot}"

    @property
    def _base(self) -> str:
        return f"hmt/{self.site}/{self.robot}"
