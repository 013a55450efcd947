"""What is believed, drawn in Rerun: maps of competing hypotheses, the belief over time, the robot.

Entities: `/map` is the frame of the reference area in the hypothesis that is shown, with `areas`,
`arcs`, `path` and `robot`; `/rivals/1` and so on are the most probable others in the same way;
`/topology` is the graph of areas, `/posterior` a table, `/belief` holds the time series and
`/events` what was decided. Maps are always as they are now, and only what has changed is logged;
robot, belief and events are on the timeline of the sensor.

References:
    https://rerun.io/docs/reference/types (rerun-sdk, the extra `view`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.archetypes import ForceCollisionRadius, ForceLink, ForceManyBody

from hmt_service.core.geometry import FloatArray, Pose, identity, quaternion_of, transform_points
from hmt_service.core.types import (
    Belief,
    Event,
    EventKind,
    GlobalMap,
    PlacedArea,
    Posterior,
    StampedPose,
)
from hmt_service.io.exporters.rerun import (
    APPLICATION,
    TIMELINE,
    colour_of,
    label_of,
    name_of,
    times_of,
    topology_of,
    transform_of,
)

RIVALS = 3
"""Other hypotheses that are drawn at most."""
_CHI2_95 = (0.0, 3.841, 5.991, 7.815)
"""95 % quantiles of the chi-squared distribution by degrees of freedom."""
_FLAT_M2 = 1e-7
"""Variance of a direction that a planar map does not have, m^2."""
_POINT, _ARC, _PATH = 1.2, 1.5, 1.0
"""Sizes on the screen, points of the user interface."""
_ARC_RGB, _PATH_RGB, _ROBOT_RGB = (160, 160, 160), (90, 180, 255), (255, 90, 0)
_TITLE_RGB = (0, 114, 178)
_HEADING_M = 0.8
_ROBOT_RADIUS_M = 0.2
_EDGE, _REPULSION = 120.0, -150.0
"""Length of edges of the topology, points of the user interface, and how nodes shun each other."""
_LEAST_SHOWN = 0.01
"""Probability from which that of the current area is written on a node."""
_TITLE_SHARE = 0.05
_TILT = 0.35
_WIDE = 2.0
"""How far the eye leans, as a share of its distance, and width over height of most views."""


@dataclass(frozen=True, slots=True)
class Track:
    """Where the robot was."""

    stamps_s: FloatArray
    """Sensor times, shape (N,)."""
    reference_from_body: FloatArray
    """Poses in the frame of the map, shape (N, 4, 4)."""

    @classmethod
    def of(cls, poses: Sequence[StampedPose]) -> Self:
        """Return the track of some poses."""
        return cls(
            np.array([pose.stamp_s for pose in poses]),
            np.array([pose.reference_from_body for pose in poses]).reshape(-1, 4, 4),
        )


class View:
    """One recording of a belief; the caller says where it goes."""

    def __init__(self, name: str) -> None:
        """Begin an empty recording.

        Args:
            name: What the viewer calls it.
        """
        self._recording = rr.RecordingStream(APPLICATION)
        # One timeline, that of the sensor: when something was drawn says nothing.
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        self._recording.send_recording_name(name)
        self._logged: dict[str, object] = {}
        self._areas: dict[str, set[int]] = {}
        self._series: dict[str, float] = {}

    def connect(self, url: str) -> None:
        """Send everything, also what was drawn before, to a viewer or a server of viewers."""
        self._recording.connect_grpc(url)

    def stream(self) -> Callable[[], bytes]:
        """Return what returns a recording of everything that was drawn since it was last called."""
        stream = rr.binary_stream(self._recording)
        return lambda: stream.read() or b""

    def save(self, path: Path) -> None:
        """Have everything written to a file as it is drawn; when the disk is full that waits."""
        self._recording.save(path)

    def disconnect(self) -> None:
        """Send what is left, and nothing more."""
        self._recording.disconnect()

    def arrange(self, titles: Sequence[str], shown: GlobalMap | None = None) -> None:
        """Say which views there are and where the eye is.

        Args:
            titles: A title for the map that is shown, and for each rival that there may ever be.
            shown: The map that the eye is on; None where it grows: the viewer follows it.
        """
        main = rrb.Spatial3DView(origin="/map", name=titles[0], eye_controls=_eye_on(shown, _WIDE))
        # One is as high as the map beside it, more are on top of each other.
        aspect = 1.0 if len(titles) == 2 else _WIDE
        rivals = [
            rrb.Spatial3DView(
                origin=f"/rivals/{number}", name=title, eye_controls=_eye_on(shown, aspect)
            )
            for number, title in enumerate(titles[1:], start=1)
        ]
        maps_row = rrb.Horizontal(main)
        if rivals:
            maps_row = rrb.Horizontal(main, rrb.Vertical(*rivals), column_shares=[2, 1])
        now = rrb.Horizontal(
            rrb.GraphView(
                origin="/topology",
                name="topology",
                force_link=ForceLink(distance=_EDGE),
                force_many_body=ForceManyBody(strength=_REPULSION),
                force_collision_radius=ForceCollisionRadius(enabled=True),
            ),
            rrb.TextDocumentView(origin="/posterior", name="hypotheses"),
            rrb.TextLogView(origin="/events", name="decisions"),
            column_shares=[1, 1, 2],
        )
        over_time = rrb.Horizontal(
            _series_view("/belief/topologies", "posterior of the topologies"),
            _series_view("/belief/areas", "current area"),
            _series_view("/belief/ess", "effective sample size"),
        )
        blueprint = rrb.Blueprint(
            rrb.Vertical(maps_row, now, over_time, row_shares=[5, 2, 2]),
            rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            auto_views=False,
        )
        self._recording.send_blueprint(blueprint)

    def show_maps(self, maps: Sequence[GlobalMap]) -> None:
        """Draw the map that is shown and its rivals, as far as they have changed.

        Args:
            maps: The one that is shown first; with points.
        """
        self._show_map("/map", maps[0])
        for number in range(1, RIVALS + 1):
            entity = f"/rivals/{number}"
            if number < len(maps):
                self._show_map(entity, maps[number])
            elif entity in self._areas:
                self._hide_map(entity)

    def show_path(self, track: Track) -> None:
        """Draw where the robot was in the map that is shown, as one line."""
        line = track.reference_from_body[:, :3, 3]
        content = rr.LineStrips3D([line], colors=[_PATH_RGB], radii=rr.Radius.ui_points(_PATH))
        self._log("/map/path", line.tobytes(), content)

    def show_robot(self, track: Track) -> None:
        """Draw the robot in the map that is shown, at each of some times."""
        self._show_body()
        poses = track.reference_from_body
        if not len(poses):
            return
        self._recording.send_columns(
            "/map/robot",
            [rr.TimeColumn(TIMELINE, timestamp=times_of(track.stamps_s))],
            rr.Transform3D.columns(
                translation=poses[:, :3, 3], quaternion=[quaternion_of(pose) for pose in poses]
            ),
        )

    def show_posterior(self, posterior: Posterior) -> None:
        """Write the hypotheses that there are now as a table."""
        rows = [
            f"| {h.hypothesis} | {h.probability:.4f} | {h.areas} | {h.loop_closures} "
            f"| {h.current_area} |"
            for h in posterior.hypotheses
        ]
        head = ["| hypothesis | probability | areas | loops | robot in |", "|---|---|---|---|---|"]
        text = "\n".join([*head, *rows, "", f"revision {posterior.revision}"])
        self._log("/posterior", text, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def show_topology(self, shown: GlobalMap, current_area: Mapping[int, float]) -> None:
        """Draw the graph of areas, with how probably the robot is in each of them."""
        areas = [area.area for area in shown.areas]
        probabilities = [current_area.get(area, 0.0) for area in areas]
        labels = [
            f"{name_of(area)}: {p:.2f}" if p >= _LEAST_SHOWN else name_of(area)
            for area, p in zip(areas, probabilities, strict=True)
        ]
        pairs = [(arc.area_a, arc.area_b) for arc in shown.arcs]
        self._log("/topology", (tuple(labels), tuple(pairs)), *topology_of(areas, pairs, labels))

    def show_beliefs(self, beliefs: Sequence[Belief]) -> None:
        """Draw what was believed over time, later than what was drawn before."""
        if not beliefs:
            return
        series: dict[str, list[tuple[float, float]]] = {}
        for belief in beliefs:
            now = {"/belief/ess": belief.effective_sample_size}
            for h, probability in belief.hypotheses.items():
                now[f"/belief/topologies/{h}"] = probability
            for area, probability in belief.current_area.items():
                now[f"/belief/areas/{area}"] = probability
            # What is gone has no probability any more: its line ends at zero.
            ended = {entity: 0.0 for entity, last in self._series.items() if last > 0.0}
            for entity, value in {**ended, **now}.items():
                if entity not in self._series:
                    self._begin_series(entity)
                self._series[entity] = value
                series.setdefault(entity, []).append((belief.stamp_s, value))
        for entity, values in series.items():
            stamps_s, numbers = np.array(values).T
            self._recording.send_columns(
                entity,
                [rr.TimeColumn(TIMELINE, timestamp=times_of(stamps_s))],
                rr.Scalars.columns(scalars=numbers),
            )

    def show_events(self, events: Iterable[Event]) -> None:
        """Write what was decided."""
        for event in events:
            self._recording.set_time(TIMELINE, timestamp=times_of(np.array([event.stamp_s]))[0])
            level = "WARN" if event.kind is EventKind.LOST else "INFO"
            text = f"{event.kind}: {event.message}"
            self._recording.log("/events", rr.TextLog(text, level=level))

    def _show_map(self, entity: str, shown: GlobalMap) -> None:
        self._log(entity, "", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        known = self._areas.setdefault(entity, set())
        now = {area.area for area in shown.areas}
        for gone in known - now:
            self._hide_area(f"{entity}/areas/{gone}")
        self._areas[entity] = now
        for area in shown.areas:
            self._show_area(f"{entity}/areas/{area.area}", area)
        origins = {area.area: area.reference_from_area.mean[:3, 3] for area in shown.areas}
        lines = np.array([[origins[arc.area_a], origins[arc.area_b]] for arc in shown.arcs])
        widths = [_ARC * (1.0 + 0.5 * min(arc.traversals - 1, 4)) for arc in shown.arcs]
        self._show_title(f"{entity}/title", shown)
        self._log(
            f"{entity}/arcs",
            (lines.tobytes(), tuple(widths)),
            rr.LineStrips3D(
                lines.reshape(-1, 2, 3), colors=[_ARC_RGB], radii=rr.Radius.ui_points(widths)
            ),
        )

    def _show_title(self, entity: str, shown: GlobalMap) -> None:
        """Write which hypothesis that is and how probable, north of the map."""
        low, high = _extent(shown)
        at = [(low[0] + high[0]) / 2.0, high[1] + _TITLE_SHARE * (high[1] - low[1]), high[2]]
        text = f"hypothesis {shown.hypothesis}: {shown.probability:.4f}"
        label = rr.Points3D([at], labels=[text], colors=[_TITLE_RGB], show_labels=True)
        self._log(entity, (text, *at), label)

    def _show_area(self, entity: str, area: PlacedArea) -> None:
        pose, covariance = area.reference_from_area.mean, area.reference_from_area.covariance
        self._log(entity, pose.tobytes(), transform_of(pose))
        points, colour = area.points_in_area, colour_of(area.area)
        self._log(
            f"{entity}/points",
            area.version,
            rr.Points3D(points, colors=[colour], radii=rr.Radius.ui_points(_POINT)),
        )
        self._log(f"{entity}/label", area.area, label_of(area.area))
        half_sizes, quaternion = ellipsoid_of(covariance[3:, 3:])
        self._log(
            f"{entity}/ellipsoid",
            covariance[3:, 3:].tobytes(),
            rr.Ellipsoids3D(
                half_sizes=[half_sizes],
                quaternions=[rr.Quaternion(xyzw=quaternion)],
                colors=[(*colour, 90)],
                fill_mode=rr.components.FillMode.TransparentFillMajorWireframe,
            ),
        )

    def _hide_map(self, entity: str) -> None:
        for area in self._areas.pop(entity):
            self._hide_area(f"{entity}/areas/{area}")
        self._log(f"{entity}/arcs", None, rr.LineStrips3D([]))
        self._log(f"{entity}/title", None, rr.Points3D([], labels=[]))

    def _hide_area(self, entity: str) -> None:
        # What is static is replaced, and never cleared.
        self._log(f"{entity}/points", None, rr.Points3D([]))
        self._log(f"{entity}/label", None, rr.Points3D([], labels=[]))
        self._log(f"{entity}/ellipsoid", None, rr.Ellipsoids3D(half_sizes=[]))

    def _show_body(self) -> None:
        body = rr.Points3D([[0.0, 0.0, 0.0]], colors=[_ROBOT_RGB], radii=[_ROBOT_RADIUS_M])
        heading = rr.Arrows3D(vectors=[[_HEADING_M, 0.0, 0.0]], colors=[_ROBOT_RGB])
        self._log("/map/robot/body", "", body)
        self._log("/map/robot/heading", "", heading)

    def _begin_series(self, entity: str) -> None:
        last = entity.rpartition("/")[2]
        name = f"hypothesis {last}" if "topologies" in entity else f"area {last}"
        colour = colour_of(int(last)) if last.isdecimal() else _ARC_RGB
        lines = rr.SeriesLines(
            names=name if last.isdecimal() else "effective sample size",
            colors=[colour],
            interpolation_mode=rr.components.InterpolationMode.StepAfter,
            # The mean of a jump is nothing that was ever believed.
            aggregation_policy=rr.components.AggregationPolicy.Off,
        )
        self._log(entity, "", lines)

    def _log(self, entity: str, version: object, *contents: rr.AsComponents) -> None:
        """Log what is there from now on, unless the same version of it is there already."""
        if entity in self._logged and self._logged[entity] == version:
            return
        self._logged[entity] = version
        self._recording.log(entity, *contents, static=True)


def ellipsoid_of(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the 95 % ellipsoid of a position, an ellipse where the map is planar.

    Args:
        covariance: Of the position, shape (3, 3), m^2.

    Returns:
        Half its axes, shape (3,), m, and the rotation to them as qx, qy, qz, qw.
    """
    variances, directions = np.linalg.eigh(covariance)
    quantile = _CHI2_95[int((variances > _FLAT_M2).sum())]
    axes_from_ellipsoid: Pose = identity()
    axes_from_ellipsoid[:3, :3] = directions * np.sign(np.linalg.det(directions))
    return np.sqrt(quantile * np.maximum(variances, 0.0)), quaternion_of(axes_from_ellipsoid)


