"""ROS 2 over Zenoh: a daemon takes what robots publish that have never heard of it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh

from hmt_service.client import HmtClient
from hmt_service.core.geometry import planar_pose
from hmt_service.errors import InvalidInput
from hmt_service.io.ros_messages import RosType, type_hash
from hmt_service.io.trajectory import read_tum
from hmt_service.service.keys import Input
from hmt_service.service.ros2 import Ros2Input, encoding_under
from hmt_service.service.session import Endpoints, Mode, open_session
from tests.flat import path
from tests.ros import CLOUD, LASER, ODOMETRY, SCAN_FRAME, Ros, Stamped
from tests.service.harness import RunningDaemon, running_daemon, wait_until

SCANS = 80
ROS = Ros()
TOPICS = ("--ros2-laser", "/bot1/scan", "--ros2-odometry", "/bot1/odom", "--ros2-domain", "7")
AT_THE_CENTRE = ("--sensor-pose", "0", "0", "0", "0", "0", "0")
DDS_NAMES = {
    LASER: "sensor_msgs::msg::dds_::LaserScan_",
    CLOUD: "sensor_msgs::msg::dds_::PointCloud2_",
    ODOMETRY: "nav_msgs::msg::dds_::Odometry_",
}


def rmw_zenoh_key(topic: str, name: str, digest: str | None = None) -> str:
    return f"7{topic}/{DDS_NAMES[name]}/{digest or type_hash(RosType(name))}"


def humble_key(topic: str, name: str) -> str:
    return rmw_zenoh_key(topic, name, "TypeHashNotSupported")


def bridge_key(topic: str, _: str) -> str:
    return topic.removeprefix("/")


class Robot:
    """Publishes messages as one of the ways from ROS 2 to Zenoh does."""

    def __init__(self, session: zenoh.Session, key: Callable[[str, str], str]) -> None:
        self._session = session
        self._key = key
        self._sent = 0

    def send(self, topic: str, message: object, payload: bytes | None = None) -> None:
        """Send a message, or other bytes in its place."""
        name = str(getattr(message, "__msgtype__"))  # noqa: B009
        self._sent += 1
        # What rmw_zenoh attaches: number, time, and the publisher's identifier with its length.
        attachment = struct.pack("<qqB16s", self._sent, 0, 16, bytes(range(16)))
        self._session.put(
            self._key(topic, name),
            ROS.serialize(message) if payload is None else payload,
            attachment=attachment,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def drive(self, messages: list[Stamped]) -> None:
        for topic, _, message in messages:
            self.send(f"/bot1{topic}", message)


@contextmanager
def robot_of(
    daemon: RunningDaemon, key: Callable[[str, str], str] = rmw_zenoh_key
) -> Iterator[Robot]:
    with open_session(Endpoints(mode=Mode.CLIENT, connect=(daemon.endpoint,))) as session:
        yield Robot(session, key)


def wait_for(client: HmtClient, received: int) -> None:
    """Wait until so many samples are decoded: they come by another session than questions."""

    def is_here() -> bool:
        counts = client.status().input
        return counts.received >= received and counts.queued == 0

    wait_until(is_here)


# ------------------------------------------------------------------ what it is for


@pytest.mark.parametrize("key", [rmw_zenoh_key, humble_key, bridge_key])
def test_a_drive_published_by_ros_is_mapped(tmp_path: Path, key: Callable[[str, str], str]) -> None:
    with running_daemon(tmp_path / "out", options=(*TOPICS, *AT_THE_CENTRE)) as daemon:
        with robot_of(daemon, key) as robot, daemon.client() as client:
            robot.drive(ROS.drive(SCANS))
            wait_for(client, 2 * SCANS)
            ack = client.finish()
            assert (ack.received, ack.accepted, ack.refused) == (2 * SCANS, 2 * SCANS, 0)
            assert ack.processed_scans == SCANS
        truth = path(SCANS)
        poses = read_tum(daemon.out / "trajectory.tum")
        for pose, world_from_body in zip(poses, truth, strict=True):
            at = (truth[0] @ pose.reference_from_body)[:2, 3]
            np.testing.assert_allclose(at, world_from_body[:2, 3], atol=0.05)


def test_scans_say_nothing_of_where_the_sensor_sits_so_odometry_waits_for_a_pose(
    tmp_path: Path,
) -> None:
    with (
        running_daemon(tmp_path / "out", options=TOPICS) as daemon,
        robot_of(daemon) as robot,
        daemon.client() as client,
    ):
        robot.drive(ROS.drive(10))
        wait_for(client, 20)
        counts = client.status().input
        assert (counts.accepted, counts.refused) == (10, {"wrong_frame": 10})
        for _, _, message in ROS.drive(10):
            if message.__msgtype__ == ODOMETRY:
                message.header.stamp.sec += 1
                message.child_frame_id = SCAN_FRAME
                robot.send("/bot1/odom", message)
        wait_for(client, 30)
        assert client.status().input.accepted == 20


def test_clouds_and_foxglove_s_messages_are_taken_side_by_side(tmp_path: Path) -> None:
    rows = np.zeros(100, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    rows["x"] = np.linspace(1.0, 5.0, 100)
    with (
        running_daemon(tmp_path / "out", options=("--ros2-cloud", "points")) as daemon,
        robot_of(daemon, bridge_key) as robot,
        daemon.client() as client,
    ):
        robot.send("/points", ROS.cloud(rows, stamp_s=10.0))
        wait_for(client, 1)
        laser = ROS.serialize(ROS.laser_scan([1.0, 2.0], stamp_s=10.1))
        client.publish_raw(Input.SCAN, laser, f"application/cdr;{LASER}")
        client.publish_raw(Input.ODOMETRY, laser, f"application/cdr;{LASER}")
        wait_for(client, 3)
        counts = client.status().input
        assert (counts.accepted, counts.refused) == (2, {"wrong_encoding": 1})


# ------------------------------------------------------------------ wrong input


def test_wrong_input_is_refused_counted_and_survived(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    scan = ROS.laser_scan([1.0] * 50, stamp_s=5000.0)
    odometry = ROS.odometry(planar_pose(1.0, 0.0, 0.0), stamp_s=5000.0)
    whole = ROS.serialize(scan)
    with (
        running_daemon(tmp_path / "out", options=(*TOPICS, *AT_THE_CENTRE)) as daemon,
        robot_of(daemon) as robot,
        daemon.client() as client,
    ):
        robot.send("/bot1/scan", scan)
        for size in (0, 3, 10, 3000):
            robot.send("/bot1/scan", scan, rng.bytes(size))
            robot.send("/bot1/odom", odometry, b"\x00\x01\x00\x00" + rng.bytes(size))
        robot.send("/bot1/scan", scan, whole[:-9])
        robot.send("/bot1/scan", scan, ROS.serialize(odometry))
        robot.send("/bot1/scan", scan, bytes(17_000_000))
        robot.send("/bot1/scan", ROS.laser_scan([1.0], stamp_s=5000.1, frame="rear"))
        robot.send("/bot1/scan", ROS.laser_scan([1.0], stamp_s=0.0))
        robot.send("/bot1/scan", ROS.laser_scan([np.nan] * 3, stamp_s=5000.1))
        # Neither of these is what was asked for.
        robot.send("/bot2/scan", scan)
        robot.send("/bot1/scan", odometry)
        wait_for(client, 15)
        with open_session(Endpoints(mode=Mode.CLIENT, connect=(daemon.endpoint,))) as session:
            session.put(rmw_zenoh_key("/bot1/scan", LASER, f"RIHS01_{64 * '0'}"), whole)
            session.delete("bot1/scan")
            wait_for(client, 17)
        counts = client.status().input
        assert counts.refused == {
            "not_ros": 10,
            "too_large": 1,
            "wrong_frame": 1,
            "bad_stamp": 1,
            "nan_ranges": 1,
            "wrong_encoding": 1,
            "unknown_key": 1,
        }
        assert (counts.received, counts.accepted) == (17, 1)
        robot.send("/bot1/scan", ROS.laser_scan([1.0] * 50, stamp_s=5000.2))
        wait_until(lambda: client.status().input.accepted == 2)


# ------------------------------------------------------------------ names


def test_a_topic_has_a_key_of_each_way_to_zenoh() -> None:
    ros2 = Ros2Input(topics={RosType.LASER_SCAN: "/bot1/scan", RosType.ODOMETRY: "odom"}, domain=7)
    assert ros2.keys() == {
        "bot1/scan": RosType.LASER_SCAN,
        "7/bot1/scan/sensor_msgs::msg::dds_::LaserScan_/*": RosType.LASER_SCAN,
        "odom": RosType.ODOMETRY,
        "7/odom/nav_msgs::msg::dds_::Odometry_/*": RosType.ODOMETRY,
    }
    for key in map(zenoh.KeyExpr, ros2.keys()):
        sent = [zenoh.KeyExpr(make("/bot1/scan", LASER)) for make in (rmw_zenoh_key, bridge_key)]
        assert any(key.includes(one) for one in sent) == ("bot1" in str(key))


def test_a_message_defined_otherwise_has_an_encoding_of_its_own() -> None:
    right = f"application/cdr;{LASER}"
    for key in (rmw_zenoh_key("/scan", LASER), humble_key("/scan", LASER), "scan"):
        assert encoding_under(key, RosType.LASER_SCAN) == right
    other = rmw_zenoh_key("/scan", LASER, "RIHS01_00")
    assert encoding_under(other, RosType.LASER_SCAN) == f"{right}/RIHS01_00"


@pytest.mark.parametrize("topic", ["", "/", "scan/", "//scan", "scan/**", "/*", "a b", "/1", "@a"])
def test_a_name_that_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(InvalidInput, match="topic"):
        Ros2Input(topics={RosType.LASER_SCAN: topic})


def test_what_cannot_be_meant_is_refused() -> None:
    with pytest.raises(InvalidInput, match="2 types"):
        Ros2Input(topics={RosType.LASER_SCAN: "/scan", RosType.POINT_CLOUD: "scan"})
    with pytest.raises(InvalidInput, match="233"):
        Ros2Input(domain=233)
    with pytest.raises(InvalidInput, match="pose"):
        Ros2Input(topics={RosType.ODOMETRY: "/odom"}, body_from_sensor=np.eye(4))
