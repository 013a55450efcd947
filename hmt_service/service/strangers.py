"""Who may come in: endpoints that other machines reach must ask everybody who they are.

Zenoh knows two ways to ask: for a certificate that the daemon's authority has signed (mutual TLS,
over `tls` and `quic`), and for the password of a known user (`usrpwd`, over every unicast link).
Neither is on unless a file of Zenoh settings says so.

References:
    own; Zenoh's manual, "TLS authentication" and "User-password authentication". What follows from
    them was tried on zenoh 1.10.2: an endpoint's own `#enable_mtls=` outweighs the file's, a
    dictionary without users lets anonymous sessions in, multicast links ask nobody.
"""

from __future__ import annotations

import ipaddress
import json
from collections.abc import Sequence
from pathlib import Path

import zenoh

from hmt_service.errors import NotFound, Unauthenticated

_LOCAL_PROTOCOLS = frozenset({"unixsock-stream", "unixpipe"})
_TLS_PROTOCOLS = frozenset({"tls", "quic"})
_ENABLE_MTLS = "enable_mtls"


def refuse_strangers(config: zenoh.Config, listen: Sequence[str], *, has_scouting: bool) -> None:
    """Check that nobody on another machine comes in without saying who it is.

    Args:
        config: All settings of the session.
        listen: Endpoints that it listens on.
        has_scouting: Whether it connects to whoever answers on the network.

    Raises:
        Unauthenticated: If somebody could.
        NotFound: If the dictionary of users cannot be read.
    """
    certificates = json.loads(config.get_json(f"transport/link/tls/{_ENABLE_MTLS}")) is True
    users = _has_users(config)
    for endpoint in listen:
        if not (is_local(endpoint) or _asks(endpoint, certificates=certificates, users=users)):
            raise Unauthenticated(_refusal(endpoint))
    if has_scouting:
        # Sessions that it opens itself are never asked for a password, and not all are TLS.
        raise Unauthenticated(
            "--scouting connects to whoever answers on the network, and these could read the map, "
            "send scans and shut the daemon down: name who to meet by --connect, or say "
            "--allow-unauthenticated"
        )


def is_local(endpoint: str) -> bool:
    """Return whether only this machine reaches an endpoint: a loopback address or a local socket.

    Names other than `localhost` are not local: what they resolve to is decided elsewhere.
    """
    protocol, address, _ = _parts(endpoint)
    if protocol in _LOCAL_PROTOCOLS:
        return True
    ip = _ip(address)
    if ip is None:
        return _host(address) == "localhost"
    mapped = ip.ipv4_mapped if isinstance(ip, ipaddress.IPv6Address) else None
    return (mapped or ip).is_loopback


def _asks(endpoint: str, *, certificates: bool, users: bool) -> bool:
    protocol, address, settings = _parts(endpoint)
    ip = _ip(address)
    if ip is not None and ip.is_multicast:
        return False
    own = [value for name, value in settings if name == _ENABLE_MTLS]
    has_certificates = all(value == "true" for value in own) if own else certificates
    return users or (protocol in _TLS_PROTOCOLS and has_certificates)


def _host(address: str) -> str:
    return address.rpartition(":")[0].strip("[]")


def _ip(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return the number in an address; None where it is a name."""
    try:
        return ipaddress.ip_address(_host(address))
    except ValueError:
        return None


def _parts(endpoint: str) -> tuple[str, str, list[tuple[str, str]]]:
    """Return protocol, address and settings of `protocol/address?metadata#name=value;...`."""
    locator, _, text = endpoint.partition("#")
    protocol, _, rest = locator.partition("/")
    pairs = (pair.partition("=") for pair in text.split(";") if pair)
    return protocol, rest.partition("?")[0], [(name, value) for name, _, value in pairs]


def _has_users(config: zenoh.Config) -> bool:
    path = json.loads(config.get_json("transport/auth/usrpwd/dictionary_file"))
    if path is None:
        return False
    try:
        return bool(Path(path).read_text().strip())
    except OSError as error:
        raise NotFound(f"users {path}: {error.strerror}") from error


def _refusal(endpoint: str) -> str:
    return (
        f"{endpoint} can be reached from other machines, and whoever reaches it could read the "
        "map, send scans and shut the daemon down: name a --zenoh-config that asks for "
        "certificates (tls or quic, enable_mtls) or passwords (usrpwd, with users), listen on "
        "127.0.0.1, or say --allow-unauthenticated"
    )
