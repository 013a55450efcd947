"""Figures of what a run has cost: time per scan of every process, and how the map has grown.

References:
    Blanco et al. 2008, Fig. 9(c) and Fig. 9(e).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from hmt_service.core.types import Keyframe

_BAR = "#0072B2"


def times_figure(busy_s: Mapping[str, float], scans: int, *, width_in: float) -> Figure:
    """Return the mean time that each process took per scan.

    Args:
        busy_s: Time that each process has worked, s.
        scans: How many scans that was for, > 0.
        width_in: Width of the figure, inch.
    """
    figure = Figure(figsize=(width_in, 0.9 + 0.45 * len(busy_s)), layout="constrained")
    axes = figure.subplots()
    names, per_scan_ms = list(busy_s), [1e3 * each / scans for each in busy_s.values()]
    bars = axes.barh(names, per_scan_ms, color=_BAR, height=0.6)
    axes.bar_label(bars, fmt="%.2f ms", padding=4)
    axes.set(xlim=(0.0, 1.25 * max(per_scan_ms)), xlabel="mean time per scan / ms")
    axes.invert_yaxis()
    return figure


def growth_figure(keyframes: Sequence[Keyframe], *, width_in: float) -> Figure:
    """Return how many bytes of points the map kept of all that was seen until each moment.

    Args:
        keyframes: In order of their indices, at least one; those that are forgotten have no points.
        width_in: Width of the figure, inch.
    """
    figure = Figure(figsize=(width_in, 2.4), layout="constrained")
    axes = figure.subplots()
    stamps_s = [keyframe.stamp_s for keyframe in keyframes]
    kept_mb = np.cumsum([keyframe.points_in_body.nbytes for keyframe in keyframes]) / 1e6
    axes.plot(np.array(stamps_s) - stamps_s[0], kept_mb, color=_BAR, linewidth=1.4)
    axes.fill_between(np.array(stamps_s) - stamps_s[0], kept_mb, color=_BAR, alpha=0.2, linewidth=0)
    axes.set(ylim=(0.0, None), xlabel="sensor time since the start / s", ylabel="points / MB")
    axes.grid(color="0.92", linewidth=0.6)
    axes.set_axisbelow(True)
    return figure
