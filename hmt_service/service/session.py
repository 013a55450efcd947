"""Zenoh sessions as this program needs them: explicit endpoints, no surprises on the network.

References:
    Zenoh's DEFAULT_CONFIG.json5.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import zenoh

from hmt_service.errors import Unavailable


class Mode(StrEnum):
    """Part of a session in the network."""

    PEER = "peer"
    """Listens for others, keeps on trying to connect."""
    CLIENT = "client"
    """Connects to one endpoint, or fails."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Where a session meets others."""

    mode: Mode
    """Its part."""
    listen: Sequence[str] = ()
    """Endpoints to listen on, such as `tcp/0.0.0.0:7447`."""
    connect: Sequence[str] = ()
    """Endpoints to connect to, such as `tcp/127.0.0.1:7447`."""
    has_scouting: bool = False
    """Whether to look for others by multicast."""
    timeout_s: float = 3.0
    """How long a client tries to connect, wall clock."""

    def __str__(self) -> str:
        """Return the endpoints for a person."""
        named = [f"on {endpoint}" for endpoint in self.listen]
        named += [f"to {endpoint}" for endpoint in self.connect]
        return ", ".join(named) or "by multicast"


def open_session(endpoints: Endpoints) -> zenoh.Session:
    """Return an open session; the caller closes it.

    Raises:
        Unavailable: If an endpoint is malformed, taken, or nobody listens there.
    """
    settings: dict[str, object] = {
        "mode": endpoints.mode,
        "listen/endpoints": list(endpoints.listen),
        "connect/endpoints": list(endpoints.connect),
        "scouting/multicast/enabled": endpoints.has_scouting,
        "scouting/gossip/enabled": endpoints.has_scouting,
        # zenoh#2628: messages promoted to shared memory are lost when the receiving thread stalls.
        "transport/shared_memory/enabled": False,
    }
    if endpoints.mode == Mode.CLIENT:
        settings["connect/timeout_ms"] = int(endpoints.timeout_s * 1000)
    try:
        config = zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise Unavailable(f"no Zenoh session {endpoints}: {error}") from error
