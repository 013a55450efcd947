"""A small map of the flat, made by the engine: what files and exports of maps are tested with."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

from hmt_service.core.config import Preset, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry
from hmt_service.core.stored import StoredAssignment, StoredHypothesis, StoredMap
from hmt_service.core.types import Belief
from hmt_service.io.audit_files import read_beliefs, write_beliefs
from hmt_service.io.map_file import write_map
from hmt_service.io.saved_run import BELIEFS, MAP, SUMMARY
from hmt_service.runtime.messages import RunReport
from hmt_service.service.results import save_results
from tests.flat import SETTINGS, readings

SCANS = 300
"""From the left room to the right one, back, and a little further."""


@cache
def mapped() -> Engine:
    """Return the engine after the drive, not smoothed; nobody may change it."""
    config = load_config(Preset.PLANAR, SETTINGS)
    engine, odometry = Engine(config), Odometry(config)
    for reading in readings(SCANS):
        if (tracking := odometry.process(reading)) is not None:
            engine.process(tracking)
    engine.finish(is_urgent=True)
    return engine


def map_file_in(folder: Path) -> Path:
    """Write that map."""
    path = folder / "map.hmt"
    write_map(path, mapped().stored())
    return path


def doubted_map() -> StoredMap:
    """Return that map with a rival of probability 0.2: the robot came back to no known room."""
    stored = mapped().stored()
    (best,) = stored.hypotheses
    founders = [a for a in best.assignments if a.area_from_visit is None]
    rival = StoredHypothesis(
        hypothesis=best.hypothesis + 1,
        log_weight=math.log(0.2),
        assignments=tuple(
            a if a in founders else StoredAssignment(a.visit, a.visit, None)
            for a in best.assignments
        ),
        reference_from_visit=best.reference_from_visit,
        factors=tuple(f for f in best.factors if f.visit_b - f.visit_a == 1),
    )
    return replace(stored, hypotheses=(replace(best, log_weight=math.log(0.8)), rival))


def saved_run_in(folder: Path) -> Path:
    """Save that drive as a run does, with the doubted map and a doubt over time."""
    config = load_config(Preset.PLANAR, SETTINGS)
    save_results(mapped(), RunReport(SCANS, 1.5, 0.5), directory=folder, config=config, seed=0)
    doubted = doubted_map()
    write_map(folder / MAP, doubted)
    best, rival = doubted.hypotheses
    summary = json.loads((folder / SUMMARY).read_text())
    (only,) = summary["posterior"]
    summary["posterior"] = [
        {**only, "hypothesis": best.hypothesis, "probability": 0.8},
        {**only, "hypothesis": rival.hypothesis, "probability": 0.2, "loop_closures": 0},
    ]
    summary["warnings"] = ["ranges of 0.4 m: <another preset> would fit better"]
    (folder / SUMMARY).write_text(json.dumps(summary))
    beliefs = read_beliefs(folder / BELIEFS)
    doubt = Belief(
        beliefs[-1].stamp_s + 5.0,
        {0: 0.8, 2: 0.2},
        1.0 / (0.8**2 + 0.2**2),
        {best.hypothesis: 0.8, rival.hypothesis: 0.2},
    )
    write_beliefs(folder / BELIEFS, [*beliefs, doubt, replace(doubt, stamp_s=doubt.stamp_s + 9.0)])
    return folder
