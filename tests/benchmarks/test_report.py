"""Units of work: done once, kept, and used again only while the code is the same."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from benchmarks.cells import Cells, Result, code_fingerprint
from benchmarks.report import Run


def run_in(folder: Path, *, is_resumed: bool, fingerprint: str = "a", said: list[str]) -> Run:
    cells = Cells(folder / "cells", fingerprint, is_resumed)
    return Run(is_quick=True, say=said.append, out=folder, cells=cells)


def counted(calls: list[int], value: int) -> Callable[[], Result]:
    def compute() -> Result:
        calls.append(value)
        return {"value": value}

    return compute


def square(value: int) -> Result:
    return {"value": value * value}


def fail() -> Result:
    raise ValueError("this unit is broken")


def test_a_resumed_run_does_only_what_is_left(tmp_path: Path) -> None:
    calls: list[int] = []
    first = run_in(tmp_path, is_resumed=False, said=[])
    assert first.once("maps/one", counted(calls, 1)) == {"value": 1}
    units = {"maps/one": counted(calls, 10), "maps/two": counted(calls, 2)}
    said: list[str] = []
    resumed = run_in(tmp_path, is_resumed=True, said=said).once_each(units)
    assert resumed == {"maps/one": {"value": 1}, "maps/two": {"value": 2}}
    assert calls == [1, 2]
    assert said == ["maps/two, 1 of 2 done"]


def test_a_run_that_is_not_resumed_computes_everything_again(tmp_path: Path) -> None:
    calls: list[int] = []
    for _ in range(2):
        run_in(tmp_path, is_resumed=False, said=[]).once("one", counted(calls, 1))
    assert calls == [1, 1]


def test_results_of_other_code_are_not_used(tmp_path: Path) -> None:
    calls: list[int] = []
    run_in(tmp_path, is_resumed=True, said=[]).once("one", counted(calls, 1))
    run_in(tmp_path, is_resumed=True, fingerprint="b", said=[]).once("one", counted(calls, 2))
    assert calls == [1, 2]


@pytest.mark.parametrize("content", ["", "{", "[]", '{"fingerprint": "b"}'])
def test_a_damaged_result_is_computed_again(tmp_path: Path, content: str) -> None:
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "one.json").write_text(content)
    calls: list[int] = []
    run_in(tmp_path, is_resumed=True, said=[]).once("one", counted(calls, 3))
    assert calls == [3]


def test_shared_work_comes_back_in_the_order_of_the_units(tmp_path: Path) -> None:
    units = {str(value): partial(square, value) for value in (3, 1, 2)}
    results = run_in(tmp_path, is_resumed=False, said=[]).once_each(units, jobs=2)
    assert list(results.items()) == [(str(value), {"value": value**2}) for value in (3, 1, 2)]


def test_what_was_done_before_a_failure_is_kept(tmp_path: Path) -> None:
    calls: list[int] = []
    with pytest.raises(ValueError, match="broken"):
        run_in(tmp_path, is_resumed=False, said=[]).once_each(
            {"one": counted(calls, 1), "two": fail}
        )
    run_in(tmp_path, is_resumed=True, said=[]).once("one", counted(calls, 1))
    assert calls == [1]


def test_the_fingerprint_is_that_of_the_code() -> None:
    assert code_fingerprint() == code_fingerprint()
    assert len(code_fingerprint()) == 16
