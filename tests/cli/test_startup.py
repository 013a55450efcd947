"""What everybody waits for before a command does anything: its start, its help, its completion."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hmt_service.__main__ import _NEXT, next_step
from hmt_service.errors import HmtError, InvalidLog, NotFound, Unavailable

SLOW = ("numpy", "pydantic", "gtsam", "numba", "scipy", "zenoh", "matplotlib", "open3d", "rosbags")
BIN = Path(sys.executable).parent
SHELLS = ("bash", "zsh", "fish")


def test_the_command_line_is_known_without_what_takes_long_to_load() -> None:
    program = (
        "import sys; import hmt_service.__main__; "
        f"print([name for name in {SLOW} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    assert done.stdout.strip() == b"[]"


def completed(line: str) -> list[str]:
    """Return what bash offers for the last word of a line, the script being that of `hmt`."""
    words = line.split(" ")
    asked = " ".join(word or "''" for word in words)
    script = (
        'eval "$(_HMT_COMPLETE=source_bash hmt)"; '
        f"COMP_WORDS=({asked}); COMP_CWORD={len(words) - 1}; "
        f"$(complete -p hmt | sed 's/.*-F \\([^ ]*\\).*/\\1/') hmt; "
        "printf '%s\\n' \"${COMPREPLY[@]}\""
    )
    environment = os.environ | {"PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-c", script], capture_output=True, text=True, env=environment, check=True
    )
    return done.stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("hmt do", ["doctor"]),
        ("hmt ctl re", ["relocalize", "reset", "retract-arc"]),
        ("hmt run --pre", ["--preset"]),
        ("hmt run --preset 3", ["3d-indoor", "3d-outdoor"]),
        ("hmt map --method ", ["consistent", "shortest_path"]),
    ],
)
def test_bash_completes_commands_options_and_values(line: str, offered: list[str]) -> None:
    assert sorted(completed(line)) == offered


@pytest.mark.parametrize("shell", SHELLS)
def test_each_shell_gets_a_script_that_it_can_read(shell: str) -> None:
    done = subprocess.run(
        [BIN / "hmt"],
        capture_output=True,
        env=os.environ | {"_HMT_COMPLETE": f"source_{shell}"},
        check=True,
    )
    assert b"_HMT_COMPLETE=complete_" + shell.encode() in done.stdout
    if shutil.which(shell) is not None:
        subprocess.run([shell, "-n"], input=done.stdout, check=True)


def test_an_error_tells_the_next_step_of_the_nearest_kind_that_has_one() -> None:
    assert next_step(InvalidLog("")) == _NEXT[InvalidLog]
    assert next_step(Unavailable("")) == _NEXT[Unavailable]
    assert next_step(NotFound("")) == next_step(HmtError("")) == ""


def test_an_error_is_one_line_and_its_next_step_another() -> None:
    done = subprocess.run(
        [BIN / "hmt", "status", "--connect", "tcp/127.0.0.1:1", "--timeout", "0.5"],
        capture_output=True,
        text=True,
        check=False,
    )
    error, step = done.stderr.splitlines()
    assert done.returncode == 2
    assert error.startswith("error: no Zenoh session to tcp/127.0.0.1:1: ")
    assert ".rs" not in error
    assert step == f"next: {_NEXT[Unavailable]}"
