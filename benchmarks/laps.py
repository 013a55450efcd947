"""The same loop driven again and again: the map must get better, and not larger.

One simulated building, there and back, many times without an end in between; mapped in a process of
its own.

References: own.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.cells import Result
from benchmarks.chain import ChainRun, run_chain, write_readings
from benchmarks.metric import Direction, Metric
from benchmarks.report import Report, Run
from benchmarks.simulated import readings_of
from benchmarks.trajectories import trajectory_errors
from hmt_service.core.config import load_config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import StampedPose

FIGURE = "laps.png"
"""Name of the figure."""
BASE = 2
"""The lap that later ones are compared with: the first one finds everything new."""

_SEED = 0
_LAPS, _QUICK_LAPS = 20, 3
_TIMEOUT_S = 3600.0
_COST_TOLERANCE, _MEMORY_TOLERANCE = 0.3, 0.3
_LOWER = Direction.LOWER_IS_BETTER


def measure(run: Run) -> Report:
    """Drive many laps, and the first few alone."""
    laps = _QUICK_LAPS if run.is_quick else _LAPS
    few = run.once(f"{BASE}", lambda: _driven(BASE))
    many = run.once(f"{laps}", lambda: _driven(laps))
    _draw(many, run.out / FIGURE)
    return Report(metrics_of(few, many), (), (run.out / FIGURE,))


def metrics_of(few: Result, many: Result) -> tuple[Metric, ...]:
    """Return the numbers.

    Args:
        few: The first laps alone.
        many: All laps.
    """
    last, base = len(many["areas"]), BASE - 1
    ratios = {key: many[key][-1] / many[key][base] for key in ("areas", "cost_ms", "memory_mb")}
    return (
        Metric("laps", float(last), "1", Direction.HIGHER_IS_BETTER, None),
        Metric("areas_over_lap_2", ratios["areas"], "1", _LOWER, 0.0),
        Metric("cost_over_lap_2", ratios["cost_ms"], "1", _LOWER, _COST_TOLERANCE),
        Metric("map_memory_over_lap_2", ratios["memory_mb"], "1", _LOWER, _MEMORY_TOLERANCE),
        Metric("areas", many["areas"][-1], "1", _LOWER, None),
        Metric("cost_per_scan", many["cost_ms"][-1], "ms", _LOWER, None),
        Metric("map_memory", many["memory_mb"][-1], "MB", _LOWER, None),
        # The same drive, seen again or not.
        Metric("error_of_first_laps", many["first_rmse_m"], "m", _LOWER, None),
        Metric("error_of_first_laps_alone", few["first_rmse_m"], "m", _LOWER, None),
    )


def ends_of_laps(positions: FloatArray, lap_m: float, laps: int) -> list[int]:
    """Return the number of scans up to the end of each lap.

    Args:
        positions: True position at each scan, shape (N, 3), m.
        lap_m: Length of a lap.
        laps: How many there are.
    """
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    # Corners are cut: what is driven is a little shorter than the route.
    lap_m = min(lap_m, float(travelled[-1]) / laps)
    return [int(np.searchsorted(travelled, lap * lap_m)) for lap in range(1, laps)] + [
        len(positions)
    ]


def _driven(laps: int) -> Result:
    # Ray casting loads slowly, and a resumed run may not need it.
    from hmt_service.sim.simulation import simulate
    from hmt_service.sim.usual import USUAL_ROBOTS
    from hmt_service.sim.worlds.families import Family, draw

    world = draw(Family.ALIASED, _SEED)
    route = np.asarray(world.route_m)
    lap = np.concatenate([route, route[-2:0:-1]])
    world = replace(world, route_m=np.concatenate([*[lap] * laps, lap[:1]]))
    lap_m = float(np.linalg.norm(np.diff(lap, axis=0, append=lap[:1]), axis=1).sum())
    truth: list[StampedPose] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive = simulate(world, USUAL_ROBOTS[Family.ALIASED], _SEED)
        write_readings(readings_of(drive, truth), folder / "readings")
        chain = run_chain(folder / "readings", load_config(), folder, timeout_s=_TIMEOUT_S)
    positions = np.array([pose.reference_from_body[:3, 3] for pose in truth])
    return _result(chain, truth, ends_of_laps(positions, lap_m, laps))


def _result(chain: ChainRun, truth: list[StampedPose], ends: list[int]) -> Result:
    """Return what each lap has cost, and what there was at its end."""
    last = np.array(ends) - 1
    spent_s = np.concatenate([[0.0], chain.spent_s.sum(axis=1)[last]])
    scans = np.diff([0, *ends])
    first = ends[BASE - 1]
    errors = trajectory_errors(chain.trajectory[:first], truth[:first])
    return {
        "areas": [float(count) for count in chain.areas[last]],
        "cost_ms": (1e3 * np.diff(spent_s) / scans).tolist(),
        "memory_mb": ((chain.memory_bytes[last] - chain.empty_bytes) / 1e6).tolist(),
        "first_rmse_m": errors.absolute_rmse_m,
    }


def _draw(many: Result, path: Path) -> None:
    laps = np.arange(1, len(many["areas"]) + 1)
    figure = Figure(figsize=(13.0, 3.8), layout="constrained")
    panels: tuple[Axes, ...] = tuple(figure.subplots(1, 3, sharex=True))
    for axes, key, title in zip(
        panels,
        ("areas", "cost_ms", "memory_mb"),
        ("areas", "processor time per scan / ms", "memory of the map / MB"),
        strict=True,
    ):
        axes.plot(laps, many[key], marker="o", markersize=4.0)
        axes.set(title=title, xlabel="laps", ylim=(0.0, 1.15 * max(many[key])))
        axes.grid(color="0.92", linewidth=0.6)
    figure.savefig(path, dpi=150)
