"""What a scan, an entry of an area and a global map cost as the map grows to 10,000 areas.

One drive through a long simulated world, mapped in a process of its own; at numbers of areas that
grow threefold the map is looked at. The drive ends when its time does: how far it came is a result,
and how long the rest would have taken is told.

References: own.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.cells import Result
from benchmarks.long_drive import Checkpoint, End, Entry, drive
from benchmarks.metric import Direction, Metric
from benchmarks.report import Report, Run
from hmt_service.core.config import load_config
from hmt_service.core.types import Reading
from hmt_service.errors import InvalidInput

CHECKPOINTS = (10, 30, 100, 300, 1_000, 3_000, 10_000)
"""Numbers of areas at which the map is looked at."""
FIGURE = "scaling.png"
"""Name of the figure."""

_SEED = 0
# As few beams as fill an area, which see little more than their room. Who scans half as often
# loses track at every tenth door.
_BEAMS = 181
_MAX_RANGE_M = 8.0
_SCAN_PERIOD_S = 0.25
_SPEED_M_S = 1.1
_GROWTH_TOLERANCE = 1.0
_SIZE_TOLERANCE = 0.2
_LEAST_GROWTH = 1.5
"""Of the areas on a stretch, for its mean to differ from the one before by more than noise."""
_UNITS_S = {"years": 3.156e7, "days": 86_400.0, "h": 3_600.0, "min": 60.0}
_EVER_S = 100.0 * _UNITS_S["years"]
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


@dataclass(frozen=True, slots=True)
class _Effort:
    """How much is measured."""

    rooms: int
    """Of the world; some are one area together."""
    budget_s: float


_QUICK = _Effort(rooms=1_000, budget_s=12.0)
_FULL = _Effort(rooms=15_000, budget_s=600.0)


@dataclass(frozen=True, slots=True)
class Stretch:
    """The way from one number of areas to another."""

    areas: int
    """Areas at its end."""
    middle: float
    """Areas when half of it was done, on a logarithmic scale: what its means stand for."""
    scan_s: float
    """Mean time of a scan at which no area was entered."""
    entry_s: float
    """Mean time of one at which one was."""
    scans_per_area: float
    """Scans of the stretch over the areas that are new in it."""


def measure(run: Run) -> Report:
    """Drive through a long world, and look at the map again and again."""
    effort = _QUICK if run.is_quick else _FULL
    result = run.once("drive", lambda: _driven(run, effort))
    return report(result, effort.budget_s, run.out / FIGURE)


def _driven(run: Run, effort: _Effort) -> Result:
    """Return all that the drive says; a run that is cut off begins it again."""
    run.say("drawing the world")
    said: dict[type, list[Result]] = {Entry: [], Checkpoint: [], End: []}
    for message in drive(
        _readings(effort.rooms),
        load_config(),
        checkpoints=CHECKPOINTS,
        budget_s=effort.budget_s,
    ):
        said[type(message)].append(asdict(message))
        if isinstance(message, Entry):
            run.say(f"{message.areas} areas; ends after {_duration(effort.budget_s)}")
    return {"entries": said[Entry], "checkpoints": said[Checkpoint], "end": said[End][0]}


def _readings(rooms: int) -> Iterator[Reading]:
    # Ray casting loads slowly, and a resumed run may not need it.
    from hmt_service.sim.sensors import Laser2d
    from hmt_service.sim.simulation import Robot, simulate
    from hmt_service.sim.trajectories import PathFollower
    from hmt_service.sim.worlds.families import Family, draw

    robot = Robot(
        follower=PathFollower(speed_m_s=_SPEED_M_S),
        sensor=Laser2d(beams=_BEAMS, max_range_m=_MAX_RANGE_M),
        scan_period_s=_SCAN_PERIOD_S,
    )
    for instant in simulate(draw(Family.LONG, _SEED, areas=rooms), robot, _SEED):
        yield from instant.readings


def report(result: Result, budget_s: float, figure: Path) -> Report:
    """Return the numbers of a drive, and draw them.

    Args:
        result: What `drive` has said.
        budget_s: Time that it was given.
        figure: Image to write.

    Raises:
        InvalidInput: If the drive entered too few areas to say anything.
    """
    entries = [Entry(**entry) for entry in result["entries"]]
    looks = [Checkpoint(**look) for look in result["checkpoints"]]
    end = End(**result["end"])
    largest = entries[-1].areas if entries else 0
    if not looks:
        raise InvalidInput(
            f"{largest} areas in {end.elapsed_s:.1f} s: {CHECKPOINTS[0]} are the least to look at; "
            f"failure: {end.failure}"
        )
    stretches = stretches_of(entries, CHECKPOINTS)
    _draw(stretches, looks, figure)
    metrics = (
        Metric("largest", float(largest), "1", _HIGHER, None),
        Metric("failures", float(end.failure is not None), "1", _LOWER, 0.0),
        *_point_metrics(stretches, looks),
        # How far a stretch that was cut off came depends on the machine.
        *_growth_metrics(stretches[: len(looks)], looks),
    )
    return Report(metrics, tuple(_not_reached(largest, stretches, end, budget_s)), (figure,))


# -------------------------------------------------------------------------- arithmetic


def stretches_of(entries: Sequence[Entry], checkpoints: Sequence[int]) -> tuple[Stretch, ...]:
    """Return the stretches that end at a checkpoint each, and the one that was cut off.

    Args:
        entries: In the order of time.
        checkpoints: Numbers of areas, ascending.

    Returns:
        The stretches; the one that was cut off only if it says something about growth.
    """
    stretches: list[Stretch] = []
    awaited, part, known = list(checkpoints), list[Entry](), 0
    for entry in entries:
        part.append(entry)
        if awaited and entry.areas >= awaited[0]:
            awaited.pop(0)
            stretches.append(_stretch(part, known))
            part, known = [], entry.areas
    if part and part[-1].areas >= _LEAST_GROWTH * known:
        stretches.append(_stretch(part, known))
    return tuple(stretches)


def _stretch(entries: Sequence[Entry], areas_before: int) -> Stretch:
    scans, areas = sum(entry.scans for entry in entries), entries[-1].areas
    return Stretch(
        areas=areas,
        middle=float(np.exp(np.mean(np.log([entry.areas for entry in entries])))),
        scan_s=sum(entry.scans_s for entry in entries) / max(scans, 1),
        entry_s=float(np.mean([entry.entry_s for entry in entries])),
        scans_per_area=scans / max(areas - areas_before, 1),
    )


def growth_exponent(sizes: Sequence[float], costs: Sequence[float]) -> float | None:
    """Return k of the power law cost ~ size^k that fits best on logarithmic scales.

    0 is flat, 1 is linear.

    Args:
        sizes: > 0.
        costs: > 0, one per size.

    Returns:
        The exponent; None with fewer than two sizes.
    """
    if len(set(sizes)) < 2:
        return None
    exponent, _ = np.polyfit(np.log(sizes), np.log(costs), 1)
    return float(exponent)


def projected_s(stretches: Sequence[Stretch], reached: int, areas: int) -> float | None:
    """Return how long the drive would go on to so many areas, s.

    The cost of an entry is extrapolated as a power law: by the exponent of all stretches or of the
    last two, whichever is larger, for small costs that do not grow hide large ones that do. That of
    a scan stays what it was. Looking at the map is not included.

    Args:
        stretches: What is known.
        reached: Areas that there are.
        areas: Areas that there shall be.

    Returns:
        The time; None when there are too few stretches.
    """
    known = [
        exponent
        for part in (stretches, stretches[-2:])
        if (exponent := growth_exponent([s.middle for s in part], [s.entry_s for s in part]))
        is not None
    ]
    if not known:
        return None
    last, power = stretches[-1], 1.0 + max(0.0, *known)
    # The integral of entry_s (n / middle)^(power - 1) over the areas n to come.
    entries = (math.pow(areas, power) - math.pow(reached, power)) / power
    entries_s = last.entry_s * entries / math.pow(last.middle, power - 1.0)
    return entries_s + (areas - reached) * last.scans_per_area * last.scan_s


# ------------------------------------------------------------------ numbers and figure


def _point_metrics(stretches: Sequence[Stretch], looks: Sequence[Checkpoint]) -> Iterator[Metric]:
    before = Checkpoint(0, 0.0, 0.0, 0.0, 0.0, 0, 0)
    for stretch, look in zip(stretches, looks, strict=False):
        for name, seconds in (
            ("scan", stretch.scan_s),
            ("entry", stretch.entry_s),
            ("consistent_map", look.consistent_s),
            ("shortest_path_map", look.shortest_path_s),
            ("snapshot", look.snapshot_s),
            ("save", look.save_s),
        ):
            yield Metric(f"{look.areas}_areas/{name}", 1e3 * seconds, "ms", _LOWER, None)
        # What libraries take at first is in the first one; the file is exact.
        memory_bytes = (look.memory_bytes - before.memory_bytes) / (look.areas - before.areas)
        for name, size_bytes, tolerance in (
            ("memory_per_area", memory_bytes, None),
            ("file_per_area", look.file_bytes / look.areas, _SIZE_TOLERANCE),
        ):
            key = f"{look.areas}_areas/{name}"
            yield Metric(key, 1e-3 * size_bytes, "kB", _LOWER, tolerance)
        before = look


def _growth_metrics(stretches: Sequence[Stretch], looks: Sequence[Checkpoint]) -> Iterator[Metric]:
    middles, areas = [s.middle for s in stretches], [float(look.areas) for look in looks]
    for name, sizes, costs, tolerance in (
        ("entry", middles, [s.entry_s for s in stretches], _GROWTH_TOLERANCE),
        ("scan", middles, [s.scan_s for s in stretches], _GROWTH_TOLERANCE),
        ("consistent_map", areas, [look.consistent_s for look in looks], None),
        ("shortest_path_map", areas, [look.shortest_path_s for look in looks], None),
        ("save", areas, [look.save_s for look in looks], None),
    ):
        exponent = growth_exponent(sizes, costs)
        if exponent is not None:
            yield Metric(f"{name}_exponent", exponent, "1", _LOWER, None)
            # A share of an exponent near 0 allows nothing; of this, which is then 1, it does.
            key = f"{name}_for_tenfold_areas"
            yield Metric(key, 10.0**exponent, "1", _LOWER, tolerance)


def _not_reached(
    largest: int, stretches: Sequence[Stretch], end: End, budget_s: float
) -> Iterator[str]:
    """Yield why each of the other checkpoints is missing, and how long it would have taken."""
    for areas in (areas for areas in CHECKPOINTS if areas > largest):
        more_s = projected_s(stretches, largest, areas)
        if end.failure is not None:
            why = f", then {end.failure}"
        elif end.is_complete:
            why = " on the whole route"
        elif more_s is None:
            why = f" in {_duration(budget_s)}"
        else:
            why = f" in {_duration(budget_s)}; extrapolated {_duration(end.elapsed_s + more_s)}"
        yield f"{areas} areas: {largest}{why}"


def _duration(seconds: float) -> str:
    if seconds > _EVER_S:
        return f"over {_EVER_S / _UNITS_S['years']:.0f} years"
    for unit, length_s in _UNITS_S.items():
        if seconds >= 2.0 * length_s:
            return f"{seconds / length_s:.0f} {unit}"
    return f"{seconds:.0f} s"


def _draw(stretches: Sequence[Stretch], looks: Sequence[Checkpoint], path: Path) -> None:
    """Draw costs, memory and file over the number of areas, on logarithmic scales."""
    middles, areas = [s.middle for s in stretches], [look.areas for look in looks]
    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    per_scan, per_map, sizes = figure.subplots(1, 3, sharex=True)
    _curve(per_scan, middles, [1e3 * s.scan_s for s in stretches], "scan")
    _curve(per_scan, middles, [1e3 * s.entry_s for s in stretches], "entry of an area")
    _curve(per_scan, areas, [1e3 * look.snapshot_s for look in looks], "snapshot")
    _curve(per_map, areas, [1e3 * look.consistent_s for look in looks], "consistent map")
    _curve(per_map, areas, [1e3 * look.shortest_path_s for look in looks], "shortest-path map")
    _curve(per_map, areas, [1e3 * look.save_s for look in looks], "map file written")
    _curve(sizes, areas, [1e-6 * look.memory_bytes for look in looks], "memory")
    _curve(sizes, areas, [1e-6 * look.file_bytes for look in looks], "map file")
    for axes, title, unit in (
        (per_scan, "while the robot drives", "time / ms"),
        (per_map, "when somebody asks", "time / ms"),
        (sizes, "what the map takes", "size / MB"),
    ):
        axes.set(title=title, xlabel="areas", ylabel=unit, xscale="log", yscale="log")
        axes.grid(color="0.92", linewidth=0.6, which="both")
        axes.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=150)


def _curve(axes: Axes, sizes: Sequence[float], costs: Sequence[float], label: str) -> None:
    exponent = growth_exponent(sizes, costs)
    grows = "" if exponent is None else f" ~ areas^{exponent:.2f}"
    axes.plot(sizes, costs, marker="o", markersize=4.0, label=f"{label}{grows}")
