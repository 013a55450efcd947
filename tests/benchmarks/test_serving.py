"""The daemon of the benchmarks: its end is certain, and a bad start is told."""

from __future__ import annotations

from pathlib import Path

import psutil
import pytest

from benchmarks.serving import serving
from hmt_service.client import HmtClient
from hmt_service.errors import DaemonFailure, Unavailable

DEADLINE_S = 10.0


def processes_of_daemons() -> list[psutil.Process]:
    return [
        process
        for process in psutil.Process().children(recursive=True)
        if process.status() != psutil.STATUS_ZOMBIE and "hmt_service" in process.cmdline()
    ]


def test_the_daemon_takes_work_and_leaves_no_process_behind() -> None:
    with serving() as endpoint:
        (daemon,) = processes_of_daemons()
        family = [daemon, *daemon.children(recursive=True)]
        with HmtClient(endpoint) as client:
            assert client.status().processed_scans == 0
    assert len(family) > 1
    assert psutil.wait_procs(family, timeout=DEADLINE_S)[1] == []
    with pytest.raises(Unavailable), HmtClient(endpoint, timeout_s=1.0):
        pass


def test_a_daemon_that_does_not_start_is_an_error_with_its_last_words(tmp_path: Path) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text("no_such_section: {}\n")
    with pytest.raises(DaemonFailure, match="no_such_section"), serving("--config", str(settings)):
        pass
    assert processes_of_daemons() == []
