"""`python -m benchmarks`: run benchmarks, show their numbers, hold them against the baseline.

References: own.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from enum import StrEnum
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.status import Status
from rich.table import Table
from rich.text import Text

from benchmarks.cells import Cells, code_fingerprint
from benchmarks.metric import (
    Comparison,
    Direction,
    Metric,
    Verdict,
    compare,
    read_baseline,
    update_baseline,
)
from benchmarks.report import Report, Run
from hmt_service.errors import HmtError, InvalidInput

BASELINE = Path(__file__).with_name("baseline.json")
"""The committed baseline."""
WORSE = 1
"""Exit code when the gate fails."""
BAD_INPUT = 2
"""Exit code of a wrong option, or when a benchmark cannot run."""
_WIDTH = 120
"""Columns where the output is no terminal."""
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Name(StrEnum):
    """What can be measured; each is the module of its name."""

    ACCURACY = "accuracy"
    BELIEF = "belief"
    HYPOTHESES = "hypotheses"
    AWAKENING = "awakening"
    TABLE2 = "table2"
    PEERS = "peers"
    SCALING = "scaling"
    LAPS = "laps"
    LATENCY = "latency"
    OUTAGES = "outages"
    LOAD = "load"


def _measure_in_module(name: Name, run: Run) -> Report:
    # The benchmarks load numpy, which reads the number of its threads only once: `main` sets it
    # before.
    report: Report = import_module(f"benchmarks.{name}").measure(run)
    return report


REGISTRY: dict[Name, Callable[[Run], Report]] = {
    name: partial(_measure_in_module, name) for name in Name
}
"""Every benchmark; a new one is a module with `measure` and a name above."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def run_benchmarks(
    names: Annotated[
        list[Name] | None, typer.Argument(metavar="[NAME]...", help="What to measure; all if none.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Measure on less.")] = False,
    gate: Annotated[
        bool, typer.Option("--gate", help="Fail when a metric is worse than the baseline allows.")
    ] = False,
    update: Annotated[
        bool, typer.Option("--update-baseline", help="Make what is measured the baseline.")
    ] = False,
    baseline: Annotated[Path, typer.Option(help="File that holds the baseline.")] = BASELINE,
    out: Annotated[
        Path, typer.Option(help="Folder for numbers and figures: OUT/quick or OUT/full.")
    ] = Path("out/benchmarks"),
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on where an earlier run of this code stopped.")
    ] = False,
) -> None:
    """Measure the chain: how accurate, how true its beliefs, how fast, beside others.

    Exit codes: 0 done, 1 the gate failed, 2 wrong options or a benchmark could not run.
    """
    if gate and update:
        raise InvalidInput("--gate and --update-baseline exclude each other")
    console = Console(width=None if Console().is_terminal else _WIDTH)
    chosen = list(dict.fromkeys(names or REGISTRY))
    mode = "quick" if quick else "full"
    folder = _made(out / mode)
    # Of the values of other benchmarks nothing can be said.
    known = {
        key: value
        for key, value in read_baseline(baseline, mode).items()
        if key.split("/")[0] in chosen
    }
    report = _measure(chosen, console, folder, is_quick=quick, is_resumed=resume)
    comparisons = compare(report.metrics, known)
    _show(console, comparisons, report.skipped, mode)
    console.print(f"numbers and {len(report.figures)} figures in {folder}", soft_wrap=True)
    if update:
        update_baseline(baseline, mode, report.metrics)
        console.print(f"{len(report.metrics)} values of mode {mode} in {baseline}", soft_wrap=True)
    if gate and not _passes(console, comparisons):
        raise typer.Exit(WORSE)


def _measure(
    names: Sequence[Name], console: Console, folder: Path, *, is_quick: bool, is_resumed: bool
) -> Report:
    """Run the benchmarks one after the other; what each has measured is written at once."""
    fingerprint = code_fingerprint()
    reports = []
    for name in names:
        cells = Cells(folder / "cells" / name, fingerprint, is_resumed)
        with console.status(name) as status:
            report = REGISTRY[name](Run(is_quick, partial(_say, status, name), folder, cells))
        reports.append(_named(name, report))
        _write(folder / f"{name}.json", reports[-1])
    return Report(
        tuple(metric for report in reports for metric in report.metrics),
        tuple(sentence for report in reports for sentence in report.skipped),
        tuple(figure for report in reports for figure in report.figures),
    )


