"""MCAP files, read by the library of the format."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hmt_service.core.geometry import FloatArray, Pose, pose_of, transform_points
from hmt_service.core.types import MapMethod
from hmt_service.errors import InvalidInput
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.mcap import export_mcap
from hmt_service.io.exporters.registry import export_map
from hmt_service.io.placed_map import PlacedMap
from tests.mapped import SCANS, map_file_in, mapped


def messages(path: Path) -> dict[str, list[Any]]:
    """Return the messages of every topic, in the order of their log times."""
    found: dict[str, list[Any]] = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, decoded in reader.iter_decoded_messages():
            found[channel.topic].append(decoded)
    return found


def pose_in(translation: Any, rotation: Any) -> Pose:
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    return pose_of(quaternion, np.array([translation.x, translation.y, translation.z]))


def points_in(cloud: Any) -> FloatArray:
    assert [(f.name, f.offset) for f in cloud.fields] == [("x", 0), ("y", 4), ("z", 8)]
    assert (cloud.point_stride, cloud.pose.orientation.w) == (12, 1.0)
    return np.frombuffer(cloud.data, "<f4").reshape(-1, 3).astype(np.float64)


def test_poses_and_frames_are_the_trajectory_of_the_engine(tmp_path: Path) -> None:
    export_map(map_file_in(tmp_path), tmp_path / "out.mcap", Format.MCAP)
    found, expected = messages(tmp_path / "out.mcap"), mapped().trajectory()
    assert len(found["/pose"]) == len(found["/tf"]) - 1 == SCANS
    for place, frames, known in zip(found["/pose"], found["/tf"][1:], expected, strict=True):
        (frame,) = frames.transforms
        assert (place.frame_id, frame.parent_frame_id, frame.child_frame_id) == (
            "map",
            "map",
            "body",
        )
        assert place.timestamp.ToNanoseconds() == frame.timestamp.ToNanoseconds()
        assert place.timestamp.ToNanoseconds() == pytest.approx(1e9 * known.stamp_s, abs=1e3)
        for pose in (
            pose_in(place.pose.position, place.pose.orientation),
            pose_in(frame.translation, frame.rotation),
        ):
            np.testing.assert_allclose(pose, known.reference_from_body, atol=1e-9)


def test_areas_lie_in_their_frames_as_the_engine_serves_them(tmp_path: Path) -> None:
    export_map(map_file_in(tmp_path), tmp_path / "out.mcap", Format.MCAP)
    found = messages(tmp_path / "out.mcap")
    frames = {frame.child_frame_id: frame for frame in found["/tf"][0].transforms}
    served = mapped().global_map(MapMethod.CONSISTENT)
    assert set(frames) == {f"area_{area.area}" for area in served.areas} == {"area_0", "area_1"}
    for area in served.areas:
        (cloud,), frame = found[f"/areas/{area.area}"], frames[f"area_{area.area}"]
        assert cloud.frame_id == f"area_{area.area}"
        first = found["/pose"][0].timestamp
        assert cloud.timestamp.ToNanoseconds() == first.ToNanoseconds()
        map_from_area = pose_in(frame.translation, frame.rotation)
        np.testing.assert_allclose(map_from_area, area.reference_from_area.mean, atol=1e-9)
        seen = transform_points(map_from_area, points_in(cloud))
        known = transform_points(map_from_area, area.points_in_area)
        np.testing.assert_allclose(
            [seen.min(axis=0), seen.max(axis=0)], [known.min(axis=0), known.max(axis=0)], atol=0.05
        )
        assert len(seen) == pytest.approx(len(known), rel=0.1)


def test_stamps_before_zero_are_refused(tmp_path: Path) -> None:
    stored = mapped().stored()
    early = tuple(replace(scan, stamp_s=scan.stamp_s - 2e3) for scan in stored.scans)
    with pytest.raises(InvalidInput, match=r"first of 300 scans is at -1000\.0 s"):
        export_mcap(PlacedMap.of(replace(stored, scans=early)), tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == []
