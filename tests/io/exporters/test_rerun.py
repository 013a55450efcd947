"""Rerun recordings, read by Rerun's own reader."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import Chunk, LazyChunkStream, RrdReader

from hmt_service.core.geometry import FloatArray, pose_of, transform_points
from hmt_service.errors import InvalidInput, Unavailable
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.registry import export_map
from hmt_service.io.exporters.rerun import TIMELINE, recording_id
from hmt_service.io.map_file import read_map
from hmt_service.io.placed_map import PlacedMap
from tests.mapped import map_file_in, mapped


def placed_map(folder: Path, reference: int | None = None) -> PlacedMap:
    return PlacedMap.of(read_map(map_file_in(folder)), reference_area=reference)


def exported(folder: Path, reference: int | None = None) -> Path:
    path = folder / "map.rrd"
    export_map(map_file_in(folder), path, Format.RRD, reference_area=reference)
    return path


def chunks_in(path: Path) -> dict[str, list[Chunk]]:
    """Return what every entity holds."""
    found: dict[str, list[Chunk]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        found.setdefault(chunk.entity_path, []).append(chunk)
    return found


def column(chunks: list[Chunk], name: str) -> list[Any]:
    """Return the rows of the one column of that name."""
    batches = [chunk.to_record_batch() for chunk in chunks]
    (rows,) = [batch.column(name) for batch in batches if name in batch.schema.names]
    return list(rows.to_pylist())


def numbers(chunks: list[Chunk], name: str) -> FloatArray:
    return np.array(column(chunks, name), dtype=np.float64)


@pytest.mark.parametrize("reference", [None, 1])
def test_points_of_areas_are_where_the_map_has_them(tmp_path: Path, reference: int | None) -> None:
    found = chunks_in(exported(tmp_path, reference))
    expected = placed_map(tmp_path, reference).points_in_areas()
    assert len(expected) > 1
    for area, known in expected.items():
        entity = f"/map/areas/{area}"
        (translation,) = numbers(found[entity], "Transform3D:translation")[0]
        (quaternion,) = numbers(found[entity], "Transform3D:quaternion")[0]
        (points,) = numbers(found[f"{entity}/points"], "Points3D:positions")
        placed = transform_points(pose_of(quaternion, translation), points)
        np.testing.assert_allclose(placed, known, atol=2e-5)
        assert column(found[f"{entity}/label"], "Points3D:labels") == [[f"area {area}"]]
        assert all(chunk.is_static for chunk in [*found[entity], *found[f"{entity}/points"]])
    colours = [column(found[f"/map/areas/{a}/points"], "Points3D:colors")[0][0] for a in expected]
    assert len(set(colours)) == len(expected)


def test_robot_is_at_its_keyframes_at_their_stamps(tmp_path: Path) -> None:
    found, placed = chunks_in(exported(tmp_path)), placed_map(tmp_path)
    (moving,) = [chunk for chunk in found["/map/robot"] if not chunk.is_static]
    stamps = moving.to_record_batch().column(TIMELINE).cast("int64").to_pylist()
    known_s = [keyframe.stamp_s for keyframe in mapped().stored().keyframes]
    np.testing.assert_allclose(1e-9 * np.array(stamps), known_s, atol=1e-6)
    translations = numbers([moving], "Transform3D:translation")[:, 0]
    quaternions = numbers([moving], "Transform3D:quaternion")[:, 0]
    poses = np.array([pose_of(q, t) for q, t in zip(quaternions, translations, strict=True)])
    np.testing.assert_allclose(poses, placed.reference_from_keyframe, atol=1e-5)
    (lines,) = column(found["/map/trajectory"], "LineStrips3D:strips")
    assert len(lines) == len(placed.stored.visits)
    np.testing.assert_allclose(np.concatenate(lines), poses[:, :3, 3], atol=1e-5)


def test_lines_join_the_anchors_of_measured_arcs(tmp_path: Path) -> None:
    found, placed = chunks_in(exported(tmp_path)), placed_map(tmp_path)
    (motions,) = column(found["/map/motions"], "LineStrips3D:strips")
    (loops,) = column(found["/map/loop_closures"], "LineStrips3D:strips")
    pairs = [(arc.visit_a, arc.visit_b) for arc in placed.hypothesis.factors]
    assert (0, 1) in pairs
    assert (0, 2) in pairs
    for drawn, is_motion in ((motions, True), (loops, False)):
        chosen = [pair for pair in pairs if (pair[1] - pair[0] == 1) is is_motion]
        known = [[placed.reference_from_visit[end][:3, 3] for end in pair] for pair in chosen]
        np.testing.assert_allclose(drawn, known, atol=1e-5)
    colours = [
        column(found[f"/map/{n}"], "LineStrips3D:colors") for n in ("motions", "loop_closures")
    ]
    assert colours[0] != colours[1]


def test_topology_is_a_graph_of_areas(tmp_path: Path) -> None:
    (topology,) = chunks_in(exported(tmp_path))["/topology"]
    assert column([topology], "GraphNodes:node_ids") == [["0", "1"]]
    assert column([topology], "GraphEdges:edges") == [[{"first": "0", "second": "1"}]]


def test_recording_is_named_after_what_it_shows(tmp_path: Path) -> None:
    (entry,) = RrdReader(exported(tmp_path)).recordings()
    same, other = placed_map(tmp_path), placed_map(tmp_path, 1)
    assert (entry.application_id, entry.recording_id) == ("hmt-service", recording_id(same))
    assert recording_id(other) != entry.recording_id


def test_the_same_map_gives_the_same_content(tmp_path: Path) -> None:
    first, second = (chunks_in(exported(tmp_path)) for _ in range(2))
    assert list(first) == list(second)
    for entity, chunks in first.items():
        for one, other in zip(chunks, second[entity], strict=True):
            a, b = one.to_record_batch(), other.to_record_batch()
            names = set(a.schema.names) - {"rerun.controls.RowId"}
            assert set(a.schema.names) == set(b.schema.names)
            assert all(a.column(name).equals(b.column(name)) for name in names)


def test_missing_extra_is_an_error_with_the_next_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun.chunk", None)
    with pytest.raises(Unavailable, match=r"pip install 'hmt-service\[view\]'"):
        exported(tmp_path)
    assert not (tmp_path / "map.rrd").exists()


def test_failure_to_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: LazyChunkStream, path: Path, **__: str) -> None:
        path.write_bytes(b"half")
        raise RuntimeError("Failed to write: No space left on device (os error 28)")

    path = tmp_path / "map.rrd"
    path.write_bytes(b"old")
    monkeypatch.setattr(LazyChunkStream, "write_rrd", full)
    with pytest.raises(Unavailable, match=r"map\.rrd not written: .*No space left"):
        exported(tmp_path)
    assert path.read_bytes() == b"old"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["map.hmt", "map.rrd"]


def test_stamps_beyond_rerun_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hmt_service.io.exporters.rerun._LAST_S", 1.0)
    with pytest.raises(InvalidInput, match="do not fit Rerun"):
        exported(tmp_path)
