"""What is shipped for those who run the daemon: its command lines are ours, its promises hold."""

from __future__ import annotations

import json
import re
import shlex
from configparser import ConfigParser
from pathlib import Path

import pytest
import typer.main

from hmt_service.cli import control
from hmt_service.cli.app import app
from hmt_service.service import daemon
from hmt_service.service.session import client_endpoints, daemon_endpoints
from hmt_service.service.strangers import is_local

ROOT = Path(__file__).parents[1]
ZENOH_FILES = sorted((ROOT / "deploy" / "zenoh").glob("*/*.json5"))
STOP_S = 5.0
"""What the README promises."""


def parsed(command: list[str]) -> dict[str, object]:
    """Return the parameters of a command line of `hmt`, as it would run with them."""
    program, name, *options = command
    assert Path(program).name == "hmt"
    commands = typer.main.get_group(app).commands
    if name == "ctl":
        commands = typer.main.get_group(control.app).commands
        name, *options = options
    return commands[name].make_context(name, options).params


@pytest.fixture
def unit() -> ConfigParser:
    # Keys of systemd have a case, may be repeated, and use `%` for specifiers.
    unit = ConfigParser(strict=False, interpolation=None, delimiters="=")
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(ROOT / "deploy" / "systemd" / "hmt.service")
    return unit


def test_the_unit_starts_the_daemon_on_a_map_that_it_may_write(unit: ConfigParser) -> None:
    service = unit["Service"]
    parameters = parsed(shlex.split(service["ExecStart"]))
    assert parameters["map_file"] == Path("/var/lib") / service["StateDirectory"] / "site.hmt"
    assert parameters["log_format"] == "json"
    assert not parameters["allow_unauthenticated"]


def test_the_unit_waits_as_long_as_saving_takes_and_restarts_what_failed(
    unit: ConfigParser,
) -> None:
    service = unit["Service"]
    assert float(service["TimeoutStopSec"]) > STOP_S > daemon._SAVE_S + daemon._GRACE_S
    assert service["KillSignal"] == "SIGTERM"
    assert service["KillMode"] == "mixed"
    assert service["Restart"] == "on-failure"


def test_the_unit_gives_the_daemon_no_more_than_it_needs(unit: ConfigParser) -> None:
    service = unit["Service"]
    assert service["User"] not in ("", "root")
    assert service["ProtectSystem"] == "strict"
    assert service["CapabilityBoundingSet"] == ""
    for name in ("NoNewPrivileges", "ProtectHome", "PrivateTmp", "PrivateDevices"):
        assert service[name] == "yes"


def test_the_image_serves_loopback_and_checks_its_health() -> None:
    text = (ROOT / "Dockerfile").read_text()
    entry, command, check = (
        json.loads(found[1])
        for found in (
            re.search(pattern, text, re.MULTILINE)
            for pattern in (r"^ENTRYPOINT (.*)$", r"^CMD (.*)$", r"^HEALTHCHECK .* CMD (.*)$")
        )
        if found is not None
    )
    parameters = parsed([*entry, *command])
    assert not parameters["listen"]
    assert not parameters["allow_unauthenticated"]
    parsed(check)


@pytest.mark.parametrize("path", ZENOH_FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_zenoh_files_say_who_they_are_for_and_where_to_meet(path: Path) -> None:
    first, second, *_ = path.read_text().splitlines()
    assert first.startswith("// Of ")
    command = shlex.split(second.removeprefix("//"))
    assert parsed(command)["zenoh_config"] is not None
    if path.stem == "daemon":
        assert not any(map(is_local, daemon_endpoints(zenoh_config=path).listen))
    else:
        assert client_endpoints(zenoh_config=path).connect[0].startswith("tls/")


def test_every_readme_command_line_parses() -> None:
    text = (ROOT / "README.md").read_text().replace("\\\n", " ")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    commands = [
        shlex.split(line, comments=True)
        for block in blocks
        for line in block.splitlines()
        if line.startswith(("hmt serve", "hmt status", "hmt health"))
    ]
    assert len(commands) > 3
    for command in commands:
        parsed([word for word in command if word != "&"])
