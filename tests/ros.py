"""ROS messages as drivers send them, and bags as its recorders write them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hmt_service.core.geometry import FloatArray, Pose, quaternion_of
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.io.ros_messages import Serialization
from tests.flat import BEAMS, readings

LASER, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
SCAN_FRAME, BODY = "base_scan", "base_footprint"
_ROS1 = get_typestore(Stores.ROS1_NOETIC)
_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
_STORES = {
    Serialization.CDR: get_typestore(Stores.ROS2_HUMBLE),
    Serialization.ROS1: _ROS1,
}
Stamped = tuple[str, float, Any]
"""Topic, time of recording, message."""


@dataclass(frozen=True)
class Ros:
    """Makes the messages of one version of ROS."""

    serialization: Serialization = Serialization.CDR

    def make(self, kind: str, /, **fields: Any) -> Any:
        return _STORES[self.serialization].types[kind](**fields)

    def header(self, stamp_s: float, frame: str) -> Any:
        sec = int(np.floor(stamp_s))
        time = self.make(
            "builtin_interfaces/msg/Time", sec=sec, nanosec=round((stamp_s - sec) * 1e9)
        )
        sequence = {"seq": 0} if self.serialization is Serialization.ROS1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **sequence)

    def laser_scan(
        self,
        ranges: Sequence[float] | FloatArray,
        *,
        stamp_s: float = 5.0,
        frame: str = SCAN_FRAME,
        **changes: float,
    ) -> Any:
        """Return a full turn of ranges, like `tests.messages.laser_scan`."""
        fields: dict[str, float] = {
            "angle_min": -np.pi,
            "angle_max": np.pi,
            "angle_increment": 2.0 * np.pi / max(1, len(ranges)),
            "time_increment": 0.0,
            "scan_time": 0.0,
            "range_min": 0.0,
            "range_max": 100.0,
        }
        return self.make(
            LASER,
            header=self.header(stamp_s, frame),
            ranges=np.array(ranges, dtype=np.float32),
            intensities=np.zeros(0, dtype=np.float32),
            **(fields | changes),
        )

    def cloud(
        self,
        rows: npt.NDArray[np.void],
        *,
        stamp_s: float = 5.0,
        frame: str = SCAN_FRAME,
        height: int = 1,
        row_padding: int = 0,
    ) -> Any:
        """Return a cloud with the fields of a structured array, shape (N,)."""
        fields = rows.dtype.fields
        assert fields is not None
        numbers = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        width = len(rows) // height
        data = np.zeros((height, width * rows.itemsize + row_padding), dtype=np.uint8)
        data[:, : width * rows.itemsize] = np.frombuffer(rows.tobytes(), np.uint8).reshape(
            height, -1
        )
        order = {dtype.byteorder for dtype, *_ in fields.values()}
        return self.make(
            CLOUD,
            header=self.header(stamp_s, frame),
            height=height,
            width=width,
            fields=[
                self.make(
                    "sensor_msgs/msg/PointField",
                    name=name,
                    offset=offset,
                    datatype=numbers[dtype.str[1:]],
                    count=1,
                )
                for name, (dtype, offset, *_) in fields.items()
            ],
            is_bigendian=">" in order,
            point_step=rows.itemsize,
            row_step=data.shape[1],
            data=data.reshape(-1),
            is_dense=False,
        )

    def pose(self, pose: Pose) -> Any:
        qx, qy, qz, qw = quaternion_of(pose).tolist()
        x, y, z = pose[:3, 3].tolist()
        return self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )

    def odometry(
        self,
        odom_from_body: Pose,
        *,
        stamp_s: float = 5.0,
        frame: str = "odom",
        body: str = BODY,
    ) -> Any:
        still = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        return self.make(
            ODOMETRY,
            header=self.header(stamp_s, frame),
            child_frame_id=body,
            pose=self.make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self.pose(odom_from_body),
                covariance=np.zeros(36),
            ),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self.make("geometry_msgs/msg/Twist", linear=still, angular=still),
                covariance=np.zeros(36),
            ),
        )

    def transforms(self, *edges: tuple[str, str, Pose]) -> Any:
        """Return `tf_static` of edges parent, child, parent_from_child."""
        transforms = []
        for parent, child, parent_from_child in edges:
            pose = self.pose(parent_from_child)
            p = pose.position
            transform = self.make(
                "geometry_msgs/msg/Transform",
                translation=self.make("geometry_msgs/msg/Vector3", x=p.x, y=p.y, z=p.z),
                rotation=pose.orientation,
            )
            transforms.append(
                self.make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(0.0, parent),
                    child_frame_id=child,
                    transform=transform,
                )
            )
        return self.make(TRANSFORMS, transforms=transforms)

    def serialize(self, message: Any) -> bytes:
        store, name = _STORES[self.serialization], message.__msgtype__
        if self.serialization is Serialization.ROS1:
            return bytes(store.serialize_ros1(message, name))
        return bytes(store.serialize_cdr(message, name))

    def message_of(self, reading: Reading) -> Stamped:
        """Return a reading of the flat as its robot would send it, topic first."""
        if isinstance(reading, OdometryReading):
            odometry = self.odometry(reading.odom_from_body, stamp_s=reading.stamp_s)
            return "/odom", reading.stamp_s, odometry
        ranges = np.linalg.norm(reading.points_in_body, axis=1)
        assert len(ranges) == BEAMS
        return "/scan", reading.stamp_s, self.laser_scan(ranges, stamp_s=reading.stamp_s)

    def drive(self, scans: int) -> list[Stamped]:
        """Return the drive through the flat, `tests.flat.readings`."""
        return [self.message_of(reading) for reading in readings(scans)]


def write_bag1(path: Path, messages: Iterable[Stamped], *, is_compressed: bool = False) -> Path:
    writer = rosbag1.Writer(path)
    if is_compressed:
        writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
    _write(writer, messages, Ros(Serialization.ROS1))
    return path


def write_bag2(
    path: Path, messages: Iterable[Stamped], storage: StoragePlugin = StoragePlugin.SQLITE3
) -> Path:
    _write(rosbag2.Writer(path, version=8, storage_plugin=storage), messages, Ros())
    return path


def _write(writer: Any, messages: Iterable[Stamped], ros: Ros) -> None:
    with writer:
        connections: dict[str, Any] = {}
        for topic, stamp_s, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=_STORES[ros.serialization]
                )
            writer.write(connections[topic], round(stamp_s * 1e9), ros.serialize(message))


def assert_alike(after: Reading, before: Reading, *, atol_m: float = 2e-6) -> None:
    """Compare what was read with what was meant; messages hold ranges of float32."""
    assert abs(after.stamp_s - before.stamp_s) <= 0.5e-9
    if isinstance(before, OdometryReading):
        assert isinstance(after, OdometryReading)
        np.testing.assert_allclose(after.odom_from_body, before.odom_from_body, atol=1e-12)
        return
    assert isinstance(after, Scan)
    np.testing.assert_allclose(after.points_in_body, before.points_in_body, atol=atol_m)
    np.testing.assert_allclose(after.sensor_in_body, before.sensor_in_body, atol=1e-12)
