"""Typed errors of the whole package; every message carries the numbers that explain it.

    HmtError
    +-- InvalidInput      an argument, message or reading that cannot be used
    |   +-- InvalidConfig a configuration that contradicts itself or has unknown keys
    |   +-- InvalidLog    a log file from which nothing can be read
    |   +-- Unauthenticated an endpoint that would let strangers in
    +-- NotFound          an area, hypothesis or file that does not exist
    +-- Unavailable       the answer does not exist yet, or nobody is there to give it
    |   +-- DeadlineExceeded the answer takes longer than anybody waits for it
    |   +-- AccessDenied  somebody is there, and does not let these credentials ask
    |   +-- Unreachable   a server of public logs that this machine has no way to
    +-- DaemonFailure     a process of the daemon died or did not start

References: own.
"""

from __future__ import annotations

BAD_INPUT = 2
"""Exit code of `hmt` after every `HmtError`, the same as of a wrong option; a bug crashes."""


class HmtError(Exception):
    """Base of everything that this package raises on purpose."""

    code = "INTERNAL"
    """Error code on the wire, a name of `hmt.v1.ErrorCode` without its prefix."""


class InvalidInput(HmtError):
    """An argument, message or reading cannot be used."""

    code = "INVALID_ARGUMENT"


class InvalidConfig(InvalidInput):
    """A configuration contradicts itself, is out of range or has unknown keys."""


class InvalidLog(InvalidInput):
    """Nothing can be read from a log file."""


class Unauthenticated(InvalidInput):
    """An endpoint would let others in from other machines without asking who they are."""


class NotFound(HmtError):
    """An area, hypothesis or file that was asked for does not exist."""

    code = "NOT_FOUND"


class Unavailable(HmtError):
    """The answer does not exist yet, or nobody is there to give it."""

    code = "UNAVAILABLE"


class DeadlineExceeded(Unavailable):
    """The answer takes longer than anybody waits for it."""

    code = "DEADLINE_EXCEEDED"


class AccessDenied(Unavailable):
    """Somebody is there to answer, and does not let these credentials ask."""


class Unreachable(Unavailable):
    """A server of public logs that this machine has no way to."""


class DaemonFailure(HmtError):
    """A process of the daemon died or did not start."""

    code = "INTERNAL"
