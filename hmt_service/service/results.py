"""The results of a run as files; what `hmt serve` saves.

References:
    own.
"""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from hmt_service import __version__
from hmt_service.core.config import Config
from hmt_service.errors import Unavailable
from hmt_service.io.saved_run import BELIEFS, EVENTS, MAP, SUMMARY, TRAJECTORY
from hmt_service.runtime.messages import RunReport

if TYPE_CHECKING:
    from hmt_service.core.engine import Engine


def save_results(
    engine: Engine,
    report: RunReport,
    kept: Path | None = None,
    *,
    directory: Path,
    config: Config,
    seed: int,
) -> tuple[str, ...]:
    """Write trajectory, map, events, beliefs and summary, each replaced as a whole.

    A frozen map is not written again.

    Args:
        engine: What was built.
        report: What it has cost.
        kept: Map file that has just been written by its owner; the one of the results may be it.
        directory: Where to write; made when it does not exist.
        config: Settings that it was built with.
        seed: Seed that it was built with.

    Returns:
        The names of the files.

    Raises:
        Unavailable: If there is no map yet.
    """
    from hmt_service.io.audit_files import write_beliefs, write_events
    from hmt_service.io.map_file import write_map
    from hmt_service.io.trajectory import write_tum

    snapshot = engine.snapshot()
    if snapshot is None:
        raise Unavailable(f"nothing to save: the map has no keyframe after {report.scans} scans")
    summary = {
        "version": __version__,
        "config_hash": config.hash(),
        "seed": seed,
        "scans": report.scans,
        "keyframes": snapshot.keyframes,
        "areas": snapshot.areas,
        "arcs": snapshot.arcs,
        "revision": snapshot.posterior.revision,
        "posterior": [
            {
                "hypothesis": hypothesis.hypothesis,
                "probability": hypothesis.probability,
                "areas": hypothesis.areas,
                "loop_closures": hypothesis.loop_closures,
            }
            for hypothesis in snapshot.posterior.hypotheses
        ],
        "tracked": engine.tracked,
        "warnings": [event.message for event in engine.warnings],
        "busy_s": {"odometry": report.odometry_busy_s, "topology": report.topology_busy_s},
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if (usage := engine.memory_usage) is not None:
        summary["submaps_mb"] = {"memory": usage.held_bytes / 1e6, "disk": usage.shelf_bytes / 1e6}
    directory.mkdir(parents=True, exist_ok=True)
    trajectory = engine.trajectory()
    _replace(directory / TRAJECTORY, lambda path: write_tum(path, trajectory))
    is_kept = kept is not None and kept.resolve() == (directory / MAP).resolve()
    if not (engine.is_frozen or is_kept):
        write_map(directory / MAP, engine.stored())
    audit = engine.audit
    _replace(directory / EVENTS, lambda path: write_events(path, audit.events))
    _replace(directory / BELIEFS, lambda path: write_beliefs(path, audit.beliefs))
    text = json.dumps(summary, indent=2) + "\n"
    _replace(directory / SUMMARY, lambda path: path.write_text(text))
    maps = () if engine.is_frozen else (MAP,)
    return TRAJECTORY, *maps, EVENTS, BELIEFS, SUMMARY


def _replace(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file beside `path`, then put it there: nobody ever reads half of it."""
    part = path.with_name(path.name + ".part")
    write(part)
    part.replace(path)
