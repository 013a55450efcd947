"""Foxglove messages as a robot would send or record them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from hmt_service.core.geometry import FloatArray


def stamp(stamp_s: float) -> Timestamp:
    seconds = int(stamp_s)
    return Timestamp(seconds=seconds, nanos=int((stamp_s - seconds) * 1e9))


def laser_scan(ranges: Sequence[float] | FloatArray, *, stamp_s: float = 0.0) -> LaserScan:
    """Return a full turn of ranges."""
    return LaserScan(
        timestamp=stamp(stamp_s),
        frame_id="body",
        start_angle=-np.pi,
        end_angle=np.pi - 2.0 * np.pi / max(1, len(ranges)),
        ranges=list(ranges),
    )


def cloud(points: FloatArray, dtype: str = "<f4", *, stamp_s: float = 5.0) -> PointCloud:
    kinds = {"<f4": PackedElementField.FLOAT32, "<f8": PackedElementField.FLOAT64}
    size = np.dtype(dtype).itemsize
    return PointCloud(
        timestamp=stamp(stamp_s),
        frame_id="base_link",
        point_stride=3 * size,
        fields=[
            PackedElementField(name=name, offset=axis * size, type=kinds[dtype])
            for axis, name in enumerate("xyz")
        ],
        data=np.asarray(points, dtype=dtype).tobytes(),
    )


def odometry(*, stamp_s: float = 5.0, x_m: float = 1.0) -> Odometry:
    return Odometry(
        timestamp=stamp(stamp_s),
        frame_id="odom",
        body_frame_id="body",
        pose=PoseMessage(position=Vector3(x=x_m), orientation=Quaternion(w=1.0)),
    )
