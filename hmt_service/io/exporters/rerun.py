"""A map as Rerun recording: areas, arcs and trajectory in 3-D, and the topology as a graph.

Entities are `/map`, the frame of the reference area, and below it `areas/NUMBER` (its transform),
`areas/NUMBER/points` and `areas/NUMBER/label` in the frame of the area, `motions` and
`loop_closures` (what was measured between visits), `trajectory` (a line per visit) and `robot`
(the keyframes, on the timeline `sensor_time`); `/topology` is the graph of areas. Rerun keeps
coordinates in single precision. How sure positions are is not shown: map files hold no marginals.

The same map gives the same recording id and content, but not the same bytes: Rerun numbers rows by
the clock, and orders what it says of columns by chance.

References:
    https://rerun.io/docs/reference/types/archetypes (rerun-sdk, the extra `view`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Sequence
from colorsys import hsv_to_rgb
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray, Pose, quaternion_of
from hmt_service.core.stored import StoredFactor
from hmt_service.errors import InvalidInput, Unavailable
from hmt_service.io.placed_map import PlacedMap
from hmt_service.io.whole_files import whole_files

if TYPE_CHECKING:
    from rerun import AsComponents
    from rerun.chunk import Chunk

APPLICATION = "hmt-service"
"""Application that the viewer lists recordings under."""
TIMELINE = "sensor_time"
"""Timeline of the sensor's stamps."""
_MOTION_RGB, _LOOP_RGB = (150, 150, 150), (230, 159, 0)
# Steps along the circle of hues that keep any number of areas apart.
_GOLDEN_SHARE = 0.618034
_ROBOT_RADIUS_M = 0.2
# Rerun counts nanoseconds from 1970 in 64 bits, which end in 2262.
_LAST_S = 9.2e9


def export_rerun(placed: PlacedMap, path: Path) -> None:
    """Write areas, arcs, trajectory and topology.

    Raises:
        InvalidInput: If a stamp is beyond what Rerun counts, 292 years from 1970.
        Unavailable: If rerun-sdk is not installed, or cannot write.
    """
    try:
        from rerun.chunk import LazyChunkStream
    except ImportError as error:
        raise Unavailable(
            f"rrd needs rerun-sdk ({error}): pip install 'hmt-service[view]'"
        ) from error
    chunks = [*_areas(placed), *_arcs(placed), *_trajectory(placed), _topology(placed)]
    with whole_files(path) as (part,):
        # Not a stream that saves in the background: on a full disk that one waits forever.
        try:
            LazyChunkStream.from_iter(chunks).write_rrd(
                part, application_id=APPLICATION, recording_id=recording_id(placed)
            )
        except RuntimeError as error:
            raise Unavailable(f"{path} not written: {error}") from error


def recording_id(placed: PlacedMap) -> str:
    """Return a name that follows from what is shown: recordings of one name are one to Rerun."""
    shown = f"{placed.hypothesis.hypothesis} {placed.reference_area} {placed.stored.config_json}"
    digest = hashlib.sha256(shown.encode())
    digest.update(np.array([k.stamp_s for k in placed.stored.keyframes]).tobytes())
    digest.update(placed.reference_from_keyframe.tobytes())
    return f"map-{digest.hexdigest()[:16]}"


