"""What the probabilities of topologies are worth, over many drawn worlds of known topology.

What is right is defined in `benchmarks.scoring`, what it scores in `benchmarks.calibration`.

References:
    Blanco et al. 2008, Eq. (14) (probabilities of topological paths).
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.belief_figures import draw_p_true, draw_reliability
from benchmarks.calibration import Scores, consistency_metrics, is_contested, score
from benchmarks.cells import Result
from benchmarks.kiss_slam import ENVIRONMENT, KissSlamPeer, make_environment
from benchmarks.metric import Direction, Metric
from benchmarks.processes import ChildFailed
from benchmarks.report import Report, Run
from benchmarks.scoring import Decision, Placement
from benchmarks.simulated import BLIND
from benchmarks.world_belief import WorldBelief, as_result, believe, from_result
from hmt_service.core.config import load_config
from hmt_service.sim.simulation import SHORT_SIGHTED, Robot, simulate
from hmt_service.sim.usual import USUAL_ROBOTS, preset_for
from hmt_service.sim.worlds.families import Family, draw


@dataclass(frozen=True, slots=True)
class _Group:
    """Worlds of one kind, each driven once."""

    family: Family
    seeds: Sequence[int]
    robot: Robot
    parameters: Mapping[str, float] = field(default_factory=dict)


def _usual(family: Family, seeds: Sequence[int]) -> _Group:
    return _Group(family, seeds, USUAL_ROBOTS[family])


# The slowest first, so that no process is left with them at the end. Other robots drive other
# worlds: what one shows is no part of what the other does.
_FULL = {
    "garage": _usual(Family.GARAGE, range(30)),
    "campus": _Group(Family.CAMPUS, range(2), USUAL_ROBOTS[Family.CAMPUS], {"relief_m": 0.0}),
    "warehouse-blind": _Group(Family.WAREHOUSE, range(10, 14), BLIND),
    "warehouse": _Group(Family.WAREHOUSE, range(300, 330), SHORT_SIGHTED),
    "nested-loops": _Group(Family.NESTED_LOOPS, range(300, 330), SHORT_SIGHTED),
    "aliased": _Group(Family.ALIASED, range(300, 330), SHORT_SIGHTED, {"severity": 1.0}),
    "aliased-blind": _Group(Family.ALIASED, range(10, 18), BLIND, {"severity": 1.0}),
    "office": _usual(Family.OFFICE, range(6)),
    "office-blind": _Group(Family.OFFICE, range(10, 16), BLIND),
}
_QUICK = {
    "office": _usual(Family.OFFICE, [0]),
    "aliased": _usual(Family.ALIASED, [1]),
}
_ALL = "all"
# Few worlds: one that turns over must not fail the gate, several must.
_RIGHT_TOLERANCE = 0.2
_LOOPS_TOLERANCE = 0.3
_SCORE_TOLERANCE = 0.05
_COVERAGE_TOLERANCE = 0.2
_LOWER, _HIGHER = Direction.LOWER_IS_BETTER, Direction.HIGHER_IS_BETTER


def measure(run: Run) -> Report:
    """Map worlds of all groups and score what was believed of them."""
    groups, skipped, python = _QUICK if run.is_quick else _FULL, [], None
    if not run.is_quick:
        run.say("installing KISS-SLAM")
        try:
            python = make_environment(run.out.parent / ENVIRONMENT)
        except ChildFailed as error:
            skipped.append(f"KISS-SLAM: cannot be installed: {str(error).splitlines()[0]}")
    units = {
        f"{name}/{seed}": partial(_believe, group, seed, python)
        for name, group in groups.items()
        for seed in group.seeds
    }
    results = run.once_each(units, jobs=os.cpu_count() or 1)
    beliefs = {
        name: [from_result(results[f"{name}/{seed}"]) for seed in group.seeds]
        for name, group in groups.items()
    }
    report = report_of(beliefs, run.out)
    return replace(report, skipped=(*skipped, *report.skipped))


def _believe(group: _Group, seed: int, python: Path | None) -> Result:
    """Map one world; one of LiDAR with KISS-SLAM, too, if there is a Python that has it."""
    world = draw(group.family, seed, **group.parameters)
    instants = simulate(world, group.robot, seed)
    config = load_config(preset_for(group.robot, group.family))
    if python is None or config.sensor.is_planar:
        return as_result(believe(instants, config))
    with tempfile.TemporaryDirectory() as folder:
        return as_result(believe(instants, config, peer=KissSlamPeer(python, Path(folder))))


def report_of(beliefs: Mapping[str, Sequence[WorldBelief]], out: Path) -> Report:
    """Return the numbers and figures of what was believed of some worlds.

    Args:
        beliefs: Worlds by the name of their group; at least one in each, with two visits or more.
        out: Folder for the figures.
    """
    everything = [belief for worlds in beliefs.values() for belief in worlds]
    decisions = _decisions(everything)
    contested = [decision for decision in decisions if is_contested(decision)]
    metrics = [*_topologies(_ALL, everything), *_scores(_ALL, score(decisions))]
    skipped = []
    if contested:
        metrics += _scores(f"{_ALL}/contested", score(contested))
    else:
        skipped.append(f"{_ALL}/contested: none of {len(decisions)} decisions is")
    metrics += _against_always_new(everything)
    for name, worlds in beliefs.items():
        metrics += [*_topologies(name, worlds), *_losses(name, score(_decisions(worlds)))]
    for sensor, is_planar in (("2d", True), ("3d", False)):
        of_preset = [belief for belief in everything if belief.is_planar is is_planar]
        for what, errors in _errors(of_preset).items():
            if errors:
                metrics += consistency_metrics(
                    f"nees_{sensor}/{what}",
                    errors,
                    is_planar=is_planar,
                    coverage_tolerance=_COVERAGE_TOLERANCE,
                )
            elif of_preset:
                skipped.append(f"nees_{sensor}/{what}: {len(of_preset)} maps, none of them right")
    panels = {"All": score(decisions)} | ({"Contested": score(contested)} if contested else {})
    figures = out / "reliability.png", out / "p_true.png"
    draw_reliability(panels, figures[0])
    draw_p_true(beliefs, figures[1])
    return Report(tuple(metrics), tuple(skipped), figures)


def _decisions(worlds: Sequence[WorldBelief]) -> list[Decision]:
    return [decision for world in worlds for decision in world.decisions]


def _topologies(name: str, worlds: Sequence[WorldBelief]) -> Iterator[Metric]:
    """Yield what the topologies are at the end."""
    p_true = float(np.mean([world.p_true for world in worlds]))
    map_right = float(np.mean([world.is_map_right for world in worlds]))
    yield Metric(f"{name}/worlds", float(len(worlds)), "1", _HIGHER, 0.0)
    yield Metric(f"{name}/p_true", p_true, "1", _HIGHER, _RIGHT_TOLERANCE)
    yield Metric(f"{name}/map_right", map_right, "1", _HIGHER, _RIGHT_TOLERANCE)
    alone = [world.alone for world in worlds]
    right_alone = float(np.mean([each.is_map_right for each in alone]))
    yield Metric(f"{name}/map_right_alone", right_alone, "1", _HIGHER, None)
    false_alone = float(sum(each.false_loops for each in alone))
    yield Metric(f"{name}/false_loops_alone", false_alone, "1", _LOWER, None)
    cost = sum(each.engine_s for each in alone) / sum(each.engine_alone_s for each in alone)
    yield Metric(f"{name}/cost_over_alone", cost, "1", _LOWER, None)
    own = [world.placement for world in worlds]
    yield from _placements(name, own, _RIGHT_TOLERANCE)
    yield from _placements(f"{name}/alone", [each.placement for each in alone], None)
    if greedy := [w.placement_greedy for w in worlds if w.placement_greedy is not None]:
        yield from _placements(f"{name}/greedy", greedy, None)
    if peers := [world.placement_peer for world in worlds if world.placement_peer is not None]:
        yield from _placements(f"{name}/kiss_slam", peers, None)
    returns = float(sum(world.true_returns for world in worlds))
    false = float(sum(world.false_loops for world in worlds))
    missed = float(sum(world.missed_loops for world in worlds))
    yield Metric(f"{name}/true_returns", returns, "1", _HIGHER, None)
    yield Metric(f"{name}/false_loops", false, "1", _LOWER, None)
    yield Metric(f"{name}/missed_loops", missed, "1", _LOWER, None)
    if returns and name == _ALL:
        per_return = false / returns, missed / returns
        yield Metric(f"{name}/false_loops_per_return", per_return[0], "1", _LOWER, _LOOPS_TOLERANCE)
        yield Metric(
            f"{name}/missed_loops_per_return", per_return[1], "1", _LOWER, _LOOPS_TOLERANCE
        )


def _placements(
    name: str, placements: Sequence[Placement], tolerance: float | None
) -> Iterator[Metric]:
    """Yield how many keyframes that return are placed right, and in how many worlds all are."""
    returning = sum(each.returning for each in placements)
    if not returning:
        return
    right = sum(each.right for each in placements) / returning
    yield Metric(f"{name}/placed_right", right, "1", _HIGHER, tolerance)
    all_right = float(np.mean([each.right == each.returning for each in placements]))
    yield Metric(f"{name}/all_placed_right", all_right, "1", _HIGHER, tolerance)


def _losses(name: str, scores: Scores) -> Iterator[Metric]:
    """Yield what decisions are worth; next to nothing where they are right, so never gated."""
    error = scores.expected_calibration_error
    yield Metric(f"{name}/brier", scores.brier, "1", _LOWER, None)
    yield Metric(f"{name}/log_loss", scores.log_loss, "nat", _LOWER, None)
    yield Metric(f"{name}/calibration_error", error, "1", _LOWER, None)


def _scores(name: str, scores: Scores) -> Iterator[Metric]:
    """Yield the same and, for the gate, what is left of 1: a share of it means something."""
    yield Metric(f"{name}/decisions", float(scores.decisions), "1", _HIGHER, None)
    yield from _losses(name, scores)
    given = math.exp(-scores.log_loss)
    calibration = 1.0 - scores.expected_calibration_error
    yield Metric(f"{name}/p_right", given, "1", _HIGHER, _SCORE_TOLERANCE)
    yield Metric(f"{name}/calibration", calibration, "1", _HIGHER, _SCORE_TOLERANCE)


def _against_always_new(worlds: Sequence[WorldBelief]) -> Iterator[Metric]:
    """Yield what a filter that is certain of new areas gets on the same visits, and what is gained.

    A skill is 1 for perfect decisions, and 0 for what this filter is worth.
    """
    scores = score([decision for world in worlds for decision in world.decisions_always_new])
    map_right = float(np.mean([not world.true_returns for world in worlds]))
    yield Metric("always_new/map_right", map_right, "1", _HIGHER, None)
    returning = sum(world.placement_odometry.returning for world in worlds)
    if returning:
        right = sum(world.placement_odometry.right for world in worlds) / returning
        yield Metric("always_new/placed_right", right, "1", _HIGHER, None)
    yield from _losses("always_new", scores)
    if scores.brier:
        own = score(_decisions(worlds))
        brier, log_loss = 1.0 - own.brier / scores.brier, 1.0 - own.log_loss / scores.log_loss
        yield Metric(f"{_ALL}/brier_skill", brier, "1", _HIGHER, _SCORE_TOLERANCE)
        yield Metric(f"{_ALL}/log_skill", log_loss, "1", _HIGHER, _SCORE_TOLERANCE)


def _errors(worlds: Sequence[WorldBelief]) -> Mapping[str, list[float]]:
    """Return the normalised errors of all worlds by what they are of."""
    return {
        "odometry": [error for world in worlds for error in world.odometry_errors],
        "arcs": [error for world in worlds for error in world.arc_errors],
        "areas": [error for world in worlds for error in world.area_errors],
    }