def _named(name: Name, report: Report) -> Report:
    return Report(
        tuple(replace(metric, key=f"{name}/{metric.key}") for metric in report.metrics),
        tuple(f"{name}/{sentence}" for sentence in report.skipped),
        report.figures,
    )


def _say(status: Status, name: Name, text: str) -> None:
    status.update(f"{name}: {text}")


def _show(
    console: Console, comparisons: Sequence[Comparison], skipped: Sequence[str], mode: str
) -> None:
    table = Table(title=f"Benchmarks, mode {mode}")
    table.add_column("metric", no_wrap=True)
    for heading in ("value", "unit", "baseline", "change", "allowed"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    for comparison in comparisons:
        table.add_row(*_row(comparison), style=_style(comparison.verdict))
    console.print(table)
    for sentence in skipped:
        console.print(Text(f"skipped {sentence}", style="yellow"), soft_wrap=True)


def _row(comparison: Comparison) -> tuple[str, ...]:
    metric, baseline, change = comparison.metric, comparison.baseline, comparison.change
    return (
        comparison.key,
        "-" if metric is None else f"{metric.value:.4g}",
        _unit(comparison),
        "-" if baseline is None else f"{baseline.value:.4g}",
        "-" if change is None else f"{change:+.1%}",
        "-" if metric is None else _allowed(metric),
        comparison.verdict,
    )


def _unit(comparison: Comparison) -> str:
    units = [side.unit for side in (comparison.metric, comparison.baseline) if side is not None]
    return " / ".join(dict.fromkeys(units))


def _allowed(metric: Metric) -> str:
    if metric.rel_tol is None:
        return "-"
    sign = "+" if metric.direction is Direction.LOWER_IS_BETTER else "-"
    return f"{sign}{metric.rel_tol:.0%}"


def _style(verdict: Verdict) -> str:
    match verdict:
        case Verdict.WORSE | Verdict.OTHER_UNIT:
            return "red"
        case Verdict.BETTER:
            return "green"
        case Verdict.NOT_IN_RUN | Verdict.NOT_IN_BASELINE:
            return "yellow"
        case Verdict.WITHIN | Verdict.NOT_GATED:
            return ""


def _passes(console: Console, comparisons: Sequence[Comparison]) -> bool:
    """Say what the gate decides, and return it: nothing compared is nothing passed."""
    failed = [comparison.key for comparison in comparisons if comparison.is_failure]
    compared = sum(comparison.is_compared for comparison in comparisons)
    sides = {
        verdict: sum(comparison.verdict is verdict for comparison in comparisons)
        for verdict in (Verdict.NOT_IN_BASELINE, Verdict.NOT_IN_RUN)
    }
    rest = "".join(f", {count} {verdict}" for verdict, count in sides.items() if count)
    if failed:
        sentence = f"gate failed: {len(failed)} of {compared} compared{rest}: {', '.join(failed)}"
    elif not compared:
        sentence = f"gate failed: no metric could be compared with the baseline{rest}"
    else:
        sentence = f"gate passed: {compared} compared{rest}"
    is_passed = compared > 0 and not failed
    console.print(Text(sentence, style="green" if is_passed else "red"), soft_wrap=True)
    return is_passed


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(f"cannot make the folder {folder}: {error.strerror}") from error
    return folder


def _write(path: Path, report: Report) -> None:
    document = {
        "metrics": [asdict(metric) for metric in report.metrics],
        "skipped": report.skipped,
        "figures": [figure.name for figure in report.figures],
    }
    try:
        path.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")
    except OSError as error:
        raise InvalidInput(f"cannot write {path}: {error.strerror}") from error


def main() -> None:
    """Run the command line with one thread per library, as the daemon's processes have."""
    os.environ.update(dict.fromkeys(_THREAD_VARIABLES, "1"))
    try:
        app()
    except HmtError as error:
        Console(stderr=True).print(Text(f"error: {error}", style="red"), soft_wrap=True)
        raise SystemExit(BAD_INPUT) from error


if __name__ == "__main__":
    main()
