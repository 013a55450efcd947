"""Children that allocate, fail, hang or do not exist."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from benchmarks.processes import ChildFailed, MemorySample, run_child

MB = 1_000_000
PATIENCE_S = 60.0


def python(code: str) -> list[str | Path]:
    return [sys.executable, "-c", code]


def wait_until(is_so: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not is_so():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


def is_running(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_memory_that_a_child_allocates_is_seen() -> None:
    # Hashing holds the memory long enough to be looked at.
    code = "import hashlib; hashlib.sha512(b'x' * {} * 1_000_000).digest()"
    small, large = (
        run_child(python(code.format(size)), timeout_s=PATIENCE_S, period_s=0.005)
        for size in (1, 150)
    )
    assert large.peak_bytes - small.peak_bytes == pytest.approx(149 * MB, rel=0.1)


def test_samples_are_in_the_order_of_time_and_within_the_run() -> None:
    run = run_child(python("sum(range(3_000_000))"), timeout_s=PATIENCE_S, period_s=0.005)
    times_s = [sample.elapsed_s for sample in run.samples]
    assert len(times_s) > 1
    assert times_s == sorted(times_s)
    assert 0.0 <= times_s[0] <= times_s[-1] <= run.duration_s


def test_the_peak_is_the_largest_sample() -> None:
    run = run_child(python(""), timeout_s=PATIENCE_S)
    assert run.peak_bytes == max((s.rss_bytes for s in run.samples), default=0)
    assert all(isinstance(sample, MemorySample) for sample in run.samples)


def test_processor_time_is_that_of_this_child_and_not_the_time_it_waits() -> None:
    code = "import time\nwhile time.process_time() < {}: pass\ntime.sleep({})"
    busy = run_child(python(code.format(0.6, 0.0)), timeout_s=PATIENCE_S)
    idle = run_child(python(code.format(0.0, 0.6)), timeout_s=PATIENCE_S)
    assert busy.cpu_s > 0.5  # counted in steps of 10 ms
    assert idle.duration_s >= 0.6
    assert idle.cpu_s < busy.cpu_s


def test_output_and_errors_of_a_child_are_kept_in_their_order() -> None:
    code = "import sys; print('one', flush=True); print('two', file=sys.stderr)"
    assert run_child(python(code), timeout_s=PATIENCE_S).output == "one\ntwo\n"


def test_a_child_gets_no_input() -> None:
    run = run_child(python("import sys; print(repr(sys.stdin.read()))"), timeout_s=PATIENCE_S)
    assert run.output == "''\n"


def test_a_child_sees_its_folder_and_variables(tmp_path: Path) -> None:
    code = "import os; print(os.getcwd(), os.environ['WORD'], 'PATH' in os.environ)"
    run = run_child(
        python(code), timeout_s=PATIENCE_S, folder=tmp_path, environment={"WORD": "here"}
    )
    assert run.output.split() == [str(tmp_path.resolve()), "here", "True"]


def test_a_child_that_fails_is_an_error_with_its_last_lines() -> None:
    code = "for i in range(100): print('line', i)\nraise SystemExit(7)"
    with pytest.raises(ChildFailed, match=r"python\S* ended with code 7\n  line 85\n") as caught:
        run_child(python(code), timeout_s=PATIENCE_S)
    assert str(caught.value).splitlines()[-1] == "  line 99"
    assert len(str(caught.value).splitlines()) == 16


def test_a_silent_failure_says_that_it_was_silent() -> None:
    with pytest.raises(ChildFailed, match=r"ended with code 1, and wrote nothing$"):
        run_child(python("raise SystemExit(1)"), timeout_s=PATIENCE_S)


def test_a_killed_child_is_an_error() -> None:
    with pytest.raises(ChildFailed, match="ended with code -9"):
        run_child(python("import os; os.kill(os.getpid(), 9)"), timeout_s=PATIENCE_S)


def test_a_child_that_hangs_is_stopped_with_all_that_it_has_started() -> None:
    command: list[str | Path] = ["sh", "-c", "sleep 1000 & echo $! $$; wait"]
    with pytest.raises(ChildFailed, match=r"sh was stopped after 0\.5 s") as caught:
        run_child(command, timeout_s=0.5)
    pids = re.findall(r"\d+", str(caught.value).splitlines()[-1])
    assert len(pids) == 2
    wait_until(lambda: not any(is_running(int(pid)) for pid in pids))


def test_a_program_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ChildFailed, match="no-such-program does not start: No such file"):
        run_child(["no-such-program"], timeout_s=PATIENCE_S)
