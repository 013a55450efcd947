"""The one way in which benchmarks run a daemon: `hmt serve` in processes of its own.

References: own.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

from hmt_service.errors import DaemonFailure, Unavailable
from hmt_service.service.client import HmtClient
from hmt_service.service.reports import DaemonState

_START_S = 30.0
_STOP_S = 10.0
_POLL_S = 0.05


@contextmanager
def serving(*options: str) -> Iterator[str]:
    """Run `hmt serve`, ready for work, on a loopback endpoint that is free; end it afterwards.

    Args:
        options: Further options of `hmt serve`.

    Yields:
        The endpoint.

    Raises:
        DaemonFailure: If it ends or is not ready in time; with all that it has printed.
    """
    endpoint = _free_endpoint()
    command = [sys.executable, "-m", "hmt_service", "serve", "--listen", endpoint, *options]
    with (
        # A pipe that nobody reads would stop the daemon once it is full.
        tempfile.TemporaryFile("w+") as output,
        subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT) as process,
    ):
        try:
            if not _gets_ready(endpoint, process):
                output.seek(0)
                raise DaemonFailure(f"no daemon within {_START_S:g} s: {output.read().strip()}")
            yield endpoint
        finally:
            process.terminate()
            try:
                process.wait(_STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()


def _free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _gets_ready(endpoint: str, process: subprocess.Popen[bytes]) -> bool:
    """Wait for the daemon; return False when it has ended or takes too long."""
    deadline_s = time.monotonic() + _START_S
    while process.poll() is None and time.monotonic() < deadline_s:
        if _is_running(endpoint):
            return True
        time.sleep(_POLL_S)
    return False


def _is_running(endpoint: str) -> bool:
    try:
        with HmtClient(endpoint) as client:
            return client.status().state is DaemonState.RUNNING
    except Unavailable:
        return False
