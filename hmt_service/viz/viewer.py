"""Rerun's own program: a window, or a page for browsers, that shows what is sent to it.

It listens on this machine only: its own Python interface would open the map to the whole network.

References:
    `rerun --help`.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO
from urllib.parse import quote

from hmt_service.errors import Unavailable

_HOST = "127.0.0.1"
_START_S = 30.0
_POLL_S = 0.05
_MOST_SAID = 400


class Viewer:
    """A running viewer."""

    def __init__(self, process: subprocess.Popen[bytes], ports: tuple[int, ...]) -> None:
        """Take a viewer that listens.

        Args:
            process: Its process.
            ports: Where it takes what is drawn, and where it serves its page, if it does.
        """
        self._process = process
        self._ports = ports

    @property
    def sink(self) -> str:
        """Where what is drawn is sent to."""
        return f"rerun+http://{_HOST}:{self._ports[0]}/proxy"

    @property
    def page(self) -> str:
        """Address for a browser."""
        return f"http://{_HOST}:{self._ports[-1]}/?url={quote(self.sink, safe='')}"

    @property
    def is_open(self) -> bool:
        """Whether nobody has closed it."""
        return self._process.poll() is None


@contextmanager
def window() -> Iterator[Viewer]:
    """Open a window; it is closed at the end.

    Raises:
        Unavailable: If it does not open.
    """
    with socket.socket() as probe:
        probe.bind((_HOST, 0))
        port = probe.getsockname()[1]
    with _running(["--expect-data-soon"], (port,)) as viewer:
        yield viewer


@contextmanager
def page(port: int) -> Iterator[Viewer]:
    """Serve a page for browsers on this machine until the end.

    Args:
        port: Of the page; what is drawn goes through the next one.

    Raises:
        Unavailable: If the ports are not free, or it does not start.
    """
    ports = (port + 1, port)
    for each in ports:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((_HOST, each))
            except OSError as error:
                raise Unavailable(f"port {each} of {_HOST}: {error.strerror}") from error
    with _running(["--serve-web", "--web-viewer-port", str(port)], ports) as viewer:
        yield viewer


@contextmanager
def _running(options: list[str], ports: tuple[int, ...]) -> Iterator[Viewer]:
    command = [sys.executable, "-m", "rerun", "--bind", _HOST, "--port", str(ports[0])]
    with (
        tempfile.TemporaryFile() as said,
        # Its launcher waits for the program itself: both end as one group.
        subprocess.Popen(
            [*command, *options],
            stdout=said,
            stderr=subprocess.STDOUT,
            env={name: text for name, text in os.environ.items() if name != "RUST_LOG"},
            start_new_session=True,
        ) as process,
    ):
        try:
            _wait_for(process, ports, said)
            yield Viewer(process, ports)
            if process.poll():
                raise _failure(f"has ended with code {process.returncode}", said)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGTERM)


def _wait_for(process: subprocess.Popen[bytes], ports: tuple[int, ...], said: IO[bytes]) -> None:
    deadline_s = time.monotonic() + _START_S
    for port in ports:
        while not _listens(port):
            if process.poll() is not None or time.monotonic() > deadline_s:
                raise _failure("does not start", said)
            time.sleep(_POLL_S)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((_HOST, port)) == 0


def _failure(what: str, said: IO[bytes]) -> Unavailable:
    # Without a screen it may end before it listens, or after.
    said.seek(0)
    text = said.read().decode(errors="replace").strip()[-_MOST_SAID:] or "it says nothing"
    return Unavailable(f"the viewer {what} (--web and --save need no screen): {text}")
