"""Report of a run: one page that holds everything, for any browser, without scripts.

References:
    Blanco et al. 2008, Fig. 7 (both global maps), Fig. 9 (the map, its uncertainty and its costs)
    and Fig. 10 (the belief over time).
"""

from __future__ import annotations

import io
import math
from base64 import b64encode
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import matplotlib as mpl
import numpy as np
import yaml
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from hmt_service.core.audit import between, decisive, longest_doubt
from hmt_service.core.config import Preset, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.types import Comparison, GlobalMap, MapMethod
from hmt_service.io.saved_run import SavedHypothesis, SavedRun
from hmt_service.io.whole_files import whole_files
from hmt_service.viz.costs import growth_figure, times_figure
from hmt_service.viz.figures import map_figures, poses_figure, position_ellipse, topology_figure
from hmt_service.viz.posterior import history_figure

_PANEL_IN, _WIDTH_IN = 5.0, 5.8
"""Figures are this wide, so that their letters can be read on a phone."""
_MAGNIFIED = 5.0
"""As in the paper's Fig. 9(d)."""
_DECISIONS = 20
_AREAS = 12
_TOPOLOGIES = 10


@dataclass(frozen=True, slots=True)
class Picture:
    """One figure of the page."""

    source: str
    """Data URI of the image."""
    title: str
    """What it is."""
    text: str
    """What there is to see, for those who do not see it, too."""


def write_report(run: SavedRun, path: Path) -> None:
    """Write the page.

    Args:
        run: What was saved.
        path: File to write; it appears as a whole, or not at all.

    Raises:
        InvalidInput: If the map is empty.
        NotFound: If the folder of the file does not exist.
        Unavailable: If the file system refuses.
    """
    engine = Engine.restored(run.stored, seed=run.stored.seed)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.filters["probability"] = probability_text
    template = environment.from_string(
        files("hmt_service.viz").joinpath("report.html").read_text(encoding="utf-8")
    )
    consistent, shortest = (
        engine.global_map(method) for method in (MapMethod.CONSISTENT, MapMethod.SHORTEST_PATH)
    )
    comparison = engine.compare()
    page = template.render(
        run=run,
        summary=run.summary,
        best=run.summary.posterior[0],
        topologies=run.summary.posterior[:_TOPOLOGIES],
        others=run.summary.posterior[_TOPOLOGIES:],
        verdict=verdict(run.summary.posterior),
        facts=_facts(run, engine),
        maps=_maps(consistent, shortest, comparison),
        costs=_costs(run, engine, consistent),
        beliefs=_beliefs(run),
        worst=sorted(comparison.areas, key=lambda area: -area.translation_m)[:_AREAS],
        degrees=math.degrees,
        processes=_processes(run),
        memory=_memory(run),
        kinds=sorted(Counter(event.kind.value for event in run.events).items()),
        decisions=decisive(run.events, _DECISIONS),
        preset=next((each for each in Preset if load_config(each) == run.stored.config), None),
        settings=yaml.safe_dump(run.stored.config.model_dump(mode="json"), sort_keys=False),
    )
    with whole_files(path) as (part,):
        part.write_text(page, encoding="utf-8")


def probability_text(probability: float) -> str:
    """Return a probability so that what is not certain does not look so."""
    if 0.99995 <= probability < 1.0:
        return f"1 - {1.0 - probability:.0e}"
    is_small = 0.0 < probability < 1e-4
    return f"{probability:.0e}" if is_small else f"{probability:.4f}"


def verdict(posterior: tuple[SavedHypothesis, ...]) -> str:
    """Return in a sentence how sure it is which topology is right."""
    best, others = posterior[0], posterior[1:]
    areas = f"{best.areas} areas and {best.loop_closures} loop closures"
    if not others:
        return f"One topology is left, with {areas}: all others were given up, see the decisions."
    count = f"{len(others)} other topolog{'y' if len(others) == 1 else 'ies'}"
    return (
        f"The most probable topology, with {areas}, has probability "
        f"{probability_text(best.probability)}; {count} cannot be ruled out."
    )


def _facts(run: SavedRun, engine: Engine) -> Iterator[tuple[str, str, str]]:
    """Yield identifier, name and text of every key number."""
    summary = run.summary
    trajectory = engine.trajectory()
    positions = np.array([pose.reference_from_body[:3, 3] for pose in trajectory])
    length_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    busy_s = sum(summary.busy_s.values())
    yield "scans", "scans", f"{summary.scans:,}"
    yield "keyframes", "keyframes", f"{summary.keyframes:,}"
    yield "areas", "areas", f"{summary.areas:,}"
    yield "arcs", "arcs", f"{summary.arcs:,}"
    yield "loop-closures", "loop closures", f"{summary.posterior[0].loop_closures:,}"
    yield "hypotheses", "hypotheses left", f"{len(summary.posterior):,}"
    yield "length", "path", f"{length_m:,.0f} m"
    yield "duration", "sensor time", f"{trajectory[-1].stamp_s - trajectory[0].stamp_s:,.0f} s"
    yield "rate", "scans per second", f"{summary.scans / busy_s:,.0f}" if busy_s > 0.0 else "–"
    yield "memory", "peak memory", f"{summary.peak_memory_mb:,.0f} MB"