def _areas(placed: PlacedMap) -> Iterator[Chunk]:
    import rerun as rr

    yield _static("/map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    for area, points in placed.submaps().items():
        pose, entity = placed.reference_from_visit[area], f"/map/areas/{area}"
        yield _static(entity, transform_of(pose))
        yield _static(f"{entity}/points", rr.Points3D(points, colors=[colour_of(area)]))
        yield _static(f"{entity}/label", label_of(area))


def _arcs(placed: PlacedMap) -> Iterator[Chunk]:
    """Yield arcs of consecutive visits, and all others, as lines between anchors."""
    import rerun as rr

    arcs = _measured(placed)
    motions = [arc for arc in arcs if abs(arc.visit_b - arc.visit_a) == 1]
    loops = [arc for arc in arcs if abs(arc.visit_b - arc.visit_a) > 1]
    for name, chosen, colour in (
        ("motions", motions, _MOTION_RGB),
        ("loop_closures", loops, _LOOP_RGB),
    ):
        lines = [
            np.array(
                [placed.reference_from_visit[end][:3, 3] for end in (arc.visit_a, arc.visit_b)]
            )
            for arc in chosen
        ]
        yield _static(f"/map/{name}", rr.LineStrips3D(lines, colors=[colour]))


def _trajectory(placed: PlacedMap) -> Iterator[Chunk]:
    import rerun as rr
    from rerun.chunk import Chunk

    poses = placed.reference_from_keyframe
    lines: list[FloatArray] = [
        poses[v.first_keyframe : v.last_keyframe + 1, :3, 3] for v in placed.stored.visits
    ]
    colours = [colour_of(placed.area_of[visit.visit]) for visit in placed.stored.visits]
    yield _static("/map/trajectory", rr.LineStrips3D(lines, colors=colours))
    stamps_s = np.array([keyframe.stamp_s for keyframe in placed.stored.keyframes[: len(poses)]])
    stamps = times_of(stamps_s)
    moves = rr.Transform3D.columns(
        translation=poses[:, :3, 3], quaternion=[quaternion_of(pose) for pose in poses]
    )
    yield Chunk.from_columns("/map/robot", [rr.TimeColumn(TIMELINE, timestamp=stamps)], moves)
    yield _static("/map/robot", rr.Points3D([[0.0, 0.0, 0.0]], radii=[_ROBOT_RADIUS_M]))


def _topology(placed: PlacedMap) -> Chunk:
    ends = ((placed.area_of[arc.visit_a], placed.area_of[arc.visit_b]) for arc in _measured(placed))
    pairs = sorted({(min(pair), max(pair)) for pair in ends if pair[0] != pair[1]})
    areas = sorted(set(placed.area_of.values()))
    return _static("/topology", *topology_of(areas, pairs, [name_of(area) for area in areas]))


def _measured(placed: PlacedMap) -> list[StoredFactor]:
    """Return the arcs that say anything: not those that only join a session to the map."""
    # Loads the compiler of the core, which the registry of formats need not wait for.
    from hmt_service.core.awakening import is_anywhere

    return [arc for arc in placed.hypothesis.factors if not is_anywhere(arc.a_from_b)]


def _static(entity: str, *contents: AsComponents) -> Chunk:
    """Return what is there at all times."""
    from rerun.chunk import Chunk

    batches = [batch for content in contents for batch in content.as_component_batches()]
    columns = [batch.partition([len(batch.as_arrow_array())]) for batch in batches]
    return Chunk.from_columns(entity, [], columns)


def transform_of(pose: Pose) -> AsComponents:
    """Return a pose, shape (4, 4), in Rerun's words."""
    import rerun as rr

    return rr.Transform3D(
        translation=pose[:3, 3], quaternion=rr.Quaternion(xyzw=quaternion_of(pose))
    )


def label_of(area: int) -> AsComponents:
    """Return the name of an area at the origin of its frame."""
    import rerun as rr

    return rr.Points3D([[0.0, 0.0, 0.0]], colors=[colour_of(area)], labels=[name_of(area)])


def topology_of(
    areas: Sequence[int], pairs: Iterable[tuple[int, int]], labels: Sequence[str]
) -> tuple[AsComponents, AsComponents]:
    """Return nodes and edges of the graph of areas.

    Args:
        areas: The nodes.
        pairs: Areas that an edge joins.
        labels: What is written on each node.
    """
    import rerun as rr

    nodes = rr.GraphNodes(
        [str(area) for area in areas],
        labels=labels,
        colors=[colour_of(area) for area in areas],
    )
    edges = rr.GraphEdges([(str(a), str(b)) for a, b in pairs], graph_type="undirected")
    return nodes, edges


def times_of(stamps_s: FloatArray) -> npt.NDArray[np.datetime64]:
    """Return stamps on the timeline, shape (N,).

    Raises:
        InvalidInput: If one is beyond what Rerun counts, 292 years from 1970.
    """
    if not (np.abs(stamps_s) < _LAST_S).all():
        raise InvalidInput(f"stamps from {stamps_s.min()} to {stamps_s.max()} s do not fit Rerun")
    return np.round(1e9 * stamps_s).astype("datetime64[ns]")


def name_of(area: int) -> str:
    """Return what an area is called."""
    return f"area {area}"


def colour_of(area: int) -> tuple[int, int, int]:
    """Return red, green and blue in [0, 255]: a colour that few other areas have."""
    red, green, blue = hsv_to_rgb(area * _GOLDEN_SHARE % 1.0, 0.6, 0.95)
    return round(255 * red), round(255 * green), round(255 * blue)
