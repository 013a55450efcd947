"""Logs of ROS as its recorders write them: what was sent comes back, reading by reading."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin

from hmt_service.core.geometry import Pose, inverse, planar_pose, transform_points
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.logs import Log, read_log
from hmt_service.io.ros_messages import Serialization
from tests.flat import readings
from tests.ros import (
    BODY,
    LASER,
    SCAN_FRAME,
    Ros,
    Stamped,
    assert_alike,
    write_bag1,
    write_bag2,
)

SCANS = 30
ROS1, ROS2 = Ros(Serialization.ROS1), Ros(Serialization.CDR)
BODY_FROM_SENSOR = planar_pose(0.3, -0.1, 0.7)


def read(path: Path, body_from_sensor: Pose | None = None) -> Log:
    return read_log(path, min_range_m=0.0, max_range_m=100.0, body_from_sensor=body_from_sensor)


def write_mcap(path: Path, messages: list[Stamped], ros: Ros) -> Path:
    """Write messages as MCAP's own recorders of ROS 1 and ROS 2 do."""
    schemas = {Serialization.CDR: "ros2msg", Serialization.ROS1: "ros1msg"}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=10_000)
        writer.start()
        channels: dict[str, int] = {}
        for topic, stamp_s, message in messages:
            if topic not in channels:
                name = message.__msgtype__
                if ros.serialization is Serialization.ROS1:
                    name = name.replace("/msg/", "/")
                schema = writer.register_schema(name, schemas[ros.serialization], b"")
                channels[topic] = writer.register_channel(topic, ros.serialization, schema)
            time = round(stamp_s * 1e9)
            writer.add_message(channels[topic], time, ros.serialize(message), time)
        writer.finish()
    return path


Write = Callable[[Path, list[Stamped]], Path]
FORMATS: dict[str, tuple[Ros, Write]] = {
    "rosbag1": (ROS1, lambda folder, sent: write_bag1(folder / "a.bag", sent)),
    "rosbag1 compressed": (
        ROS1,
        lambda folder, sent: write_bag1(folder / "a.bag", sent, is_compressed=True),
    ),
    "rosbag2 sqlite3": (ROS2, lambda folder, sent: write_bag2(folder / "a", sent)),
    "rosbag2 mcap": (
        ROS2,
        lambda folder, sent: write_bag2(folder / "a", sent, StoragePlugin.MCAP),
    ),
    "file of rosbag2 sqlite3": (
        ROS2,
        lambda folder, sent: write_bag2(folder / "a", sent) / "a.db3",
    ),
    "file of rosbag2 mcap": (
        ROS2,
        lambda folder, sent: write_bag2(folder / "a", sent, StoragePlugin.MCAP) / "a.mcap",
    ),
    "mcap of ROS 1": (ROS1, lambda folder, sent: write_mcap(folder / "a.mcap", sent, ROS1)),
    "mcap of ROS 2": (ROS2, lambda folder, sent: write_mcap(folder / "a.mcap", sent, ROS2)),
}


@pytest.fixture(params=list(FORMATS))
def form(request: pytest.FixtureRequest) -> tuple[Ros, Write]:
    return FORMATS[request.param]


def static(ros: Ros, body_from_sensor: Pose = BODY_FROM_SENSOR) -> Stamped:
    """Return `tf_static` of a sensor on a mast on a body that is not its root."""
    body_from_mast = planar_pose(0.0, 0.2, -0.4)
    edges = [
        ("map", "odom", planar_pose(100.0, 0.0, 0.0)),
        ("base_link", "mast", body_from_mast),
        ("mast", SCAN_FRAME, inverse(body_from_mast) @ body_from_sensor),
        ("base_link", BODY, np.eye(4)),
    ]
    return "/tf_static", 999.0, ros.transforms(*edges)


def on_body(reading: Reading, body_from_sensor: Pose = BODY_FROM_SENSOR) -> Reading:
    """Return a reading of the flat as it is when the laser is not at the centre of the body."""
    if isinstance(reading, OdometryReading):
        return reading
    points = transform_points(body_from_sensor, reading.points_in_body)
    return Scan(reading.stamp_s, points, body_from_sensor[:3, 3])


# ------------------------------------------------------------------ there and back


def test_a_drive_comes_back_reading_by_reading_again_and_again(
    form: tuple[Ros, Write], tmp_path: Path
) -> None:
    ros, write = form
    log = read(write(tmp_path, [static(ros), *ros.drive(SCANS)]))
    assert (log.scans, log.odometry, log.unread) == (SCANS, SCANS, ())
    for _ in range(2):
        for after, before in zip(log.readings, readings(SCANS), strict=True):
            assert_alike(after, on_body(before))
        assert log.malformed == ()


