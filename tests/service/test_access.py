"""Who may do what: gateways and daemons behind TLS, with the Zenoh files that are shipped.

Whatever somebody may not do, somebody else does here: a wall without a door would pass, too.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.client import HmtClient
from hmt_service.core.types import Event, EventKind
from hmt_service.errors import AccessDenied, Unavailable
from hmt_service.service.keys import Input, Keys, Topic
from hmt_service.service.session import client_endpoints, daemon_endpoints, open_session
from tests.flat import readings
from tests.service.credentials import (
    IMPOSTOR,
    ROLES,
    SHIPPED,
    Credentials,
    Kind,
    tls_endpoint,
)
from tests.service.harness import SAVED, NoMap, running_daemon, serving, wait_until

KEYS = Keys("site", "robot")
STATUS = "hmt/site/robot/ro/status"


@dataclass
class Guarded:
    """A gateway that asks everybody who they are, and everybody's credentials."""

    endpoint: str
    credentials: Credentials
    server: NoMap

    def client(self, name: str, *, robot: str = "robot", timeout_s: float = 10.0) -> HmtClient:
        return HmtClient(
            self.endpoint,
            robot=robot,
            timeout_s=timeout_s,
            zenoh_config=self.credentials.config(name),
        )

    def session(self, name: str, *, of: str | None = None) -> zenoh.Session:
        config = self.credentials.config(name, of=of)
        timeout_s = 3.0 if name == IMPOSTOR else 20.0
        return open_session(
            client_endpoints(self.endpoint, timeout_s=timeout_s, zenoh_config=config)
        )

    def received(self) -> int:
        with self.client("operator") as operator:
            return operator.status().input.received


@contextmanager
def guarded_gateway(credentials: Credentials, *, robot: str = "robot") -> Iterator[Guarded]:
    endpoint = tls_endpoint()
    endpoints = daemon_endpoints([endpoint], zenoh_config=credentials.config("daemon"))
    with serving(endpoints, robot=robot) as server:
        yield Guarded(endpoint, credentials, server)


@pytest.fixture(scope="module", params=Kind)
def guarded(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Guarded]:
    credentials = Credentials(tmp_path_factory.mktemp("guarded") / "etc", request.param)
    with guarded_gateway(credentials) as guarded:
        yield guarded


def alive(session: zenoh.Session) -> list[str]:
    """Return the keys of the daemons that somebody sees."""
    replies = session.liveliness().get("hmt/@live/**", timeout=2.0)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


# ------------------------------------------------------------------ reading


@pytest.mark.parametrize("name", ROLES)
def test_everybody_who_is_known_may_ask(guarded: Guarded, name: str) -> None:
    with guarded.client(name) as client:
        assert client.status().state == "running"


@pytest.mark.parametrize("name", ROLES)
def test_everybody_who_is_known_hears_what_is_published_and_who_lives(
    guarded: Guarded, name: str
) -> None:
    heard: list[str] = []
    with guarded.session(name) as session:
        assert alive(session) == [KEYS.liveliness]
        session.declare_subscriber(
            KEYS.topic(Topic.EVENT), lambda sample: heard.append(str(sample.key_expr))
        )
        # The subscription is known to the daemon when this later message has come back.
        assert list(session.get(STATUS))
        guarded.server.gateway.publish([Event(EventKind.LOST, 0.0, "nothing fits")])
        wait_until(lambda: heard == [KEYS.topic(Topic.EVENT)])


# ------------------------------------------------------------------ control


def test_the_operator_may_control(guarded: Guarded) -> None:
    before = guarded.server.shut_downs
    with guarded.client("operator") as operator:
        assert operator.save().files == operator.finish().files == SAVED
        operator.shut_down()
    assert guarded.server.shut_downs == before + 1


@pytest.mark.parametrize("name", ["viewer", "robot"])
@pytest.mark.parametrize("call", [HmtClient.finish, HmtClient.save, HmtClient.shut_down])
def test_nobody_else_may_control(
    guarded: Guarded, name: str, call: Callable[[HmtClient], object]
) -> None:
    before = guarded.server.shut_downs
    with guarded.client(name) as client:
        with pytest.raises(AccessDenied, match=r"daemon of site site, robot robot is at .*@ctl"):
            call(client)
        assert client.status().state == "running"
    assert guarded.server.shut_downs == before


