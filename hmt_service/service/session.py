"""Zenoh sessions as this program needs them: explicit endpoints, no surprises on the network.

Certificates, passwords and access control are Zenoh's own settings, in a file of its own format.
What such a file says about endpoints holds unless the caller names others; how the session meets
others (mode, scouting, time to connect) and shared memory are settled here.

References:
    Zenoh's DEFAULT_CONFIG.json5.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import zenoh

from hmt_service.errors import InvalidConfig, NotFound, Unavailable
from hmt_service.service.keys import DEFAULT_ENDPOINT
from hmt_service.service.strangers import refuse_strangers

_SOURCE_LINE = re.compile(r" at \S+\.rs:\d+\.?")
"""Where in Zenoh's own code something was noticed."""


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
    """Endpoints to listen on, such as `tcp/127.0.0.1:7447`."""
    connect: Sequence[str] = ()
    """Endpoints to connect to, such as `tcp/127.0.0.1:7447`."""
    has_scouting: bool = False
    """Whether to look for others by multicast."""
    timeout_s: float = 3.0
    """How long a client tries to connect, wall clock."""
    zenoh_config: Path | None = None
    """File of Zenoh settings, JSON5 or YAML: certificates, passwords, access control."""
    allows_strangers: bool = False
    """Whether others may come in from other machines without saying who they are."""

    def __str__(self) -> str:
        """Return the endpoints for a person."""
        named = [f"on {endpoint}" for endpoint in self.listen]
        named += [f"to {endpoint}" for endpoint in self.connect]
        return ", ".join(named) or "by multicast"


def daemon_endpoints(
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    *,
    has_scouting: bool = False,
    zenoh_config: Path | None = None,
    allows_strangers: bool = False,
) -> Endpoints:
    """Return where a daemon meets others: as told, else as its file says, else on loopback.

    Raises:
        NotFound: If there is no such file.
        InvalidConfig: If Zenoh refuses it.
    """
    config = _read(zenoh_config)
    listen = listen or _endpoints_in(config, "listen", Mode.PEER)
    connect = connect or _endpoints_in(config, "connect", Mode.PEER)
    if not listen and not connect:
        listen = (DEFAULT_ENDPOINT,)
    return Endpoints(
        # A router passes nothing between peers that cannot find each other: be its client.
        mode=Mode.PEER if listen else Mode.CLIENT,
        listen=tuple(listen),
        connect=tuple(connect),
        has_scouting=has_scouting,
        zenoh_config=zenoh_config,
        allows_strangers=allows_strangers,
    )


def client_endpoints(
    endpoint: str | None = None, *, timeout_s: float = 3.0, zenoh_config: Path | None = None
) -> Endpoints:
    """Return where a client finds its daemon: as told, else as its file says, else on loopback.

    Raises:
        NotFound: If there is no such file.
        InvalidConfig: If Zenoh refuses it.
    """
    in_file = _endpoints_in(_read(zenoh_config), "connect", Mode.CLIENT)
    connect = (endpoint,) if endpoint else in_file or (DEFAULT_ENDPOINT,)
    return Endpoints(
        mode=Mode.CLIENT, connect=connect, timeout_s=timeout_s, zenoh_config=zenoh_config
    )


def open_session(endpoints: Endpoints) -> zenoh.Session:
    """Return an open session; the caller closes it.

    Raises:
        Unavailable: If an endpoint is malformed, taken, or nobody lets this session in there.
        Unauthenticated: If it would let others in without asking who they are.
        NotFound: If there is no such file of Zenoh settings.
        InvalidConfig: If Zenoh refuses it.
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
    config = _read(endpoints.zenoh_config)
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        if not endpoints.allows_strangers:
            refuse_strangers(config, endpoints.listen, has_scouting=endpoints.has_scouting)
        return zenoh.open(config)
    except zenoh.ZError as error:
        reason = _SOURCE_LINE.sub("", str(error))
        raise Unavailable(f"no Zenoh session {endpoints}: {reason}") from error


def _read(path: Path | None) -> zenoh.Config:
    if path is None:
        return zenoh.Config()
    # Zenoh's own message would not name the file.
    if not path.is_file():
        raise NotFound(f"Zenoh configuration {path} does not exist")
    try:
        return zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise InvalidConfig(f"Zenoh configuration {path}: {error}") from error


def _endpoints_in(config: zenoh.Config, part: str, mode: Mode) -> tuple[str, ...]:
    """Return what a file says about endpoints for one mode; nothing where it leaves the default."""
    key = f"{part}/endpoints"
    found = config.get_json(key)
    if found == zenoh.Config().get_json(key):
        return ()
    value = json.loads(found)
    return tuple(value.get(mode, ()) if isinstance(value, dict) else value)