def test_the_pose_that_the_caller_says_is_the_sensor_s(
    form: tuple[Ros, Write], tmp_path: Path
) -> None:
    ros, write = form
    other = planar_pose(-1.0, 2.0, 3.0)
    log = read(write(tmp_path, [static(ros), *ros.drive(3)]), body_from_sensor=other)
    for after, before in zip(log.readings, readings(3), strict=True):
        assert_alike(after, on_body(before, other))


def test_without_a_pose_the_scans_name_the_body_and_odometry_of_another_is_left_out(
    form: tuple[Ros, Write], tmp_path: Path
) -> None:
    ros, write = form
    log = read(write(tmp_path, ros.drive(SCANS)))
    scans = [reading for reading in readings(SCANS) if isinstance(reading, Scan)]
    for after, before in zip(log.readings, scans, strict=True):
        assert_alike(after, before)
    (left_out,) = log.malformed
    assert (left_out.place, left_out.reason) == ("/odom, message 1", "wrong_frame")
    assert left_out.count == SCANS


def test_scans_in_the_body_s_own_frame_need_no_pose(
    form: tuple[Ros, Write], tmp_path: Path
) -> None:
    ros, write = form
    sent = ros.drive(3)
    for _, _, message in sent:
        if message.__msgtype__ == LASER:
            message.header.frame_id = BODY
    log = read(write(tmp_path, sent))
    for after, before in zip(log.readings, readings(3), strict=True):
        assert_alike(after, before)


def test_a_cloud_of_a_lidar_comes_back_with_its_times(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 5.0, (500, 3)).astype(np.float32)
    shares = np.sort(rng.uniform(0.0, 1.0, 500))
    shares[[0, -1]] = 0.0, 1.0
    cloud = np.zeros(500, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    cloud["x"], cloud["y"], cloud["z"] = points.T
    cloud["t"] = shares * 1e8
    sent = [("/points", 5.0 + i, ROS2.cloud(cloud, stamp_s=5.0 + i)) for i in range(3)]
    for index, scan in enumerate(read(write_bag2(tmp_path / "a", sent)).readings):
        assert isinstance(scan, Scan)
        assert scan.point_times is not None
        assert scan.stamp_s == pytest.approx(5.1 + index)
        np.testing.assert_array_equal(scan.points_in_body, points)
        np.testing.assert_allclose(scan.point_times, shares, atol=1e-7)


# ------------------------------------------------------------------ what else is in a bag


def test_the_busiest_topics_are_read_and_others_named(
    form: tuple[Ros, Write], tmp_path: Path
) -> None:
    ros, write = form
    sent = ros.drive(SCANS)
    others: list[Stamped] = [
        *((f"/rear{topic}", stamp_s, message) for topic, stamp_s, message in sent[:10]),
        ("/tf", 1000.0, static(ros)[2]),
    ]
    log = read(write(tmp_path, [*sent, *others]))
    assert (log.scans, log.odometry) == (SCANS, SCANS)
    assert log.unread == ("/rear/odom (5 messages)", "/rear/scan (5 messages)")
    assert len(list(log.readings)) == SCANS


def test_malformed_messages_are_counted_and_named(form: tuple[Ros, Write], tmp_path: Path) -> None:
    ros, write = form
    sent = ros.drive(SCANS)
    for index in (3, 5, 7):
        sent[2 * index + 1][2].ranges[:] = np.nan
    sent[4][2].pose.pose.position.x = np.inf
    sent[9][2].header.frame_id = "rear"
    log = read(write(tmp_path, [static(ros), *sent]))
    assert len(list(log.readings)) == 2 * SCANS - 5
    assert {(m.place, m.reason, m.count) for m in log.malformed} == {
        ("/odom, message 3", "bad_pose", 1),
        ("/scan, message 4", "nan_ranges", 3),
        ("/scan, message 5", "wrong_frame", 1),
    }


def test_transforms_that_cannot_be_used_are_left_out(tmp_path: Path) -> None:
    broken = ROS2.transforms(("mast", SCAN_FRAME, planar_pose(np.nan, 0.0, 0.0)))
    loop = ROS2.transforms((SCAN_FRAME, SCAN_FRAME, np.eye(4)))
    sent = [("/tf_static", 999.0, message) for message in (static(ROS2)[2], broken)]
    log = read(write_bag2(tmp_path / "a", [*sent, *ROS2.drive(3)]))
    for after, before in zip(log.readings, readings(3), strict=True):
        assert_alike(after, on_body(before))
    log = read(write_bag2(tmp_path / "b", [("/tf_static", 999.0, loop), *ROS2.drive(3)]))
    assert len(list(log.readings)) == 3


def test_a_log_without_a_usable_scan_is_refused_with_numbers(
    form: tuple[Ros, Write], tmp_path: Path
) -> None:
    ros, write = form
    sent = ros.drive(4)
    for _, _, message in sent:
        if message.__msgtype__ == LASER:
            message.ranges = message.ranges[:0]
    with pytest.raises(InvalidLog, match=r"in 4 messages of .*/scan, message 1: empty"):
        read(write(tmp_path, sent))


@pytest.mark.parametrize(
    ("schema", "encoding"),
    [
        (LASER, "protobuf"),
        (LASER, "json"),
        ("foxglove.LaserScan", "cdr"),
        ("tf2_msgs/msg/TFMessage", "protobuf"),
    ],
)
def test_messages_encoded_by_somebody_else_are_passed_over(
    tmp_path: Path, schema: str, encoding: str
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        strange = writer.register_channel(
            "/tf_static", encoding, writer.register_schema(schema, "", b"")
        )
        scans = writer.register_channel("/scan", "cdr", writer.register_schema(LASER, "", b""))
        for time in range(1, 4):
            for _ in range(3):
                writer.add_message(strange, time, b"\xff", time)
            payload = ROS2.serialize(ROS2.laser_scan([1.0, 2.0], stamp_s=float(time)))
            writer.add_message(scans, time, payload, time)
        writer.finish()
    log = read(path)
    assert (log.scans, log.unread, len(list(log.readings)), log.malformed) == (3, (), 3, ())


def test_a_pose_is_for_ros_only(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("FLASER 2 1 1 0 0 0 0 0 0 1 host 1\n")
    with pytest.raises(InvalidInput, match="CARMEN"):
        read(path, body_from_sensor=BODY_FROM_SENSOR)


# ------------------------------------------------------------------ damage and size


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap"])
def test_a_file_that_is_no_bag_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidLog, match=name):
        read(tmp_path / name)
    for content in (b"", b"#ROSBAG V2.0\n", bytes(1000), b"SQLite format 3\0" + bytes(100)):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InvalidLog, match=name):
            read(tmp_path / name)


def test_a_folder_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidLog, match="metadata"):
        read(tmp_path)
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: 5")
    with pytest.raises(InvalidLog, match=str(tmp_path)):
        read(tmp_path)