@pytest.mark.parametrize(
    "expression", ["hmt/**", "hmt/*/*/*/save", "hmt/*/*/@ctl/*", "hmt/site/robot/@ctl/**"]
)
def test_wildcards_reach_no_control_either(guarded: Guarded, expression: str) -> None:
    with guarded.session("viewer") as session:
        assert not list(session.get(expression, timeout=2.0))
        # A wildcard within what a viewer may ask is answered.
        assert list(session.get("hmt/*/*/ro/status", timeout=2.0))


# ------------------------------------------------------------------ sending


def sent(guarded: Guarded, name: str, key: str) -> int:
    """Put one sample under a key, and return how many more the daemon has then."""
    before = guarded.received()
    with guarded.session(name) as session:
        session.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)
        # What was sent before a question has arrived before its answer.
        assert list(session.get(STATUS))
    return guarded.received() - before


@pytest.mark.parametrize("name", ["operator", "robot"])
def test_robot_and_operator_may_send(guarded: Guarded, name: str) -> None:
    assert sent(guarded, name, KEYS.input(Input.SCAN)) == 1
    with guarded.client(name) as client:
        assert client.publish(readings(1)[0]) > 0


def test_a_viewer_may_not_send(guarded: Guarded) -> None:
    assert sent(guarded, "viewer", KEYS.input(Input.SCAN)) == 0
    with guarded.client("viewer", timeout_s=0.5) as client, pytest.raises(AccessDenied):
        client.publish(readings(1)[0])


@pytest.mark.parametrize("expression", ["hmt/site/*/in/scan", "hmt/*/robot/in/scan", "hmt/**"])
def test_a_robot_may_not_send_to_several(guarded: Guarded, expression: str) -> None:
    is_its_own = expression == "hmt/*/robot/in/scan"
    assert sent(guarded, "robot", expression) == int(is_its_own)


def test_a_robot_may_not_send_as_another(tmp_path: Path) -> None:
    credentials = Credentials(tmp_path / "etc", Kind.CERTIFICATES)
    reading = readings(1)[0]
    with guarded_gateway(credentials, robot="other") as guarded:
        with guarded.client("robot", robot="other") as robot:
            # It sees who listens to the other, and what it says does not reach them.
            robot.publish(reading)
            assert robot.status().input.received == 0
        with guarded.client("operator", robot="other") as operator:
            operator.publish(reading)
            assert operator.status().input.received == 1


def test_nobody_speaks_for_the_daemon(guarded: Guarded) -> None:
    """Neither poses nor answers nor signs of life come from a client."""
    heard: list[bytes] = []
    keys = Keys("site", "made-up")
    with guarded.session("operator") as liar, guarded.session("viewer") as viewer:
        liar.declare_queryable(f"hmt/{keys.site}/{keys.robot}/ro/*", lambda _: None)
        liar.liveliness().declare_token(keys.liveliness)
        viewer.declare_subscriber(
            KEYS.topic(Topic.POSE), lambda sample: heard.append(sample.payload.to_bytes())
        )
        assert list(viewer.get(STATUS))
        liar.put(KEYS.topic(Topic.POSE), b"a lie")
        assert list(liar.get(STATUS))
        assert alive(viewer) == [KEYS.liveliness]
        assert not list(viewer.get(f"hmt/{keys.site}/{keys.robot}/ro/status", timeout=2.0))
        assert heard == []


# ------------------------------------------------------------------ who is not known


def test_who_is_known_and_has_no_role_gets_nothing(guarded: Guarded) -> None:
    with guarded.session("stranger", of="viewer") as session:
        assert not list(session.get(STATUS, timeout=2.0))
        assert alive(session) == []
        before = guarded.received()
        session.put(KEYS.input(Input.SCAN), b"")
        assert not list(session.get(STATUS, timeout=2.0))
    assert guarded.received() == before