def _series_view(entity: str, name: str) -> rrb.TimeSeriesView:
    """Return a view of all that was, not of the moments around the cursor."""
    everything = rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())
    return rrb.TimeSeriesView(
        origin=entity,
        name=name,
        axis_x=rrb.TimeAxis(view_range=everything),
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _eye_on(shown: GlobalMap | None, aspect: float) -> rrb.EyeControls3D | None:
    """Return an eye that sees all of a map from above, a little from the south.

    Args:
        shown: The map; None to leave it to the viewer.
        aspect: Width over height of the view.
    """
    if shown is None:
        return None
    low, high = _extent(shown)
    middle, (width, depth, height) = (low + high) / 2.0, high - low
    above = np.array([0.0, -_TILT, 1.0]) * (max(width / aspect, depth, 1.0) + height)
    return rrb.EyeControls3D(position=middle + above, look_target=middle, eye_up=(0.0, 0.0, 1.0))


def _extent(shown: GlobalMap) -> tuple[FloatArray, FloatArray]:
    """Return the corners of the box around a map, each of shape (3,), m."""
    points = np.vstack(
        [transform_points(a.reference_from_area.mean, a.points_in_area) for a in shown.areas]
        + [a.reference_from_area.mean[None, :3, 3] for a in shown.areas]
    )
    return points.min(axis=0), points.max(axis=0)
