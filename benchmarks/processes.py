"""One program in a process of its own: what it costs, its memory over time, and always its end.

References: own.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from hmt_service.errors import HmtError

_PERIOD_S = 0.1
_LAST_LINES = 15


class ChildFailed(HmtError):
    """A program that a benchmark has started ended badly, or did not end in time."""


@dataclass(frozen=True, slots=True)
class MemorySample:
    """The memory of a process at one moment."""

    elapsed_s: float
    """Since its start."""
    rss_bytes: int
    """Resident memory."""


@dataclass(frozen=True, slots=True)
class ChildRun:
    """A program that has ended well."""

    duration_s: float
    """From its start to its end."""
    cpu_s: float
    """Processor time that it has taken: what it would last on a machine with nothing else to do."""
    output: str
    """Everything that it wrote to its standard output and error."""
    samples: tuple[MemorySample, ...]
    """Its memory from outside, a few times per second; empty if it was faster than that."""

    @property
    def peak_bytes(self) -> int:
        """Largest resident memory that was seen."""
        return max((sample.rss_bytes for sample in self.samples), default=0)


def run_child(
    command: Sequence[str | Path],
    *,
    timeout_s: float,
    period_s: float = _PERIOD_S,
    folder: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> ChildRun:
    """Run a program to its end; it gets no input, and never outlives this call.

    Args:
        command: The program and its arguments.
        timeout_s: It is killed after so long, with all processes that it has started.
        period_s: Time between two looks at its memory.
        folder: Working directory; None: that of this process.
        environment: Variables that it sees beside those of this process.

    Raises:
        ChildFailed: If it cannot be started, does not end in time or ends with an exit code other
            than 0; with the last lines that it wrote.
    """
    name = Path(command[0]).name
    cpu_before_s = _cpu_of_children_s()
    with tempfile.TemporaryFile("w+", errors="replace") as output:
        started_s = time.monotonic()
        try:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=folder,
                env={**os.environ, **(environment or {})},
                start_new_session=True,
            )
        except OSError as error:
            raise ChildFailed(f"{name} does not start: {error.strerror}") from error
        try:
            samples = _watch(process, started_s, timeout_s, period_s)
            duration_s = time.monotonic() - started_s
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        output.seek(0)
        text = output.read()
    if samples is None:
        raise ChildFailed(f"{name} was stopped after {timeout_s:g} s{_last_lines(text)}")
    if process.returncode:
        raise ChildFailed(f"{name} ended with code {process.returncode}{_last_lines(text)}")
    return ChildRun(duration_s, _cpu_of_children_s() - cpu_before_s, text, samples)


def _watch(
    process: subprocess.Popen[bytes], started_s: float, timeout_s: float, period_s: float
) -> tuple[MemorySample, ...] | None:
    """Return the memory of a process until it ends; None if it does not end in time."""
    child = psutil.Process(process.pid)
    samples: list[MemorySample] = []
    while (elapsed_s := time.monotonic() - started_s) < timeout_s:
        # A process that has ended and was not waited for yet has no memory.
        if rss_bytes := child.memory_info().rss:
            samples.append(MemorySample(elapsed_s, rss_bytes))
        try:
            process.wait(min(period_s, timeout_s - elapsed_s))
        except subprocess.TimeoutExpired:
            continue
        return tuple(samples)
    return None


def _cpu_of_children_s() -> float:
    """Return the processor time of all children that this process has waited for."""
    times = os.times()
    return times.children_user + times.children_system


def _last_lines(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()][-_LAST_LINES:]
    return "".join(f"\n  {line}" for line in lines) if lines else ", and wrote nothing"
