"""What is drawn in Rerun, read by Rerun's own reader."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import Chunk, RrdReader

from hmt_service.core.geometry import FloatArray, pose_of, transform_points
from hmt_service.core.types import Belief, Event, EventKind, GlobalMap, MapMethod
from hmt_service.errors import NotFound
from hmt_service.io.exporters.rerun import TIMELINE
from hmt_service.io.map_file import write_map
from hmt_service.viz.saved_view import read_view
from hmt_service.viz.view import View, ellipsoid_of
from tests.mapped import doubted_map, mapped, saved_run_in


def chunks_of(recorded: bytes, folder: Path) -> dict[str, list[Chunk]]:
    path = folder / "view.rrd"
    path.write_bytes(recorded)
    found: dict[str, list[Chunk]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        found.setdefault(chunk.entity_path, []).append(chunk)
    return found


def drawn(draw: Callable[[View], object], folder: Path) -> dict[str, list[Chunk]]:
    """Return what is drawn, by entity."""
    view = View("test")
    stream = view.stream()
    draw(view)
    return chunks_of(stream(), folder)


def ordered(chunks: list[Chunk]) -> list[Any]:
    """Return chunks in the order in which they were logged, which is not that of a file."""
    batches = [chunk.to_record_batch() for chunk in chunks]
    return sorted(batches, key=lambda batch: batch.column("rerun.controls.RowId")[0].as_py())


def rows_of(chunks: list[Chunk], name: str) -> list[Any]:
    """Return what was logged of a component, in the order in which it was."""
    batches = ordered(chunks)
    columns = [batch.column(name) for batch in batches if name in batch.schema.names]
    return [row for column in columns for row in column.to_pylist()]


def series(chunks: list[Chunk]) -> list[tuple[float, float]]:
    """Return stamps (s) and values."""
    times = [
        1e-9 * stamp
        for batch in ordered([chunk for chunk in chunks if not chunk.is_static])
        for stamp in batch.column(TIMELINE).cast("int64").to_pylist()
    ]
    values = [value for (value,) in rows_of(chunks, "Scalars:scalars")]
    return sorted(zip(times, values, strict=True))


def flat_map() -> GlobalMap:
    return mapped().global_map(MapMethod.CONSISTENT)


@pytest.mark.parametrize("planar", [True, False])
def test_ellipsoid_holds_95_percent_of_sampled_positions(planar: bool) -> None:
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(3, 3))
    covariance: FloatArray = factor @ factor.T
    if planar:
        covariance[2], covariance[:, 2], covariance[2, 2] = 0.0, 0.0, 1e-8
    half_sizes, quaternion = ellipsoid_of(covariance)
    axes = pose_of(quaternion, np.zeros(3))[:3, :3]
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20_000) @ axes
    sizes = np.where(half_sizes > 1e-3, half_sizes, np.inf)
    # Five standard errors of a share of 20,000 draws.
    assert np.mean((samples**2 / sizes**2).sum(axis=1) <= 1.0) == pytest.approx(0.95, abs=0.008)


def test_certain_position_has_an_ellipsoid_without_size() -> None:
    assert ellipsoid_of(np.zeros((3, 3)))[0].tolist() == [0.0, 0.0, 0.0]


def test_areas_are_where_the_map_has_them_with_their_uncertainty(tmp_path: Path) -> None:
    known = flat_map()
    found = drawn(lambda view: view.show_maps([known]), tmp_path)
    for area in known.areas:
        entity = f"/map/areas/{area.area}"
        ((translation,),) = rows_of(found[entity], "Transform3D:translation")
        ((quaternion,),) = rows_of(found[entity], "Transform3D:quaternion")
        (points,) = rows_of(found[f"{entity}/points"], "Points3D:positions")
        reference_from_area = area.reference_from_area.mean
        np.testing.assert_allclose(
            transform_points(pose_of(np.array(quaternion), np.array(translation)), points),
            transform_points(reference_from_area, area.points_in_area),
            atol=2e-5,
        )
        ((half_sizes,),) = rows_of(found[f"{entity}/ellipsoid"], "Ellipsoids3D:half_sizes")
        expected = ellipsoid_of(area.reference_from_area.covariance[3:, 3:])[0]
        np.testing.assert_allclose(half_sizes, expected, rtol=1e-5)
    (lines,) = rows_of(found["/map/arcs"], "LineStrips3D:strips")
    assert len(lines) == len(known.arcs) == 1
    assert rows_of(found["/map/title"], "Points3D:labels") == [
        [f"hypothesis {known.hypothesis}: 1.0000"]
    ]


def test_only_what_has_changed_is_drawn_again(tmp_path: Path) -> None:
    known = flat_map()
    view = View("test")
    stream = view.stream()
    view.show_maps([known])
    assert "/map/areas/1/points" in chunks_of(stream(), tmp_path)
    view.show_maps([known])
    assert stream() == b""
    moved = replace(known.areas[1], reference_from_area=known.areas[0].reference_from_area)
    view.show_maps([replace(known, areas=(known.areas[0], moved))])
    again = {"/map/areas/1", "/map/areas/1/ellipsoid", "/map/arcs", "/map/title"}
    assert again == set(chunks_of(stream(), tmp_path)) - {"/__properties"}


def test_areas_and_rivals_that_are_gone_are_not_shown_any_more(tmp_path: Path) -> None:
    known = flat_map()
    less = replace(known, areas=known.areas[:1], arcs=())

    def draw(view: View) -> None:
        view.show_maps([known, known])
        view.show_maps([less])

    found = drawn(draw, tmp_path)
    for entity in ("/map/areas/1/points", "/rivals/1/areas/0/points", "/rivals/1/areas/1/points"):
        assert rows_of(found[entity], "Points3D:positions")[-1] == []
    assert rows_of(found["/map/areas/0/points"], "Points3D:positions")[-1] != []


def test_a_belief_that_is_gone_ends_at_zero(tmp_path: Path) -> None:
    beliefs = [
        Belief(10.0, {0: 1.0}, 1.0, {3: 1.0}),
        Belief(12.0, {0: 0.25, 4: 0.75}, 1.6, {5: 0.25, 6: 0.75}),
        Belief(13.0, {4: 1.0}, 1.0, {6: 1.0}),
    ]

    def draw(view: View) -> None:
        view.show_beliefs(beliefs[:2])
        view.show_beliefs(beliefs[2:])
        view.show_events([Event(EventKind.PRUNED, 13.0, "dropped hypothesis 5")])

    found = drawn(draw, tmp_path)
    assert series(found["/belief/topologies/3"]) == [(10.0, 1.0), (12.0, 0.0)]
    assert series(found["/belief/topologies/5"]) == [(12.0, 0.25), (13.0, 0.0)]
    assert series(found["/belief/topologies/6"]) == [(12.0, 0.75), (13.0, 1.0)]
    assert series(found["/belief/areas/0"]) == [(10.0, 1.0), (12.0, 0.25), (13.0, 0.0)]
    assert series(found["/belief/ess"]) == [(10.0, 1.0), (12.0, 1.6), (13.0, 1.0)]
    assert rows_of(found["/events"], "TextLog:text") == [["pruned: dropped hypothesis 5"]]


def test_a_saved_run_shows_rivals_history_and_robot(tmp_path: Path) -> None:
    seen = read_view(saved_run_in(tmp_path / "flat"))
    found = drawn(seen.draw, tmp_path)
    assert [round(shown.probability, 6) for shown in seen.maps] == [0.8, 0.2]
    (title,) = rows_of(found["/rivals/1/title"], "Points3D:labels")[0]
    assert title == f"hypothesis {seen.maps[1].hypothesis}: 0.2000"
    assert len(seen.maps[1].areas) == 3
    assert "/rivals/1/areas/2/points" in found
    assert [value for _, value in series(found["/belief/ess"])][-1] == pytest.approx(1 / 0.68)
    path = mapped().trajectory()
    translations = [row for (row,) in rows_of(found["/map/robot"], "Transform3D:translation")]
    np.testing.assert_allclose(
        translations, [pose.reference_from_body[:3, 3] for pose in path], atol=0.02
    )
    ((table,),) = rows_of(found["/posterior"], "TextDocument:text")
    assert "| 0.8000 | 2 |" in table
    (labels,) = rows_of(found["/topology"], "GraphNodes:labels")
    assert labels == ["area 0: 0.80", "area 1"]


def test_another_hypothesis_can_be_shown_and_a_missing_one_not(tmp_path: Path) -> None:
    folder = saved_run_in(tmp_path / "flat")
    best, rival = doubted_map().hypotheses
    shown = read_view(folder, hypothesis=rival.hypothesis).maps
    assert [each.hypothesis for each in shown] == [rival.hypothesis, best.hypothesis]
    with pytest.raises(NotFound, match=r"hypothesis 99 is not one of \["):
        read_view(folder / "map.hmt", hypothesis=99)


def test_history_of_another_map_beside_a_file_is_left_out(tmp_path: Path) -> None:
    folder = saved_run_in(tmp_path / "flat")
    write_map(folder / "map.hmt", mapped().stored())
    assert read_view(folder).beliefs == ()