def _maps(consistent: GlobalMap, shortest: GlobalMap, comparison: Comparison) -> Iterator[Picture]:
    figures = map_figures((consistent, shortest), comparison, panel_in=_PANEL_IN)
    yield _picture(
        figures[0],
        "Globally consistent",
        "The graph of all arcs, optimised: each area with its points and 95 % ellipse.",
    )
    yield _picture(
        figures[1],
        "Shortest paths",
        "Arcs composed along the best known path from the reference area: fast, and inconsistent "
        "where loops close. Red: the arcs that the poses contradict most.",
    )


def _costs(run: SavedRun, engine: Engine, consistent: GlobalMap) -> Iterator[Picture]:
    positions = np.array([pose.reference_from_body[:3, 3] for pose in engine.trajectory()])
    magnified = _magnified(consistent)
    yield _picture(
        topology_figure(consistent, positions, panel_in=_PANEL_IN),
        "(a) Map and topology",
        "All submaps in the frame of the reference area, the path of the robot, and the areas and "
        "arcs of the most probable topology.",
    )
    yield _picture(
        poses_figure(consistent, panel_in=_PANEL_IN, magnified=magnified),
        "(d) Poses of the areas",
        "Globally consistent, with 95 % ellipses"
        + (f" magnified by {magnified:g}." if magnified > 1.0 else " as large as they are."),
    )
    yield _picture(
        times_figure(run.summary.busy_s, run.summary.scans, width_in=_WIDTH_IN),
        "(c) Time per scan",
        "The odometry is the paper's metric SLAM; the topology is AAM, TSBI and TLCA together.",
    )
    yield _picture(
        growth_figure(run.stored.keyframes, width_in=_WIDTH_IN),
        "(e) Growth of the map",
        "Points that the map holds, by the time when they were seen. It stays flat where nothing "
        "new is seen.",
    )


def _magnified(shown: GlobalMap) -> float:
    """Return how many times larger than true ellipses are drawn: not if they would cover all."""
    origins = np.array([area.reference_from_area.mean[:2, 3] for area in shown.areas])
    longest_m = max(position_ellipse(area.reference_from_area)[0] for area in shown.areas)
    return _MAGNIFIED if _MAGNIFIED * longest_m < np.ptp(origins, axis=0).max() else 1.0


def _beliefs(run: SavedRun) -> Iterator[Picture]:
    if not run.beliefs:
        return
    yield _picture(
        history_figure(run.beliefs, width_in=_WIDTH_IN),
        "The whole run",
        "Effective sample size, posterior of the topologies, and marginal of the areas in doubt.",
    )
    if (doubt := longest_doubt(run.beliefs)) is not None:
        yield _picture(
            history_figure(between(run.beliefs, *doubt), width_in=_WIDTH_IN),
            "What was in doubt most and longest",
            f"The same from {doubt[0]:.1f} s to {doubt[1]:.1f} s of sensor time.",
        )


def _processes(run: SavedRun) -> Iterator[tuple[str, float, float, float]]:
    """Yield name, time (s), time per scan (ms) and share of every process."""
    busy_s = run.summary.busy_s
    total_s = sum(busy_s.values())
    for name, each_s in busy_s.items():
        share = each_s / total_s if total_s > 0.0 else 0.0
        yield name, each_s, 1e3 * each_s / max(1, run.summary.scans), share


def _memory(run: SavedRun) -> Mapping[str, float]:
    """Return what took how much memory, MB."""
    kept_mb = sum(keyframe.points_in_body.nbytes for keyframe in run.stored.keyframes) / 1e6
    rows = {"peak of the process": run.summary.peak_memory_mb, "points of the map": kept_mb}
    submaps = run.summary.submaps_mb or {}
    return {**rows, **{f"submaps, {where}": size_mb for where, size_mb in submaps.items()}}


def _picture(figure: Figure, title: str, text: str) -> Picture:
    drawn = io.BytesIO()
    # Equal figures give equal bytes: no date, and names that are not drawn by lot.
    with mpl.rc_context({"svg.hashsalt": title, "svg.fonttype": "none"}):
        figure.savefig(
            drawn,
            format="svg",
            dpi=150,
            metadata={"Date": None},
            bbox_inches="tight",
            pad_inches=0.05,
        )
    encoded = b64encode(drawn.getvalue()).decode()
    return Picture(f"data:image/svg+xml;base64,{encoded}", title, text)
