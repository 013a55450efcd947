from __future__ import annotations

import pytest
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.cli.query import NOT_RUNNING
from hmt_service.client.local import free_endpoint
from hmt_service.errors import Unavailable
from hmt_service.service.session import daemon_endpoints
from tests.service.harness import serving


@pytest.mark.parametrize(
    ("is_loaded", "state", "exit_code"), [(True, "running", 0), (False, "starting", NOT_RUNNING)]
)
def test_health_is_whether_the_daemon_takes_work(
    is_loaded: bool, state: str, exit_code: int
) -> None:
    endpoint = free_endpoint()
    with serving(daemon_endpoints([endpoint])) as server:
        server.is_loaded = is_loaded
        result = CliRunner().invoke(app, ["health", "--connect", endpoint])
    assert (result.stdout.strip(), result.exit_code) == (state, exit_code)


def test_a_daemon_that_stops_is_not_healthy() -> None:
    endpoint = free_endpoint()
    with serving(daemon_endpoints([endpoint])) as server:
        server.gateway.close_input()
        result = CliRunner().invoke(app, ["health", "--connect", endpoint])
    assert (result.stdout.strip(), result.exit_code) == ("stopping", NOT_RUNNING)


def test_nobody_is_not_healthy() -> None:
    result = CliRunner().invoke(app, ["health", "--connect", free_endpoint(), "--timeout", "0.5"])
    assert isinstance(result.exception, Unavailable)
