"""Figures of global maps: areas in their colours, arcs, uncertainty and contradictions.

References:
    Blanco et al. 2008, Fig. 7 (the same map composed along shortest paths and globally consistent).
    Okabe and Ito, Color Universal Design, 2008 (colours that colour-blind readers can tell apart).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke

from hmt_service.core.geometry import FloatArray, GaussianPose, transform_points
from hmt_service.core.types import Arc, ArcResidual, Comparison, GlobalMap, MapMethod
from hmt_service.errors import InvalidInput, NotFound

_Position = tuple[float, float]
"""x and y in the reference frame, m."""

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#8C8C00", "#5D3A9B")
_CONTRADICTION = "#D00000"
_INK = "#202020"
_SHADE = "#20202028"
_GREY, _PATH = "#8C8C8C", "#0072B2"
_CHI2_95_2 = 5.991
"""95 % quantile of the chi-squared distribution with two degrees of freedom."""
_CROWD = 60
"""More areas than this get smaller labels."""
_MARKED_ARCS = 5
_LEAST_MARKED_M = 0.05
_PANEL_IN = 8.0
_LEGEND_ENTRY_IN = 2.6
_AROUND_IN = 1.7
"""Height of a title, an axis and a legend of three rows."""
_MARGIN_M = 1.0
_HALO = (withStroke(linewidth=2.5, foreground="white"),)
_TITLES = {MapMethod.CONSISTENT: "Globally consistent", MapMethod.SHORTEST_PATH: "Shortest paths"}


def draw_maps(maps: Sequence[GlobalMap], comparison: Comparison | None, path: Path) -> None:
    """Draw maps of the same areas side by side, seen from above, at the same scale.

    Args:
        maps: One panel each, from left to right.
        comparison: What to mark in the shortest-path panel: the arcs that it contradicts most;
            None: no marks.
        path: Image to write; its suffix says the format.

    Raises:
        InvalidInput: If there is no map, one without areas, or no such image format.
        NotFound: If the folder of the image does not exist.
    """
    check_image(path)
    _maps_figure(maps, maps, comparison, panel_in=_PANEL_IN).savefig(path, dpi=150)


def map_figures(
    maps: Sequence[GlobalMap], comparison: Comparison | None, *, panel_in: float
) -> list[Figure]:
    """Return what `draw_maps` draws as a figure per map, for pages that are narrower than both.

    Args:
        maps: One figure each, all of the same extent and scale.
        comparison: As in `draw_maps`.
        panel_in: Longer side of a panel, inch.

    Raises:
        InvalidInput: If there is no map, or one without areas.
    """
    return [_maps_figure([each], maps, comparison, panel_in=panel_in) for each in maps]


def topology_figure(shown: GlobalMap, positions: FloatArray, *, panel_in: float) -> Figure:
    """Return the map with the path of the robot and the areas and arcs over it (Fig. 9(a)).

    Args:
        shown: The map.
        positions: Where the robot was, in its reference frame, shape (N, 3), m.
        panel_in: Longer side of the panel, inch.

    Raises:
        InvalidInput: If the map has no areas.
    """
    figure, (axes,) = _panels(1, [shown], panel_in)
    axes.plot(*positions[:, :2].T, color=_PATH, linewidth=0.9, zorder=1.5)
    _draw_points(axes, shown, dict.fromkeys((area.area for area in shown.areas), _GREY))
    _draw_topology(axes, shown)
    handles = [Line2D([], [], color=_PATH, label="path of the robot"), *_legend()[:3]]
    _finish(figure, [axes], handles)
    return figure


def poses_figure(shown: GlobalMap, *, panel_in: float, magnified: float) -> Figure:
    """Return the poses of the areas with their ellipses alone (Fig. 9(d)).

    Args:
        shown: The map.
        panel_in: Longer side of the panel, inch.
        magnified: How many times longer than true the axes of the ellipses are drawn, > 0.

    Raises:
        InvalidInput: If the map has no areas.
    """
    figure, (axes,) = _panels(1, [shown], panel_in)
    _draw_topology(axes, shown)
    _draw_ellipses(axes, shown, magnified=magnified)
    _finish(figure, [axes], _legend(magnified=magnified))
    return figure


def _maps_figure(
    maps: Sequence[GlobalMap],
    extent_of: Sequence[GlobalMap],
    comparison: Comparison | None,
    *,
    panel_in: float,
) -> Figure:
    figure, panels = _panels(len(maps), extent_of, panel_in)
    colours = area_colours(extent_of)
    is_marked = False
    for axes, each in zip(panels, maps, strict=True):
        _draw_points(axes, each, colours)
        _draw_topology(axes, each)
        _draw_ellipses(axes, each)
        if comparison is not None and each.method is MapMethod.SHORTEST_PATH:
            _mark_contradictions(axes, each, comparison.arcs)
            is_marked = True
        axes.set_title(_title(each), fontsize=11)
    _finish(figure, panels, _legend(has_marks=is_marked))
    return figure


def _panels(
    count: int, maps: Sequence[GlobalMap], panel_in: float
) -> tuple[Figure, Sequence[Axes]]:
    """Return panels side by side in which all maps have room."""
    if not maps or not all(each.areas for each in maps):
        raise InvalidInput(f"{len(maps)} maps with {[len(m.areas) for m in maps]} areas to draw")
    low, high = _limits(maps)
    width, height = high - low
    scale = panel_in / max(width, height)
    size = (count * max(scale * width, 3.5) + 0.8, max(scale * height, 1.5) + _AROUND_IN)
    figure = Figure(figsize=size, layout="constrained")
    panels: Sequence[Axes] = figure.subplots(1, count, sharex=True, sharey=True, squeeze=False)[0]
    for axes in panels:
        axes.set(aspect="equal", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    return figure, panels


def _finish(figure: Figure, panels: Sequence[Axes], legend: list[Line2D]) -> None:
    for axes in panels:
        axes.set_xlabel("x / m")
        axes.grid(color="0.92", linewidth=0.6)
        axes.set_axisbelow(True)
    panels[0].set_ylabel("y / m")
    figure.legend(
        handles=legend,
        loc="outside lower center",
        ncols=max(1, int(figure.get_size_inches()[0] / _LEGEND_ENTRY_IN)),
        frameon=False,
    )


def check_image(path: Path) -> None:
    """Check that an image can be written there.

    Raises:
        InvalidInput: If there is no such image format.
        NotFound: If the folder of the image does not exist.
    """
    formats = FigureCanvasAgg.get_supported_filetypes()
    if path.suffix.lower().lstrip(".") not in formats:
        raise InvalidInput(f"image {path.name} in none of the formats {', '.join(sorted(formats))}")
    if not path.parent.is_dir():
        raise NotFound(f"folder {path.parent} of the image {path.name} does not exist")


def position_ellipse(reference_from_area: GaussianPose) -> tuple[float, float, float]:
    """Return the 95 % ellipse of a position in the x-y plane of the reference frame.

    Returns:
        Full length of the long axis (m), of the short axis (m), direction of the long axis (rad).
    """
    # The covariance is of a perturbation in the area's own frame: turn it into the reference frame.
    rotation = reference_from_area.mean[:3, :3]
    covariance = (rotation @ reference_from_area.covariance[3:, 3:] @ rotation.T)[:2, :2]
    variances, directions = np.linalg.eigh(covariance)
    short, long = 2.0 * np.sqrt(_CHI2_95_2 * np.maximum(variances, 0.0))
    return float(long), float(short), math.atan2(directions[1, 1], directions[0, 1])


def area_colours(maps: Sequence[GlobalMap]) -> Mapping[int, str]:
    """Return the colour of every area: the same in all maps, different between neighbours."""
    neighbours = defaultdict[int, set[int]](set)
    for each in maps:
        for arc in each.arcs:
            neighbours[arc.area_a].add(arc.area_b)
            neighbours[arc.area_b].add(arc.area_a)
    colours: dict[int, str] = {}
    for area in sorted({area.area for each in maps for area in each.areas}):
        taken = [colours[other] for other in neighbours[area] if other in colours]
        # Start at another colour for each area: otherwise the first few would cover the map.
        choices = [_COLOURS[(area + step) % len(_COLOURS)] for step in range(len(_COLOURS))]
        colours[area] = min(choices, key=taken.count)
    return colours


def _title(shown: GlobalMap) -> str:
    return (
        f"{_TITLES[shown.method]}, {len(shown.areas)} areas, {len(shown.arcs)} arcs\n"
        f"reference: area {shown.reference_area}, hypothesis {shown.hypothesis} "
        f"(probability {shown.probability:.3g}), revision {shown.revision}"
    )


def _legend(*, has_marks: bool = False, magnified: float = 1.0) -> list[Line2D]:
    """Return one sample of everything that stands in a panel."""
    ellipse = "95 % ellipse of the position"
    if magnified != 1.0:
        ellipse += f", {magnified:g} times as large"
    entries = [
        Line2D([], [], linestyle="none", marker="o", markersize=3.0, color=_INK, label="area"),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="s",
            markersize=8.0,
            color=_INK,
            fillstyle="none",
            label="reference area",
        ),
        Line2D([], [], color=_INK, linewidth=0.8, label="arc (×n: n traversals)"),
        Line2D(
            [],
            [],
            linestyle="none",
            marker="o",
            markersize=10.0,
            markerfacecolor=_SHADE,
            markeredgecolor=_INK,
            markeredgewidth=0.8,
            label=ellipse,
        ),
    ]
    if has_marks:
        label = "largest residuals of arcs"
        entries.append(Line2D([], [], color=_CONTRADICTION, linewidth=2.2, label=label))
    return entries


def _limits(maps: Sequence[GlobalMap]) -> tuple[FloatArray, FloatArray]:
    """Return the corners of the box around everything in all maps, each of shape (2,), m."""
    everything = []
    for each in maps:
        for area in each.areas:
            everything.append(area.reference_from_area.mean[:2, 3][None])
            everything.append(
                transform_points(area.reference_from_area.mean, area.points_in_area)[:, :2]
            )
    points = np.vstack(everything)
    return points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M


def _draw_points(axes: Axes, shown: GlobalMap, colours: Mapping[int, str]) -> None:
    for area in shown.areas:
        points = transform_points(area.reference_from_area.mean, area.points_in_area)
        axes.plot(
            *points[:, :2].T,
            linestyle="none",
            marker=".",
            markersize=1.6,
            markeredgewidth=0.0,
            color=colours[area.area],
            rasterized=True,
            zorder=1,
        )


def _draw_ellipses(axes: Axes, shown: GlobalMap, *, magnified: float = 1.0) -> None:
    ellipses = np.array([position_ellipse(area.reference_from_area) for area in shown.areas])
    at = np.array(list(_origins(shown).values()))
    axes.add_collection(
        EllipseCollection(
            magnified * ellipses[:, 0],
            magnified * ellipses[:, 1],
            np.degrees(ellipses[:, 2]),
            units="xy",
            offsets=at,
            offset_transform=axes.transData,
            facecolor=_SHADE,
            edgecolor=_INK,
            linewidth=0.8,
            zorder=3,
        ),
        autolim=False,
    )


def _draw_topology(axes: Axes, shown: GlobalMap) -> None:
    origins = _origins(shown)
    _draw_arcs(axes, shown.arcs, origins)
    at = np.array(list(origins.values()))
    axes.plot(*at.T, "o", markersize=3.0, color=_INK, zorder=4)
    axes.plot(
        *origins[shown.reference_area], "s", markersize=8.0, color=_INK, fillstyle="none", zorder=4
    )
    for identifier, origin in origins.items():
        axes.annotate(
            str(identifier),
            origin,
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=8 if len(origins) <= _CROWD else 6,
            fontweight="bold",
            color=_INK,
            path_effects=_HALO,
            zorder=6,
        )


def _origins(shown: GlobalMap) -> dict[int, _Position]:
    positions = ((area.area, area.reference_from_area.mean[:2, 3]) for area in shown.areas)
    return {area: (float(x), float(y)) for area, (x, y) in positions}


def _middle(a: _Position, b: _Position) -> _Position:
    return (a[0] + b[0]) / 2, (a[1] + b[1]) / 2


def _draw_arcs(axes: Axes, arcs: Sequence[Arc], origins: Mapping[int, _Position]) -> None:
    axes.add_collection(
        LineCollection(
            [(origins[arc.area_a], origins[arc.area_b]) for arc in arcs],
            colors=_INK,
            linewidths=[0.8 + 0.4 * min(arc.traversals - 1, 4) for arc in arcs],
            alpha=0.8,
            zorder=2,
        ),
        autolim=False,
    )
    for arc in arcs:
        if arc.traversals > 1:
            axes.annotate(
                f"×{arc.traversals}",
                _middle(origins[arc.area_a], origins[arc.area_b]),
                ha="center",
                va="center",
                fontsize=7,
                color=_INK,
                path_effects=_HALO,
                zorder=5,
            )


def _mark_contradictions(axes: Axes, shown: GlobalMap, residuals: Sequence[ArcResidual]) -> None:
    """Draw the arcs that the poses at their ends contradict most, with the residuals in m."""
    worst = sorted(residuals, key=lambda residual: residual.shortest_path_m)[-_MARKED_ARCS:]
    marked = [residual for residual in worst if residual.shortest_path_m >= _LEAST_MARKED_M]
    if not marked:
        return
    origins = _origins(shown)
    ends = [(origins[residual.area_a], origins[residual.area_b]) for residual in marked]
    axes.add_collection(
        LineCollection(
            ends,
            colors=_CONTRADICTION,
            linewidths=2.2,
            zorder=4,
        ),
        autolim=False,
    )
    for residual, (a, b) in zip(marked, ends, strict=True):
        axes.annotate(
            f"{residual.shortest_path_m:.2f} m",
            _middle(a, b),
            xytext=(0, -13),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            fontweight="bold",
            color=_CONTRADICTION,
            path_effects=_HALO,
            zorder=7,
        )
