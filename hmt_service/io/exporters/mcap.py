"""A map as MCAP log that Foxglove opens: a cloud per area, and the robot on its trajectory.

The frame `map` is that of the reference area. Areas and their frames stand at the first stamp, so
that they are there from the beginning; then comes the pose of every scan.

References:
    https://mcap.dev/spec; foxglove schemas (`PointCloud`, `FrameTransforms`, `PoseInFrame`).
"""

from __future__ import annotations

from pathlib import Path

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType
from mcap_protobuf.writer import Writer

from hmt_service.core.geometry import Pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.io.foxglove import cloud_message, pose_message, timestamp_of
from hmt_service.io.placed_map import PlacedMap
from hmt_service.io.whole_files import whole_files

MAP_FRAME, BODY_FRAME = "map", "body"
"""Names of the frames of the reference area and of the robot."""
TRANSFORM_TOPIC, POSE_TOPIC = "/tf", "/pose"
"""Topics of frames and of the robot's pose; those of areas are `/areas/NUMBER`."""


def export_mcap(placed: PlacedMap, path: Path) -> None:
    """Write submaps, frames and trajectory.

    Raises:
        InvalidInput: If there is no scan, or one is before 0, where time begins in MCAP.
    """
    trajectory = placed.trajectory()
    first_s = min((pose.stamp_s for pose in trajectory), default=-1.0)
    if first_s < 0.0:
        raise InvalidInput(f"the first of {len(trajectory)} scans is at {first_s} s, before 0")
    with whole_files(path) as (part,), part.open("wb") as file:
        log = _Log(Writer(file, compression=CompressionType.ZSTD))
        log.areas(placed, first_s)
        for pose in trajectory:
            log.robot(pose)
        log.finish()


class _Log:
    """Messages of a map, as they are written."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer

    def areas(self, placed: PlacedMap, stamp_s: float) -> None:
        """Write every area: its frame, and its submap in it."""
        stamp = timestamp_of(stamp_s)
        poses, submaps = placed.reference_from_visit, placed.submaps()
        frames = [_frame(stamp, _area_frame(area), poses[area]) for area in submaps]
        self._write(TRANSFORM_TOPIC, FrameTransforms(transforms=frames), stamp)
        for area, points in submaps.items():
            message = cloud_message(stamp_s, _area_frame(area), points.astype("<f4"))
            self._write(f"/areas/{area}", message, stamp)

    def robot(self, pose: StampedPose) -> None:
        """Write where the robot was at one scan."""
        stamp = timestamp_of(pose.stamp_s)
        frame = _frame(stamp, BODY_FRAME, pose.reference_from_body)
        self._write(TRANSFORM_TOPIC, FrameTransforms(transforms=[frame]), stamp)
        place = pose_message(pose.reference_from_body)
        self._write(POSE_TOPIC, PoseInFrame(timestamp=stamp, frame_id=MAP_FRAME, pose=place), stamp)

    def finish(self) -> None:
        """Write what is left, and the index."""
        self._writer.finish()

    def _write(self, topic: str, message: Message, stamp: Timestamp) -> None:
        stamp_ns = stamp.ToNanoseconds()
        self._writer.write_message(topic, message, log_time=stamp_ns, publish_time=stamp_ns)


def _area_frame(area: int) -> str:
    return f"area_{area}"


def _frame(stamp: Timestamp, child: str, map_from_child: Pose) -> FrameTransform:
    pose = pose_message(map_from_child)
    return FrameTransform(
        timestamp=stamp,
        parent_frame_id=MAP_FRAME,
        child_frame_id=child,
        translation=pose.position,
        rotation=pose.orientation,
    )
