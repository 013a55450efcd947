"""What a set of hypotheses costs over the single best one: time, memory, and memory for each.

The same readings are mapped with the usual budget of hypotheses and with a budget of one, each
alone in a process of its own, one after the other, with one thread per library. Time is processor
time; memory is the largest growth of the resident memory since just before the first scan. A budget
is what may live, not what does: how many live at the same time is told beside it, and what one more
of them takes is counted by the allocator (`census`).

References: own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from benchmarks.cells import Result
from benchmarks.census import take_census
from benchmarks.chain import ChainRun, run_chain, write_readings
from benchmarks.metric import Direction, Metric
from benchmarks.recordings import Missing, first_scans, read_recorded, recorded_file
from benchmarks.report import Report, Run
from benchmarks.simulated import BLIND, readings_of
from benchmarks.stages import Stage
from hmt_service.core.config import load_config
from hmt_service.core.types import Reading
from hmt_service.sim.simulation import SHORT_SIGHTED, Robot, simulate
from hmt_service.sim.worlds.families import Family, draw


@dataclass(frozen=True, slots=True)
class _Group:
    """Worlds of one kind, each driven once."""

    family: Family
    seeds: Sequence[int]
    robot: Robot
    parameters: Mapping[str, float] = field(default_factory=dict)


# In most worlds few hypotheses live at a time; wheels that slip leave more of them.
_FULL = {
    "nested-loops": _Group(Family.NESTED_LOOPS, range(300, 302), SHORT_SIGHTED),
    "nested-loops-blind": _Group(Family.NESTED_LOOPS, [300], BLIND),
    "aliased-blind": _Group(Family.ALIASED, [10], BLIND, {"severity": 1.0}),
}
_QUICK = {"nested-loops": _Group(Family.NESTED_LOOPS, [300], SHORT_SIGHTED)}
_QUICK_SCANS = 150
_LOG = "intel.clf.bz2"
_BUDGETS = {"several": load_config(), "one": load_config(text="particles: {budget: 1}")}
_TIMEOUT_S = 3_600.0
# Where other work runs, the time of the same work differs by an eighth; that of little, by more.
_TOLERANCES = {"time": 0.5, "topology": None, "memory": 0.2}
_EXTRA_TOLERANCE = 0.2
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER

_Drive = Callable[[], Iterable[Reading]]


def measure(run: Run) -> Report:
    """Map every drive with several hypotheses, and with one."""
    drives: dict[str, list[_Drive]] = {
        name: [partial(_driven, group, seed) for seed in group.seeds]
        for name, group in (_QUICK if run.is_quick else _FULL).items()
    }
    skipped = []
    path = recorded_file(_LOG)
    if isinstance(path, Missing):
        skipped.append(f"intel: {path.reason}")
    else:
        drives["intel"] = [partial(read_recorded, path, load_config())]
    scans = _QUICK_SCANS if run.is_quick else None
    results = {
        name: [
            run.once(f"{name}/{index}", partial(_compare, drive, scans))
            for index, drive in enumerate(of_name)
        ]
        for name, of_name in drives.items()
    }
    report = report_of(results)
    return Report(report.metrics, (*skipped, *report.skipped))


def report_of(results: Mapping[str, Sequence[Result]]) -> Report:
    """Return the numbers of some drives.

    Args:
        results: What each has cost, by the name of its group; at least one in each.
    """
    metrics: list[Metric] = []
    skipped = []
    for name, of_name in results.items():
        metrics += _metrics(name, of_name)
        extra_kb = [kb for each in of_name if (kb := each["extra_kb"]) is not None]
        if extra_kb:
            largest = max(extra_kb)
            key = f"{name}/memory_per_extra"
            metrics.append(Metric(key, largest, "kB", _LOWER, _EXTRA_TOLERANCE))
        else:
            skipped.append(f"{name}/memory_per_extra: two hypotheses never live at the same time")
    return Report(tuple(metrics), tuple(skipped))


def _metrics(name: str, results: Sequence[Result]) -> Iterator[Metric]:
    for key, tolerance in _TOLERANCES.items():
        several, one = (sum(each[budget][key] for each in results) for budget in _BUDGETS)
        yield Metric(f"{name}/{key}_over_one", several / one, "1", _LOWER, tolerance)
    mean = sum(each["alive_mean"] for each in results) / len(results)
    most = max(each["alive_most"] for each in results)
    yield Metric(f"{name}/alive_mean", mean, "1", _HIGHER, None)
    yield Metric(f"{name}/alive_most", most, "1", _HIGHER, None)


def _compare(drive: _Drive, scans: int | None) -> Result:
    """Map one drive with each budget, and count the hypotheses of the larger one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        readings = folder / "readings"
        write_readings(first_scans(drive(), scans), readings)
        costs = {
            budget: _cost(run_chain(readings, config, folder, timeout_s=_TIMEOUT_S))
            for budget, config in _BUDGETS.items()
        }
        census = take_census(readings, _BUDGETS["several"], folder, timeout_s=_TIMEOUT_S)
    extra = census.bytes_per_extra
    return {
        **costs,
        "alive_mean": float(census.alive.mean()),
        "alive_most": float(census.alive.max()),
        "extra_kb": None if extra is None else extra / 1e3,
    }


def _cost(chain: ChainRun) -> dict[str, float]:
    """Return processor times, s, and memory, MB."""
    metric_slam_s = float(chain.spent_s[-1, list(Stage).index(Stage.METRIC_SLAM)])
    return {
        "time": chain.cpu_s,
        "topology": chain.cpu_s - metric_slam_s,
        "memory": float(chain.memory_bytes.max() - chain.empty_bytes) / 1e6,
    }


def _driven(group: _Group, seed: int) -> Iterator[Reading]:
    world = draw(group.family, seed, **group.parameters)
    return readings_of(simulate(world, group.robot, seed), [])
