"""A daemon in processes of its own on this machine: for the demo, the benchmarks and the tests.

References: own.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from hmt_service.client.blocking import HmtClient
from hmt_service.errors import DaemonFailure, Unavailable
from hmt_service.service.reports import DaemonState

_START_S = 120.0
"""Long enough for a first start, which compiles what the odometry does."""
_STOP_S = 10.0
_POLL_S = 0.05


def free_endpoint() -> str:
    """Return a loopback endpoint that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def is_running(endpoint: str, zenoh_config: Path | None = None) -> bool:
    """Return whether a daemon there takes work: one that listens may still load its libraries.

    Args:
        endpoint: Where it listens.
        zenoh_config: File of Zenoh settings to be let in with.
    """
    try:
        with HmtClient(endpoint, zenoh_config=zenoh_config) as client:
            return client.status().state is DaemonState.RUNNING
    except Unavailable:
        return False


@contextmanager
def local_daemon(*options: str, output: IO[str] | None = None) -> Iterator[str]:
    """Run `hmt serve`, ready for work, on a loopback endpoint that is free; end it afterwards.

    Args:
        options: Further options of `hmt serve`.
        output: File that takes what it prints; None for where this program prints. (A pipe that
            nobody reads would stop the daemon once it is full.)

    Yields:
        The endpoint.

    Raises:
        DaemonFailure: If it ends or is not ready in time.
    """
    endpoint = free_endpoint()
    # What the caller's shell says about another daemon (HMT_SITE, HMT_ZENOH_CONFIG) is not for it.
    environment = {name: text for name, text in os.environ.items() if not name.startswith("HMT_")}
    command = [sys.executable, "-m", "hmt_service", "serve", "--listen", endpoint, *options]
    with subprocess.Popen(command, stdout=output, stderr=output, env=environment) as process:
        try:
            deadline_s = time.monotonic() + _START_S
            while not is_running(endpoint):
                if process.poll() is not None or time.monotonic() > deadline_s:
                    raise DaemonFailure(f"hmt serve is not ready at {endpoint} in {_START_S:g} s")
                time.sleep(_POLL_S)
            yield endpoint
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
