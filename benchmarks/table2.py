"""Time and memory of our chain against a global RBPF on the same logs, and time per process.

Both map the same scans, each alone in a process of its own, one after the other, with one thread
per library. *Time* is processor time, which other work on the machine hardly touches: of ours
inside the methods that map, of `rbpf-slam` all but its start. *Map memory* is what the resident
memory has grown by, a median over the last tenth of the scans (`rbpf-slam` copies maps now and
then): ours since just before the first scan, that of `rbpf-slam` since it has seen one scan without
returns. Both read the log scan by scan, so neither it nor the libraries count; what an allocator
keeps after a peak does. *Peak memory* is the largest resident memory, everything included, as seen
from outside.

`rbpf-slam` matches a scan every 0.2 m or 10 degrees, as its authors set it; our odometry matches
all of them, most of its time. Neither is slowed down or thinned out for the comparison.

References:
    Blanco et al. 2008, Table II, Fig. 9(c) (time per process), Fig. 9(e) (memory over time).
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.cells import Result
from benchmarks.chain import ChainRun, run_chain, write_readings
from benchmarks.metric import Direction, Metric
from benchmarks.rbpf import RbpfRun, find_rbpf, run_rbpf
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.stages import Stage
from hmt_service.core.config import load_config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import StampedPose
from hmt_service.io.relations import evaluate, read_relations

_TIMEOUT_S = 3_600.0
_STAMP_TOLERANCE_S = 0.005
_POINTS_IN_A_CURVE = 400
_LAST_SHARE = 10
_MB = 1e6
_QUICK_SCANS = 150
_TIME_TOLERANCE = 0.5
_MEMORY_TOLERANCE = 0.3
_LOWER = Direction.LOWER_IS_BETTER
_OURS, _PEER = "hmt", "rbpf"
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#8C8C00")


@dataclass(frozen=True, slots=True)
class _Log:
    """One recorded log."""

    name: str
    file: str
    relations: str | None
    repeats: int


_QUICK_LOG = _Log("malaga", "malaga-one-loop.clf.gz", None, 1)
_LOGS = (
    _Log("malaga", "malaga-one-loop.clf.gz", None, 3),
    _Log("fr079", "fr079.clf.bz2", "fr079.relations", 1),
    _Log("intel", "intel.clf.bz2", "intel.relations", 1),
)


def measure(run: Run) -> Report:
    """Map every recorded log that is there with both programs."""
    program = find_rbpf()
    if program is None:
        return Report((), ("all: rbpf-slam is not installed (Debian package mrpt-apps)",))
    metrics: list[Metric] = []
    skipped: list[str] = []
    figures: list[Path] = []
    for log in (_QUICK_LOG,) if run.is_quick else _LOGS:
        path = recorded_file(log.file)
        if isinstance(path, Missing):
            skipped.append(f"{log.name}: {path.reason}")
            continue
        results = [
            run.once(f"{log.name}/{repeat}", partial(_compare, program, path, log, run.is_quick))
            for repeat in range(log.repeats)
        ]
        metrics += _metrics(log.name, results)
        figures.append(run.out / f"table2-{log.name}.png")
        draw(log.name, results[0], figures[-1])
    return Report(tuple(metrics), tuple(skipped), tuple(figures))


def _compare(program: Path, path: Path, log: _Log, is_quick: bool) -> Result:
    """Map one log with all programs."""
    readings = first_scans(read_recorded(path, load_config()), _QUICK_SCANS if is_quick else None)
    truth = None if log.relations is None else recorded_file(log.relations)
    relations = None if truth is None or isinstance(truth, Missing) else truth
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scans = write_readings(readings, folder / "readings")
        ours = run_chain(folder / "readings", load_config(), folder, timeout_s=_TIMEOUT_S)
        at = np.unique(np.linspace(0, scans - 1, _POINTS_IN_A_CURVE).astype(int))
        theirs = run_rbpf(program, readings, folder, timeout_s=_TIMEOUT_S)
    return {
        "scans": (at + 1).tolist(),
        "sides": {_OURS: _side(ours, at, relations), _PEER: _side(theirs, at, relations)},
        "spent_s": dict(zip(Stage, ours.spent_s[at].T.tolist(), strict=True)),
        "ms_per_scan": dict(zip(Stage, (1e3 * ours.spent_s[-1] / scans).tolist(), strict=True)),
    }


def _side(run: ChainRun | RbpfRun, at: np.ndarray, relations: Path | None) -> dict[str, object]:
    growth_mb = (run.memory_bytes - run.empty_bytes) / _MB
    numbers = {
        "time": run.cpu_s,
        "map_memory": _median(growth_mb[-max(1, len(growth_mb) // _LAST_SHARE) :]),
        "peak_memory": max(sample.rss_bytes for sample in run.samples) / _MB,
        **({} if relations is None else _errors(run.trajectory, relations)),
    }
    return {"numbers": numbers, "growth_mb": growth_mb[at].tolist()}


def _errors(trajectory: Sequence[StampedPose], relations: Path) -> dict[str, float]:
    errors = evaluate(trajectory, read_relations(relations), tolerance_s=_STAMP_TOLERANCE_S)
    return {
        "translation_mean": errors.all_pairs.translation_mean_m,
        "rotation_mean": errors.all_pairs.rotation_mean_deg,
    }


_UNITS = {
    "time": "s",
    "map_memory": "MB",
    "peak_memory": "MB",
    "translation_mean": "m",
    "rotation_mean": "deg",
}


def _metrics(name: str, results: Sequence[Result]) -> Iterator[Metric]:
    """Yield the medians over the repetitions."""
    for key, tolerance in (("time", _TIME_TOLERANCE), ("map_memory", _MEMORY_TOLERANCE)):
        ratios = [_number(one, _OURS, key) / _number(one, _PEER, key) for one in results]
        yield Metric(f"{name}/{key}_over_{_PEER}", _median(ratios), "1", _LOWER, tolerance)
    for side, content in results[0]["sides"].items():
        for key in content["numbers"]:
            value = _median([_number(one, side, key) for one in results])
            yield Metric(f"{name}/{side}/{key}", value, _UNITS[key], _LOWER, None)
    for stage in Stage:
        value = _median([one["ms_per_scan"][stage] for one in results])
        key = stage.lower().replace(" ", "_")
        yield Metric(f"{name}/{_OURS}/{key}_per_scan", value, "ms", _LOWER, None)


def _number(result: Result, side: str, key: str) -> float:
    return float(result["sides"][side]["numbers"][key])


def _median(values: Sequence[float] | FloatArray) -> float:
    return float(np.median(values))


def draw(name: str, result: Result, path: Path) -> None:
    """Draw memory over time, as in Fig. 9(e), and time per process, as in Fig. 9(c).

    Args:
        name: The log.
        result: What `_compare` has returned.
        path: Image to write.
    """
    figure = Figure(figsize=(12.0, 4.5), layout="constrained")
    memory, duration = figure.subplots(1, 2)
    scans = np.array(result["scans"])
    for (side, content), colour in zip(result["sides"].items(), _COLOURS, strict=False):
        memory.plot(scans, content["growth_mb"], color=colour, label=side)
    memory.set(title=f"{name}: growth of the memory", xlabel="scan", ylabel="MB")
    memory.legend(frameon=False)
    _draw_stages(duration, scans, result)
    duration.set(title=f"{name}: time of our processes", xlabel="scan", ylabel="s, cumulative")
    figure.savefig(path, dpi=120)


def _draw_stages(axes: Axes, scans: FloatArray, result: Result) -> None:
    labels = [f"{stage}: {result['ms_per_scan'][stage]:.2f} ms per scan" for stage in Stage]
    spent_s = [result["spent_s"][stage] for stage in Stage]
    axes.stackplot(scans, spent_s, labels=labels, colors=_COLOURS)
    axes.legend(loc="upper left", frameon=False)
