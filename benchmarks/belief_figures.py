"""Figures of beliefs: how often what was believed was right, and what the truth was given.

References:
    Niculescu-Mizil and Caruana, Predicting good probabilities with supervised learning, ICML 2005
    (reliability diagrams).
    Okabe and Ito, Color Universal Design, 2008 (colours that colour-blind readers can tell apart).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.calibration import BINS, Scores, wilson_interval
from benchmarks.world_belief import WorldBelief

_BLUE, _ORANGE = "#0072B2", "#D55E00"


def draw_reliability(scores: Mapping[str, Scores], path: Path) -> None:
    """Draw how often the option that was believed most was right, one panel per set of decisions.

    Below each panel is how many decisions each bin of confidence holds.

    Args:
        scores: Scores of sets of decisions by their title, from left to right; at least one.
        path: Image to write.
    """
    figure = Figure(figsize=(4.6 * len(scores), 5.6), layout="constrained")
    axes = figure.subplots(
        2, len(scores), sharex=True, squeeze=False, height_ratios=(3, 1), sharey="row"
    )
    for column, (title, each) in enumerate(scores.items()):
        _draw_reliability(axes[0, column], each)
        axes[0, column].set_title(
            f"{title}: {each.decisions} decisions\n"
            f"calibration error {each.expected_calibration_error:.3f}, Brier {each.brier:.3f}",
            fontsize=10,
        )
        _draw_counts(axes[1, column], each)
        axes[1, column].set_xlabel("confidence in the option believed most")
    axes[0, 0].set_ylabel("share of them that is right")
    axes[1, 0].set_ylabel("decisions")
    figure.savefig(path, dpi=150)


def _draw_reliability(axes: Axes, scores: Scores) -> None:
    confidence = np.array([one.confidence for one in scores.bins])
    share = np.array([one.right / one.count for one in scores.bins])
    interval = np.array([wilson_interval(one.right, one.count) for one in scores.bins])
    axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0, linestyle="--")
    axes.errorbar(
        confidence,
        share,
        # A share of exactly 0 or 1 is an end of its own interval: rounding must not make it leave.
        yerr=np.maximum([share - interval[:, 0], interval[:, 1] - share], 0.0),
        fmt="o",
        color=_BLUE,
        capsize=3.0,
    )
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.grid(color="0.92", linewidth=0.6)


def _draw_counts(axes: Axes, scores: Scores) -> None:
    for one in scores.bins:
        left = min(int(one.confidence * BINS), BINS - 1) / BINS
        axes.bar(left, one.count, 1.0 / BINS, align="edge", color=_BLUE, edgecolor="white")
        axes.annotate(
            str(one.count), (left + 0.5 / BINS, one.count), ha="center", va="bottom", fontsize=8
        )
    # Most decisions are certain: on a linear scale the others would not be seen.
    axes.set_yscale("log")
    axes.set_ylim(0.7, 5.0 * max(one.count for one in scores.bins))
    axes.grid(color="0.92", linewidth=0.6)


def draw_p_true(worlds: Mapping[str, Sequence[WorldBelief]], path: Path) -> None:
    """Draw the probability that the true topology has at the end, one dot per world.

    Args:
        worlds: Worlds by the name of their group, from left to right; at least one group.
        path: Image to write.
    """
    figure = Figure(figsize=(1.4 * len(worlds) + 2.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for column, beliefs in enumerate(worlds.values()):
        beside = np.linspace(-0.3, 0.3, len(beliefs)) if len(beliefs) > 1 else np.zeros(1)
        for x, belief in zip(column + beside, beliefs, strict=True):
            axes.plot(
                x,
                belief.p_true,
                marker="o" if belief.is_map_right else "x",
                color=_BLUE if belief.is_map_right else _ORANGE,
                linestyle="none",
            )
        right = sum(belief.is_map_right for belief in beliefs)
        axes.annotate(
            f"{right} of {len(beliefs)} right", (column, 1.06), ha="center", fontsize=8, color="0.3"
        )
    axes.set_xticks(range(len(worlds)), list(worlds))
    axes.set(ylim=(-0.04, 1.14), ylabel="probability of the true topology")
    axes.set_title("One mark per world; a cross where the most probable topology is wrong", size=10)
    axes.grid(axis="y", color="0.92", linewidth=0.6)
    figure.savefig(path, dpi=150)