def test_wrong_credentials_are_not_let_in(guarded: Guarded) -> None:
    with pytest.raises(Unavailable, match=guarded.endpoint):
        guarded.session(IMPOSTOR, of="operator")
    with guarded.session("operator"):
        pass


def test_without_credentials_nobody_is_let_in(guarded: Guarded) -> None:
    missing = "usrpwd" if guarded.credentials.kind is Kind.PASSWORDS else "connect_"
    config = guarded.credentials.config_without(missing)
    for zenoh_config in (config, None):
        with pytest.raises(Unavailable, match=guarded.endpoint):
            HmtClient(guarded.endpoint, timeout_s=1.0, zenoh_config=zenoh_config)


def test_a_client_does_not_talk_to_a_daemon_of_another_authority(
    guarded: Guarded, tmp_path: Path
) -> None:
    other = Credentials(tmp_path / "another", guarded.credentials.kind)
    with pytest.raises(Unavailable, match=guarded.endpoint):
        HmtClient(guarded.endpoint, timeout_s=1.0, zenoh_config=other.config("operator"))


# ------------------------------------------------------------------ around it


def test_commands_take_credentials(guarded: Guarded) -> None:
    where = ["--connect", guarded.endpoint, "--zenoh-config"]
    viewer, operator = (str(guarded.credentials.config(name)) for name in ("viewer", "operator"))
    for command in (["status", *where, viewer], ["ctl", "finish", *where, operator]):
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
    result = CliRunner().invoke(app, ["ctl", "finish", *where, viewer])
    assert isinstance(result.exception, AccessDenied)
    result = CliRunner().invoke(app, ["status", *where[:-1]], env={"HMT_ZENOH_CONFIG": viewer})
    assert result.exit_code == 0, result.output


def test_a_router_with_the_same_file_guards_the_daemons_behind_it(tmp_path: Path) -> None:
    credentials = Credentials(tmp_path / "etc", Kind.CERTIFICATES)
    endpoint = tls_endpoint()
    config = zenoh.Config.from_file(credentials.config("daemon"))
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    behind = daemon_endpoints(
        connect=[endpoint], zenoh_config=credentials.config("daemon-at-router")
    )
    with zenoh.open(config), serving(behind) as server:
        guarded = Guarded(endpoint, credentials, server)
        assert sent(guarded, "robot", KEYS.input(Input.SCAN)) == 1
        assert sent(guarded, "viewer", KEYS.input(Input.SCAN)) == 0
        with guarded.client("viewer") as viewer, pytest.raises(AccessDenied):
            viewer.shut_down()
        with guarded.client("operator") as operator:
            operator.publish(readings(1)[0])
            assert operator.finish().files == SAVED


def test_the_daemon_itself_is_guarded(tmp_path: Path) -> None:
    credentials = Credentials(tmp_path / "etc", Kind.CERTIFICATES)
    with running_daemon(
        tmp_path / "out",
        listen=tls_endpoint(),
        zenoh_config=credentials.config("viewer"),
        is_awaited=False,
        options=["--zenoh-config", str(credentials.config("daemon"))],
    ) as daemon:
        assert daemon.process.stdout is not None
        assert "serving" in daemon.process.stdout.readline()
        with daemon.client() as viewer:
            with pytest.raises(AccessDenied):
                viewer.shut_down()
            assert viewer.status().state != "stopping"
        operator = credentials.config("operator")
        with HmtClient(daemon.endpoint, zenoh_config=operator) as client:
            client.shut_down()
        assert "stopped by a client" in daemon.output()
    assert daemon.process.returncode == 0


def test_both_kinds_grant_the_same() -> None:
    granted = []
    for kind in Kind:
        config = zenoh.Config.from_file(SHIPPED / kind / "daemon.json5")
        control = json.loads(config.get_json("access_control"))
        subjects = [
            (s["id"], s["cert_common_names"] or s["usernames"]) for s in control.pop("subjects")
        ]
        granted.append((control, subjects))
    assert granted[0] == granted[1]