@cache
def sound_bag(name: str) -> bytes:
    ros, write = FORMATS[name]
    with TemporaryDirectory() as folder:
        return write(Path(folder), [static(ros), *ros.drive(5)]).read_bytes()


@pytest.mark.parametrize("name", ["rosbag1", "rosbag1 compressed", "file of rosbag2 sqlite3"])
@given(data=st.data())
def test_no_damage_to_a_bag_is_fatal(
    tmp_path_factory: pytest.TempPathFactory, name: str, data: st.DataObject
) -> None:
    content = bytearray(sound_bag(name))
    path = tmp_path_factory.mktemp("bag") / ("a.bag" if name.startswith("rosbag1") else "a.db3")
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    try:
        log = read(path)
        stamps = [reading.stamp_s for reading in log.readings]
    except InvalidLog:
        return
    assert stamps == sorted(stamps)


def test_a_bag_is_read_up_to_where_it_is_damaged(tmp_path: Path) -> None:
    path = write_bag1(tmp_path / "a.bag", ROS1.drive(100))
    content = bytearray(path.read_bytes())
    at = content.rindex(b"op=\x02", 0, content.rindex(b"base_scan"))
    content[at : at + 4] = b"none"
    path.write_bytes(content)
    log = read(path)
    assert 90 <= len(list(log.readings)) < 100
    assert any("cannot be read from here on" in m.reason for m in log.malformed)


@pytest.mark.parametrize("name", ["rosbag1", "rosbag2 sqlite3", "rosbag2 mcap", "mcap of ROS 2"])
def test_memory_does_not_grow_with_the_log(tmp_path: Path, name: str) -> None:
    ros, write = FORMATS[name]
    ranges = np.full(50_000, 3.0)
    sent = [("/scan", 1.0 + s, ros.laser_scan(ranges, stamp_s=1.0 + s)) for s in range(200)]
    log = read(write(tmp_path, sent))
    del sent
    tracemalloc.start()
    try:
        assert sum(1 for _ in log.readings) == 200
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # A scan takes 0.2 MB in the log, which has 40 MB, and 1.2 MB as a reading.
    assert peak < 20e6
