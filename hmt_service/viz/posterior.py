"""Figure of a belief over time: effective sample size, topologies, marginal of the current area.

References:
    Blanco et al. 2008, Fig. 10 (the same while a loop is closed).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import Belief
from hmt_service.errors import InvalidInput
from hmt_service.viz.figures import check_image

_MOST_AREAS = 8
"""Panels: of the areas that were most in doubt."""
_LEAST_DOUBT = 0.01
_INK, _FILL = "#202020", "#0072B2"
_PANEL_IN, _WIDTH_IN = 1.1, 10.0
# Okabe and Ito: colour-blind readers can tell them apart.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442")


def draw_history(beliefs: Sequence[Belief], path: Path) -> None:
    """Draw effective sample size, probabilities of topologies, and those of areas over time.

    Args:
        beliefs: In time order; each lasts until the next.
        path: Image to write; its suffix says the format.

    Raises:
        InvalidInput: If there is nothing to draw, or no such image format.
        NotFound: If the folder of the image does not exist.
    """
    check_image(path)
    history_figure(beliefs).savefig(path, dpi=150)


def history_figure(beliefs: Sequence[Belief], *, width_in: float = _WIDTH_IN) -> Figure:
    """Return effective sample size, probabilities of topologies, and those of areas over time.

    The topologies share a panel, each hypothesis stacked on those before it in a colour of its own.

    Args:
        beliefs: In time order; each lasts until the next.
        width_in: Width of the figure, inch.

    Raises:
        InvalidInput: If there is nothing to draw.
    """
    if not beliefs:
        raise InvalidInput("no belief to draw: none between the two times")
    areas = doubted_areas(beliefs)
    stamps_s = np.array([belief.stamp_s for belief in beliefs])
    size = (width_in, _PANEL_IN * (len(areas) + 2) + 0.9)
    figure = Figure(figsize=size, layout="constrained")
    panels: list[Axes] = list(figure.subplots(len(areas) + 2, 1, sharex=True, squeeze=False)[:, 0])
    ess = np.array([belief.effective_sample_size for belief in beliefs])
    panels[0].step(stamps_s, ess, where="post", color=_INK, linewidth=1.0)
    panels[0].set(ylim=(0.0, 1.15 * float(ess.max())), ylabel="effective\nsample size")
    _stack(panels[1], stamps_s, [belief.hypotheses for belief in beliefs])
    for axes, area in zip(panels[2:], areas, strict=True):
        mass = np.array([belief.current_area.get(area, 0.0) for belief in beliefs])
        axes.fill_between(stamps_s, mass, step="post", color=_FILL, alpha=0.35, linewidth=0.0)
        axes.step(stamps_s, mass, where="post", color=_FILL, linewidth=1.0)
        axes.set(ylim=(0.0, 1.05), ylabel=f"area {area}")
    for axes in panels:
        axes.grid(color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
    panels[-1].set_xlabel("sensor time / s")
    # In full, so that they can be given to --start and --end.
    panels[-1].ticklabel_format(axis="x", style="plain", useOffset=False)
    panels[-1].xaxis.set_major_locator(MaxNLocator(5))
    panels[0].set_title("Where the robot was believed to be", fontsize=11)
    return figure


def _stack(axes: Axes, stamps_s: FloatArray, masses: Sequence[Mapping[int, float]]) -> None:
    """Draw the posterior of the topologies, the oldest hypothesis at the bottom."""
    below = np.zeros(len(stamps_s))
    for number, hypothesis in enumerate(sorted({each for mass in masses for each in mass})):
        above = below + np.array([mass.get(hypothesis, 0.0) for mass in masses])
        axes.fill_between(
            stamps_s,
            below,
            above,
            step="post",
            color=_COLOURS[number % len(_COLOURS)],
            linewidth=0.0,
        )
        below = above
    axes.set(ylim=(0.0, 1.05), ylabel="topologies")


def doubted_areas(beliefs: Sequence[Belief]) -> list[int]:
    """Return the areas that were in doubt most and longest, in the order of their numbers.

    Where nothing was in doubt, those that the robot was in longest.
    """
    doubt: dict[int, float] = {}
    peak: dict[int, float] = {}
    stay: dict[int, float] = {}
    stamps_s = [belief.stamp_s for belief in beliefs]
    for belief, end_s in zip(beliefs, [*stamps_s[1:], stamps_s[-1]], strict=True):
        lasted_s = end_s - belief.stamp_s
        for area, p in belief.current_area.items():
            doubt[area] = doubt.get(area, 0.0) + lasted_s * min(p, 1.0 - p)
            peak[area] = max(peak.get(area, 0.0), min(p, 1.0 - p))
            stay[area] = stay.get(area, 0.0) + lasted_s * p
    order = sorted(doubt, key=lambda area: (-doubt[area], -stay[area], area))
    in_doubt = [area for area in order if peak[area] >= _LEAST_DOUBT]
    return sorted((in_doubt or order)[:_MOST_AREAS])
