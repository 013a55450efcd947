"""What `hmt doctor` says of this machine, and of machines that are not well."""

from __future__ import annotations

import json
import time
from importlib import metadata
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hmt_service import __version__
from hmt_service.cli.app import app
from hmt_service.cli.doctor import UNSOUND
from hmt_service.client import diagnosis
from hmt_service.client.diagnosis import Finding, Verdict
from hmt_service.client.local import free_endpoint
from hmt_service.service.session import daemon_endpoints
from tests.service.harness import serving

CHECKS = [
    "python",
    "libraries",
    "cores",
    "threads",
    "memory",
    "temporary files",
    "compiled code",
    "clock",
    "zenoh",
    "daemon",
]


def examined(*options: str) -> tuple[int, dict[str, dict[str, str]]]:
    """Return exit code and findings of `hmt doctor --json`, by check."""
    result = CliRunner().invoke(app, ["doctor", "--json", *options])
    told = json.loads(result.stdout)
    assert told["is_healthy"] is (result.exit_code == 0)
    return result.exit_code, {finding["check"]: finding for finding in told["findings"]}


def test_without_a_daemon_this_machine_is_well_and_the_next_step_is_to_start_one() -> None:
    exit_code, found = examined("--site", "nobodys-site")
    assert [*found] == CHECKS
    assert {name for name, finding in found.items() if finding["verdict"] == "fail"} == set()
    assert exit_code == 0
    assert found["daemon"]["verdict"] == "warn"
    assert "hmt serve" in found["daemon"]["next_step"]
    assert "answered in" in found["zenoh"]["found"]


def test_a_daemon_that_answers_is_found_with_its_clock() -> None:
    endpoint = free_endpoint()
    with serving(daemon_endpoints([endpoint])):
        exit_code, found = examined("--connect", endpoint)
    assert exit_code == 0
    assert f"running, hmt {__version__}" in found["daemon"]["found"]
    assert found["daemon's clock"]["verdict"] == "ok"


def test_a_daemon_that_was_named_and_does_not_answer_is_a_failure() -> None:
    exit_code, found = examined("--connect", free_endpoint())
    assert exit_code == UNSOUND
    assert found["daemon"]["verdict"] == "fail"


def test_for_people_every_finding_is_a_line() -> None:
    lines = CliRunner().invoke(app, ["doctor", "--site", "nobodys-site"]).stdout.splitlines()
    heads = [line for line in lines if not line.startswith("      next: ")]
    assert [line[5:].partition(":")[0] for line in heads] == CHECKS


def test_libraries_that_are_missing_or_too_old_are_named_with_their_repair() -> None:
    numpy = metadata.version("numpy")
    requirements = ["numpy>=1000", "no-such-library>=2", "typer>=0.1", 'rerun-sdk; extra == "view"']
    old, missing, sound = diagnosis.library_versions(requirements)
    assert old == Finding(
        "library", Verdict.FAIL, f"numpy {numpy}: needs >=1000", "pip install 'numpy>=1000'"
    )
    assert missing.verdict is Verdict.FAIL
    assert missing.next_step == "pip install 'no-such-library>=2'"
    assert sound.found == f"typer {metadata.version('typer')}"


def test_what_the_package_declares_is_installed_here() -> None:
    (finding,) = diagnosis.library_versions(metadata.requires(diagnosis.PACKAGE) or ())
    assert finding.verdict is Verdict.OK


def test_another_python_is_refused() -> None:
    assert diagnosis.python_version(">=99").verdict is Verdict.FAIL
    assert diagnosis.python_version(">=3.11").verdict is Verdict.OK


@pytest.mark.parametrize(
    ("environment", "verdict"),
    [
        ({}, Verdict.OK),
        ({"OMP_NUM_THREADS": "1"}, Verdict.OK),
        ({"OMP_NUM_THREADS": "100000"}, Verdict.WARN),
        ({"NUMBA_NUM_THREADS": "all"}, Verdict.FAIL),
        ({"MKL_NUM_THREADS": "0"}, Verdict.FAIL),
    ],
)
def test_thread_variables(environment: dict[str, str], verdict: Verdict) -> None:
    finding = diagnosis.threads(environment)
    assert finding.verdict is verdict
    assert all(f"{name}={text}" in finding.found for name, text in environment.items())


def test_temporary_files_need_a_folder_that_can_be_written(tmp_path: Path) -> None:
    gone = diagnosis.disk(tmp_path / "gone")
    assert gone.verdict is Verdict.FAIL
    assert "TMPDIR" in gone.next_step
    assert diagnosis.disk(tmp_path).verdict is not Verdict.FAIL


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="there is no /dev/shm here")
def test_temporary_files_in_memory_are_no_disk() -> None:
    finding = diagnosis.disk(Path("/dev/shm"))
    assert (finding.verdict, "tmpfs" in finding.found) == (Verdict.WARN, True)


@pytest.mark.parametrize(
    ("offset_s", "round_trip_s", "verdict"),
    [(0.0, 0.01, Verdict.OK), (-3600.0, 0.01, Verdict.WARN), (2.0, 5.0, Verdict.OK)],
)
def test_the_clock_of_a_daemon_is_judged_within_the_round_trip(
    offset_s: float, round_trip_s: float, verdict: Verdict
) -> None:
    asked_s = time.time()
    answered_s = asked_s + round_trip_s
    clock_s = asked_s + round_trip_s / 2.0 + offset_s
    finding = diagnosis.clock_offset(clock_s, asked_s, answered_s)
    assert finding.verdict is verdict
    assert f"{1e3 * offset_s:+.1f} ms" in finding.found


def test_a_daemon_that_does_not_tell_its_clock_is_no_failure() -> None:
    assert diagnosis.clock_offset(0.0, 1.0, 2.0).verdict is Verdict.OK
