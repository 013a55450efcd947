"""MCAP logs: what was written comes back, foreign ones are read as far as they can be."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as PlainWriter
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import register_schema

from hmt_service.core.geometry import exp, planar_pose
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.decoding import Defect
from hmt_service.io.mcap_file import McapFile
from hmt_service.io.mcap_writer import McapWriter
from hmt_service.io.streams import Use
from hmt_service.io.topic_log import TopicLog, read_topics, streams_of
from tests.flat import readings
from tests.messages import cloud, laser_scan, odometry, stamp

EVERYTHING_M = 1e6
Sent = tuple[str, Message]


def read(path: Path) -> TopicLog:
    return read_topics(McapFile(path), min_range_m=0.0, max_range_m=EVERYTHING_M)


def written(path: Path, sent: Sequence[Reading]) -> Path:
    with path.open("wb") as file:
        writer = McapWriter(file)
        for reading in sent:
            writer.write(reading)
        writer.finish()
    return path


def recorded(
    path: Path,
    sent: Sequence[Sent],
    *,
    chunk_size: int = 1_000_000,
    has_chunks: bool = True,
    is_complete: bool = True,
) -> Path:
    """Write messages as any other program would, logged at their own stamps."""
    with path.open("wb") as file:
        index = IndexType.ALL if is_complete else IndexType.NONE
        writer = PlainWriter(
            file,
            chunk_size=chunk_size,
            use_chunking=has_chunks,
            compression=CompressionType.ZSTD,
            index_types=index,
            use_statistics=is_complete,
        )
        writer.start()
        channels: dict[tuple[str, str], int] = {}
        for topic, message in sent:
            key = topic, message.DESCRIPTOR.full_name
            if key not in channels:
                schema = register_schema(writer, type(message))
                channels[key] = writer.register_channel(topic, "protobuf", schema)
            assert isinstance(message, LaserScan | PointCloud | Odometry | PoseInFrame)
            time = message.timestamp.ToNanoseconds()
            writer.add_message(channels[key], time, message.SerializeToString(), time)
        writer.finish()
    return path


def keys(log: TopicLog) -> list[tuple[float, bool]]:
    return [(reading.stamp_s, isinstance(reading, Scan)) for reading in log.readings]


def drive(scans: int) -> list[Sent]:
    """Return odometry and scan of every second."""
    return [
        sent
        for s in range(scans)
        for sent in (
            ("/odom", odometry(stamp_s=s)),
            ("/points", cloud(np.full((50, 3), 1.0 + s), stamp_s=s)),
        )
    ]


# ------------------------------------------------------------------ there and back


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    sent: list[Reading] = []
    for index in range(50):
        stamp_s = 1_700_000_000.0 + index * 0.1
        points = rng.normal(0.0, 5.0, (200, 3))
        times = rng.uniform(0.0, 1.0, 200)
        sent.append(OdometryReading(stamp_s, exp(rng.normal(0.0, 1.0, 6))))
        sent.append(Scan(stamp_s, points, np.array([0.2, -0.1, 0.7]), times))
    log = read(written(tmp_path / "log.mcap", sent))
    assert (log.scans, log.odometry) == (50, 50)
    for before, after in zip(sent, log.readings, strict=True):
        assert after.stamp_s == before.stamp_s
        if isinstance(before, OdometryReading):
            assert isinstance(after, OdometryReading)
            np.testing.assert_allclose(after.odom_from_body, before.odom_from_body, atol=1e-12)
        else:
            assert isinstance(after, Scan)
            np.testing.assert_allclose(after.points_in_body, before.points_in_body, atol=1e-6)
            np.testing.assert_array_equal(after.sensor_in_body, before.sensor_in_body)
            assert before.point_times is not None
            assert after.point_times is not None
            np.testing.assert_allclose(after.point_times, before.point_times, atol=1e-7)
    assert log.malformed == ()


def test_a_planar_drive_comes_back_in_order_again_and_again(tmp_path: Path) -> None:
    sent = readings(30)
    log = read(written(tmp_path / "log.mcap", sent))
    for _ in range(2):
        for before, after in zip(sent, log.readings, strict=True):
            assert abs(after.stamp_s - before.stamp_s) <= 0.5e-9
            assert isinstance(after, Scan) == isinstance(before, Scan)
            if isinstance(before, Scan) and isinstance(after, Scan):
                assert after.point_times is None
                np.testing.assert_allclose(after.points_in_body, before.points_in_body, atol=1e-6)


def test_a_scan_that_sees_nothing_comes_back(tmp_path: Path) -> None:
    blind = Scan(2.0, np.zeros((0, 3)), np.zeros(3))
    log = read(written(tmp_path / "log.mcap", [*readings(1, start_s=1.0), blind]))
    assert [len(r.points_in_body) for r in log.readings if isinstance(r, Scan)] == [240, 0]
    assert log.malformed == ()


def test_the_same_readings_give_the_same_bytes(tmp_path: Path) -> None:
    first, second = (written(tmp_path / name, readings(20)) for name in ("a.mcap", "b.mcap"))
    assert first.read_bytes() == second.read_bytes()


def test_the_format_s_own_reader_finds_topics_schemas_and_times(tmp_path: Path) -> None:
    path = written(tmp_path / "log.mcap", readings(3, start_s=1000.0, period_s=0.5))
    with path.open("rb") as file:
        found = []
        for schema, channel, message, decoded in make_reader(
            file, validate_crcs=True, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert isinstance(schema, Schema)
            assert message.log_time == decoded.timestamp.ToNanoseconds()
            found.append((channel.topic, schema.name, message.log_time))
    assert found == [
        sent
        for time in (1_000_000_000_000, 1_000_500_000_000, 1_001_000_000_000)
        for sent in (
            ("/odometry", "foxglove.Odometry", time),
            ("/scan", "foxglove.PointCloud", time),
        )
    ]


def test_a_stamp_before_the_beginning_of_time_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"-1\.5"):
        written(tmp_path / "log.mcap", [OdometryReading(-1.5, planar_pose(0.0, 0.0, 0.0))])


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 5.0, (20_000, 3))
    scans = [Scan(0.1 * index, points, np.zeros(3)) for index in range(150)]
    log = read(written(tmp_path / "log.mcap", scans))
    in_memory = len(scans) * points.nbytes
    tracemalloc.start()
    try:
        assert sum(1 for _ in log.readings) == len(scans)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # A window of 1 s is 10 of 150 scans.
    assert peak < 0.3 * in_memory


# ------------------------------------------------------------------ order


def test_small_disorder_is_mended_and_odometry_comes_first(tmp_path: Path) -> None:
    sent = drive(6)
    late = [sent[i] for i in (1, 0, 3, 2, 7, 5, 4, 6, 9, 8, 11, 10)]
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = PlainWriter(file)
        writer.start()
        channels: dict[str, int] = {}
        for time, (topic, message) in enumerate(late):
            if topic not in channels:
                schema = register_schema(writer, type(message))
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            writer.add_message(channels[topic], time, message.SerializeToString(), time)
        writer.finish()
    log = read(tmp_path / "log.mcap")
    assert keys(log) == [(float(s), is_scan) for s in range(6) for is_scan in (False, True)]
    assert log.malformed == ()


@pytest.mark.parametrize("first", ["/odom", "/points"])
def test_a_file_of_one_topic_after_the_other_is_read_by_time(tmp_path: Path, first: str) -> None:
    sent = sorted(drive(40), key=lambda s: s[0] != first)
    log = read(recorded(tmp_path / "log.mcap", sent, chunk_size=1000))
    assert keys(log) == [(float(s), is_scan) for s in range(40) for is_scan in (False, True)]


def unordered(path: Path, sent: Sequence[Sent]) -> TopicLog:
    """Read messages in exactly this order: without an index there is no other."""
    return read(recorded(path, sent, is_complete=False))


def test_a_reading_older_than_the_window_is_counted(tmp_path: Path) -> None:
    log = unordered(tmp_path / "log.mcap", [*drive(5), ("/odom", odometry(stamp_s=1.0))])
    assert len(keys(log)) == 10
    (left_out,) = log.malformed
    assert (left_out.place, left_out.reason) == ("/odom, message 6", "time_backwards")


def test_a_jump_that_nothing_confirms_is_counted(tmp_path: Path) -> None:
    sent = drive(5)
    jump = ("/odom", odometry(stamp_s=9000.0))
    log = unordered(tmp_path / "log.mcap", [*sent[:4], jump, *sent[4:]])
    assert len(keys(log)) == 10
    assert [left_out.reason for left_out in log.malformed] == ["time_jumped"]


# ------------------------------------------------------------------ foreign logs


def test_topics_are_known_by_schema_and_the_busiest_is_read(tmp_path: Path) -> None:
    sent: list[Sent] = drive(5)
    sent += [("/laser", laser_scan([1.0, 2.0], stamp_s=s)) for s in range(4)]
    sent += [("/wheels", odometry(stamp_s=s)) for s in range(3)]
    log = read(recorded(tmp_path / "log.mcap", sent))
    assert (log.scans, log.odometry) == (5, 5)
    assert log.unread == ("/laser (4 messages)", "/wheels (3 messages)")
    assert len(keys(log)) == 10


def pose_in_frame(frame: str, stamp_s: float) -> PoseInFrame:
    return PoseInFrame(timestamp=stamp(stamp_s), frame_id=frame, pose=PoseMessage())


def test_poses_are_odometry_where_there_is_no_other(tmp_path: Path) -> None:
    poses: list[Sent] = [("/pose", pose_in_frame("odom", s / 10)) for s in range(100)]
    both = read(recorded(tmp_path / "both.mcap", [*drive(5), *poses]))
    assert (both.odometry, both.unread) == (5, ("/pose (100 messages)",))
    alone = read(recorded(tmp_path / "alone.mcap", [*drive(5)[1::2], *poses]))
    assert (alone.odometry, len(keys(alone))) == (100, 105)


def test_poses_in_a_frame_that_may_jump_are_no_odometry(tmp_path: Path) -> None:
    poses: list[Sent] = [("/truth", pose_in_frame("map", s)) for s in range(5)]
    log = read(recorded(tmp_path / "log.mcap", [*drive(5)[1::2], *poses]))
    assert len(keys(log)) == 5
    (left_out,) = log.malformed
    assert (left_out.reason, left_out.count) == ("wrong_frame", 5)


def renamed(sent: Sequence[Sent], scans: str, odometry_of: str) -> list[Sent]:
    for _, message in sent:
        if isinstance(message, PointCloud):
            message.frame_id = scans
        elif isinstance(message, Odometry):
            message.body_frame_id = odometry_of
    return list(sent)


@pytest.mark.parametrize(
    ("scans", "odometry_of"), [("lidar", "lidar"), ("body", "base_link"), ("", "")]
)
def test_the_scans_say_what_the_body_is_called(
    tmp_path: Path, scans: str, odometry_of: str
) -> None:
    log = read(recorded(tmp_path / "log.mcap", renamed(drive(4), scans, odometry_of)))
    assert len(keys(log)) == 8
    assert log.malformed == ()


def test_odometry_of_another_body_is_left_out(tmp_path: Path) -> None:
    log = read(recorded(tmp_path / "log.mcap", renamed(drive(4), "lidar", "base_link")))
    assert keys(log) == [(float(s), True) for s in range(4)]
    (left_out,) = log.malformed
    assert left_out.place == "/odom, message 1"
    assert (left_out.reason, left_out.count) == ("wrong_frame", 4)


def test_messages_of_other_kinds_and_encodings_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = PlainWriter(file)
        writer.start()
        json = writer.register_channel("/chat", "json", 0)
        schema = register_schema(writer, LaserScan)
        strange = writer.register_channel("/strange", "cbor", schema)
        scans = writer.register_channel("/laser", "protobuf", schema)
        for time in range(3):
            scan = laser_scan([1.0, 2.0], stamp_s=time)
            writer.add_message(json, time, b"{}", time)
            writer.add_message(strange, time, b"\xff", time)
            writer.add_message(scans, time, scan.SerializeToString(), time)
        writer.finish()
    log = read(path)
    assert (log.scans, log.unread, len(keys(log))) == (3, (), 3)


def test_imm_ring_is_read_whole(hmt_data: Path) -> None:
    log = read(hmt_data / "3d" / "imm-ring.mcap")
    assert (log.scans, log.odometry, log.unread) == (323, 323, ())
    assert keys(log) == [
        (1000.0 + 2.0 * index, is_scan) for index in range(323) for is_scan in (False, True)
    ]
    sizes = [len(r.points_in_body) for r in log.readings if isinstance(r, Scan)]
    assert (min(sizes), max(sizes)) == (271, 5687)
    path = [r.odom_from_body[:3, 3] for r in log.readings if isinstance(r, OdometryReading)]
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(621.0, abs=0.5)
    assert log.malformed == ()


# ------------------------------------------------------------------ damage


def test_messages_that_cannot_be_used_are_counted_by_reason(tmp_path: Path) -> None:
    sent = drive(10)
    for index in (3, 9, 13):
        sent[index] = ("/points", cloud(np.full((2, 3), math.nan), stamp_s=index // 2))
    sent[4] = ("/odom", odometry(stamp_s=2.0, x_m=math.inf))
    log = read(recorded(tmp_path / "log.mcap", sent))
    assert len(keys(log)) == 16
    assert [(m.place, m.reason, m.count) for m in log.malformed] == [
        ("/points, message 2", "nan_ranges", 3),
        ("/odom, message 3", "bad_pose", 1),
    ]


@pytest.mark.parametrize("has_chunks", [True, False])
def test_a_file_without_an_index_is_read_whole(tmp_path: Path, has_chunks: bool) -> None:
    path = recorded(
        tmp_path / "log.mcap", drive(40), chunk_size=1000, is_complete=False, has_chunks=has_chunks
    )
    log = read(path)
    assert (log.scans, log.odometry, len(keys(log)), log.malformed) == (40, 40, 80, ())


def test_a_truncated_file_gives_what_is_there_and_says_where_it_ends(tmp_path: Path) -> None:
    path = recorded(tmp_path / "log.mcap", drive(100), chunk_size=1000)
    whole = path.read_bytes()
    counts = []
    for share in (0.2, 0.4, 0.6):
        path.write_bytes(whole[: round(share * len(whole))])
        log = read(path)
        counts.append(len(keys(log)))
        assert keys(log) == keys(log)[: counts[-1]]
        assert "ends or cannot be read" in log.malformed[-1].reason
    assert 20 < counts[0] < counts[1] < counts[2] < 200
    assert log.scans == pytest.approx(counts[2] / 2, abs=1)


def test_a_damaged_chunk_costs_what_is_in_it(tmp_path: Path) -> None:
    path = recorded(tmp_path / "log.mcap", drive(100), chunk_size=3000)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[5]
    assert len(summary.chunk_indexes) > 10
    content = bytearray(path.read_bytes())
    content[chunk.chunk_start_offset + chunk.chunk_length - 10] ^= 0x55
    path.write_bytes(content)
    log = read(path)
    stamps = {stamp_s for stamp_s, _ in keys(log)}
    missing = sorted(set(map(float, range(100))) - stamps)
    assert 0 < len(missing) < 15
    assert missing == sorted(np.arange(missing[0], missing[-1] + 1.0))
    (left_out,) = log.malformed
    assert left_out.place == f"chunk at byte {chunk.chunk_start_offset}"
    assert left_out.reason.startswith("damaged: ")


@given(st.data())
def test_no_damage_is_fatal(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("log")
    path = recorded(folder / "log.mcap", drive(10), chunk_size=data.draw(st.integers(100, 5000)))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(len(content) // 2, len(content)))])
    try:
        log = read(path)
    except InvalidLog:
        return
    stamps = [stamp_s for stamp_s, _ in keys(log)]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no usable scan in 0 messages"),
        (b"FLASER 2 1 1 0 0 0 0 0 0 1 host 1\n" * 30, "no usable scan in 0 messages"),
    ],
)
def test_a_file_that_is_no_mcap_is_refused(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(InvalidLog, match=reason):
        read(path)


def test_a_log_without_a_usable_scan_is_refused_with_numbers(tmp_path: Path) -> None:
    odometry_only = recorded(tmp_path / "odometry.mcap", drive(5)[::2])
    with pytest.raises(InvalidLog, match=r"0 messages of foxglove\.LaserScan or"):
        read(odometry_only)
    wrong: list[Sent] = [("/points", cloud(np.zeros((0, 3)), stamp_s=s)) for s in range(7)]
    with pytest.raises(InvalidLog, match=f"7 messages.*/points, message 1: {Defect.EMPTY}"):
        read(recorded(tmp_path / "wrong.mcap", wrong))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidLog, match="No such file"):
        read(tmp_path / "none.mcap")
    path = recorded(tmp_path / "log.mcap", drive(2))
    log = read(path)
    path.unlink()
    with pytest.raises(InvalidLog, match="No such file"):
        keys(log)


@pytest.mark.parametrize("has_chunks", [True, False])
@pytest.mark.parametrize("is_complete", [True, False])
def test_streams_have_the_times_of_all_messages(
    tmp_path: Path, has_chunks: bool, is_complete: bool
) -> None:
    sent: list[Sent] = [("/points", cloud(np.ones((3, 3)), stamp_s=5.0 + s)) for s in range(7)]
    sent += [("/few", laser_scan([1.0, 2.0], stamp_s=9.0)), ("/odom", odometry(stamp_s=9.0))]
    path = recorded(
        tmp_path / "a.mcap", sent, chunk_size=300, has_chunks=has_chunks, is_complete=is_complete
    )
    streams = {stream.name: stream for stream in streams_of(McapFile(path))}
    assert {name: (s.messages, s.use, s.why) for name, s in streams.items()} == {
        "/few": (1, Use.NOTHING, "no more messages than /points"),
        "/odom": (1, Use.ODOMETRY, "no other"),
        "/points": (7, Use.SCANS, "most messages"),
    }
    assert sorted(streams["/points"].times_s) == [5.0 + s for s in range(7)]


def test_topics_that_are_not_read_are_listed_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = PlainWriter(file)
        writer.start()
        schema = writer.register_schema("foxglove.LaserScan", "jsonschema", b"{}")
        for topic, number in (("/json", schema), ("/none", 0)):
            channel = writer.register_channel(topic, "json", number)
            writer.add_message(channel, 10**9, b"{}", 10**9)
        writer.finish()
    json_scans, no_schema = streams_of(McapFile(path))
    assert (json_scans.use, json_scans.why) == (Use.NOTHING, "encoding json is not read")
    assert (no_schema.name, no_schema.kind, no_schema.messages) == ("/none", "", 1)
    with pytest.raises(InvalidLog, match="no usable scan in 0 messages"):
        read(path)
