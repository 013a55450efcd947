"""What a daemon refuses to listen on before anybody has connected."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.client.local import free_endpoint
from hmt_service.errors import InvalidConfig, NotFound, Unauthenticated, Unavailable
from hmt_service.service.keys import DEFAULT_ENDPOINT
from hmt_service.service.session import (
    Mode,
    client_endpoints,
    daemon_endpoints,
    open_session,
)
from hmt_service.service.strangers import is_local, refuse_strangers

LOCAL = [
    "tcp/127.0.0.1:7447",
    "tcp/127.8.9.10:0",
    "tcp/localhost:7447",
    "tcp/[::1]:7447",
    "tcp/[::ffff:127.0.0.1]:7447",
    "udp/127.0.0.1:7447?rel=1",
    "tls/127.0.0.1:7447#enable_mtls=false",
    "unixsock-stream//run/hmt/zenoh.sock",
]
REACHABLE = [
    "tcp/0.0.0.0:7447",
    "tcp/[::]:7447",
    "tcp/[::ffff:0.0.0.0]:7447",
    "tcp/192.168.1.5:7447",
    "tcp/daemon.example:7447",
    "tcp/localhost.example:7447",
    "tcp/*:7447",
    "udp/0.0.0.0:7447",
    "ws/0.0.0.0:7447",
    "tls/0.0.0.0:7447",
    "quic/0.0.0.0:7447",
    "serial//dev/ttyUSB0#baudrate=115200",
    "vsock/2:7447",
]


def config_of(*, mtls: bool | None = None, users: Path | None = None) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("transport/link/tls/enable_mtls", json.dumps(mtls))
    if users is not None:
        config.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(users)))
    return config


def is_refused(endpoint: str, config: zenoh.Config) -> bool:
    try:
        refuse_strangers(config, ["tcp/127.0.0.1:1", endpoint], has_scouting=False)
    except Unauthenticated as error:
        return endpoint in str(error) and "--allow-unauthenticated" in str(error)
    return False


@pytest.fixture
def users(tmp_path: Path) -> Path:
    path = tmp_path / "users.txt"
    path.write_text("viewer:secret\n")
    return path


@pytest.mark.parametrize("endpoint", LOCAL)
def test_what_only_this_machine_reaches_needs_no_credentials(endpoint: str) -> None:
    assert is_local(endpoint)
    assert not is_refused(endpoint, config_of())


@pytest.mark.parametrize("endpoint", REACHABLE)
def test_what_others_reach_is_refused_unless_they_are_asked_who_they_are(
    endpoint: str, users: Path
) -> None:
    assert not is_local(endpoint)
    assert is_refused(endpoint, config_of())
    assert is_refused(endpoint, config_of(mtls=False))
    assert not is_refused(endpoint, config_of(users=users))


@pytest.mark.parametrize("endpoint", REACHABLE)
def test_client_certificates_ask_on_tls_alone(endpoint: str) -> None:
    is_tls = endpoint.startswith(("tls/", "quic/"))
    assert is_refused(endpoint, config_of(mtls=True)) is not is_tls


@pytest.mark.parametrize(
    ("own", "is_asked"),
    [
        ("#enable_mtls=true", True),
        ("#enable_mtls=false", False),
        ("?rel=1#enable_mtls=false", False),
        ("#listen_certificate=a.pem;enable_mtls=false", False),
        ("#enable_mtls=true;enable_mtls=false", False),
        ("#listen_certificate=a.pem", None),
    ],
)
def test_what_an_endpoint_says_of_itself_outweighs_the_file(
    own: str, is_asked: bool | None
) -> None:
    for in_file in (True, False):
        expected = in_file if is_asked is None else is_asked
        refused = is_refused(f"tls/0.0.0.0:7447{own}", config_of(mtls=in_file))
        assert refused is not expected


@pytest.mark.parametrize("text", ["", "\n \n"])
def test_a_dictionary_without_users_asks_nobody(tmp_path: Path, text: str) -> None:
    empty = tmp_path / "users.txt"
    empty.write_text(text)
    assert is_refused("tcp/0.0.0.0:7447", config_of(users=empty))


def test_an_anonymous_client_comes_in_where_a_dictionary_has_no_users(tmp_path: Path) -> None:
    """Were it not so, the rule above would be too strict."""
    (tmp_path / "users.txt").write_text("\n")
    file = tmp_path / "zenoh.json5"
    dictionary = json.dumps(str(tmp_path / "users.txt"))
    file.write_text(f"{{transport: {{auth: {{usrpwd: {{dictionary_file: {dictionary}}}}}}}}}")
    endpoint = free_endpoint()
    with (
        open_session(daemon_endpoints([endpoint], zenoh_config=file)),
        open_session(client_endpoints(endpoint)),
    ):
        pass


def test_a_dictionary_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"missing\.txt"):
        is_refused("tcp/0.0.0.0:7447", config_of(users=tmp_path / "missing.txt"))


@pytest.mark.parametrize("endpoint", ["udp/224.0.0.224:7447", "udp/[ff02::1]:7447"])
def test_multicast_asks_nobody_whatever_the_file_says(endpoint: str, users: Path) -> None:
    assert is_refused(endpoint, config_of(mtls=True, users=users))


def test_scouting_asks_nobody(users: Path) -> None:
    with pytest.raises(Unauthenticated, match="--scouting"):
        refuse_strangers(config_of(mtls=True, users=users), [], has_scouting=True)


def test_the_daemon_does_not_start_where_strangers_could_come_in() -> None:
    result = CliRunner().invoke(app, ["serve", "--listen", "tcp/0.0.0.0:0"])
    assert isinstance(result.exception, Unauthenticated)


def test_strangers_are_let_in_when_that_is_said() -> None:
    """Refused before a socket is opened, and refused no more."""
    taken = free_endpoint().replace("127.0.0.1", "no.such.host.invalid")
    for allows_strangers, error in ((False, Unauthenticated), (True, Unavailable)):
        with pytest.raises(error):
            open_session(daemon_endpoints([taken], allows_strangers=allows_strangers))


# ------------------------------------------------------------------ files of Zenoh settings


def test_endpoints_are_as_told_else_as_the_file_says_else_on_loopback(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.yaml"
    file.write_text("listen: {endpoints: [tcp/127.0.0.1:1]}\nconnect: {endpoints: [tcp/a:2]}\n")
    assert daemon_endpoints(zenoh_config=file).listen == ("tcp/127.0.0.1:1",)
    assert daemon_endpoints(zenoh_config=file).connect == ("tcp/a:2",)
    assert daemon_endpoints(["tcp/b:3"], ["tcp/c:4"], zenoh_config=file).listen == ("tcp/b:3",)
    assert daemon_endpoints(["tcp/b:3"], ["tcp/c:4"], zenoh_config=file).connect == ("tcp/c:4",)
    assert client_endpoints(zenoh_config=file).connect == ("tcp/a:2",)
    assert client_endpoints("tcp/d:5", zenoh_config=file).connect == ("tcp/d:5",)
    file.write_text("{}")
    for config in (file, None):
        assert daemon_endpoints(zenoh_config=config).listen == (DEFAULT_ENDPOINT,)
        assert client_endpoints(zenoh_config=config).connect == (DEFAULT_ENDPOINT,)
    connecting = daemon_endpoints(connect=["tcp/a:2"])
    assert (connecting.mode, connecting.listen) == (Mode.CLIENT, ())


def test_endpoints_in_a_file_may_differ_by_mode(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{listen: {endpoints: {peer: ['tcp/a:1'], router: ['tcp/b:2']}}}")
    assert daemon_endpoints(zenoh_config=file).listen == ("tcp/a:1",)


def test_endpoints_in_a_file_are_guarded_too(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{listen: {endpoints: ['tcp/0.0.0.0:0']}}")
    with pytest.raises(Unauthenticated, match=r"tcp/0\.0\.0\.0:0"):
        open_session(daemon_endpoints(zenoh_config=file))


@pytest.mark.parametrize("text", ["{ lissten: {} }", "{ mode: "])
def test_a_file_that_zenoh_refuses_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(text)
    with pytest.raises(InvalidConfig, match=r"zenoh\.json5"):
        client_endpoints(zenoh_config=file)
    with pytest.raises(NotFound, match=r"other\.json5"):
        client_endpoints(zenoh_config=tmp_path / "other.json5")
