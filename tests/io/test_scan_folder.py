"""Folders of scans as other programs write them: KITTI, PCD and PLY, whole and broken."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from plyfile import PlyData, PlyElement

from hmt_service.core.geometry import FloatArray, planar_pose, transform_points
from hmt_service.core.types import Scan
from hmt_service.errors import InvalidInput, InvalidLog
from hmt_service.io.logs import Log, open_log, read_log
from hmt_service.io.streams import Says, Use

POINTS = np.array([[3.0, 4.0, 0.0], [0.1, 0.0, 0.0], [90.0, 0.0, 1.0], [1.0, -2.0, 0.5]])
NEAR = POINTS[[0, 3]]
"""Those of them between 1 m and 50 m."""


def write_bin(path: Path, points: FloatArray) -> None:
    rows = np.column_stack([points, np.full(len(points), 0.5)])
    rows.astype("<f4").tofile(path)


def write_open3d(path: Path, points: FloatArray, *, is_text: bool = False) -> None:
    """Write a PCD or PLY file with an attribute beside the coordinates."""
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))
    cloud.point["intensity"] = o3d.core.Tensor(np.ones((len(points), 1), dtype=np.float32))
    assert o3d.t.io.write_point_cloud(str(path), cloud, write_ascii=is_text)


def write_text(path: Path, points: FloatArray) -> None:
    write_open3d(path, points, is_text=True)


def write_times(path: Path, points: FloatArray, times: FloatArray) -> None:
    """Write a PCD or PLY file whose points have times, s since the stamp."""
    values = times.astype(np.float32).reshape(-1, 1)
    if path.suffix == ".pcd":
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))
        cloud.point["time"] = o3d.core.Tensor(values)
        assert o3d.t.io.write_point_cloud(str(path), cloud)
        return
    rows = np.column_stack([points, values]).astype("<f4")
    named = rows.view([(name, "<f4") for name in ("x", "y", "z", "time")]).reshape(-1)
    PlyData([PlyElement.describe(named, "vertex")]).write(path)


WRITERS: dict[str, tuple[str, Callable[[Path, FloatArray], None]]] = {
    "bin": (".bin", write_bin),
    "pcd": (".pcd", write_open3d),
    "pcd text": (".pcd", write_text),
    "ply": (".ply", write_open3d),
    "ply text": (".ply", write_text),
}


def folder_of(folder: Path, *names: str, points: FloatArray = POINTS) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        write_bin(folder / f"{name}.bin", points)
    return folder


def read(path: Path, **options: float) -> Log:
    return read_log(path, min_range_m=1.0, max_range_m=50.0, scan_rate_hz=options.get("rate"))


def scans_in(log: Log) -> list[Scan]:
    scans = [reading for reading in log.readings if isinstance(reading, Scan)]
    assert len(scans) == len(list(log.readings))
    return scans


def stamps_in(path: Path, **options: float) -> list[float]:
    return [scan.stamp_s for scan in scans_in(read(path, **options))]


# ------------------------------------------------------------------ formats


@pytest.mark.parametrize("name", WRITERS)
def test_points_within_the_ranges_come_back(tmp_path: Path, name: str) -> None:
    suffix, write = WRITERS[name]
    for number in range(3):
        write(tmp_path / f"{number}{suffix}", POINTS + number * np.array([0.0, 0.0, 0.25]))
    log = read(tmp_path)
    assert (log.scans, log.odometry, log.unread, log.malformed) == (3, 0, (), ())
    for number, scan in enumerate(scans_in(log)):
        expected = NEAR + number * np.array([0.0, 0.0, 0.25])
        np.testing.assert_allclose(scan.points_in_body, expected, atol=1e-6)
        assert scan.point_times is None


@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_times_of_points_are_shares_of_the_sweep_which_ends_with_it(
    tmp_path: Path, suffix: str
) -> None:
    write_times(tmp_path / f"100{suffix}", NEAR, np.array([0.0, 0.1]))
    (tmp_path / "times.txt").write_text("7.0\n")
    (scan,) = scans_in(read(tmp_path))
    assert scan.stamp_s == pytest.approx(7.1)
    assert scan.point_times is not None
    assert scan.point_times.tolist() == [0.0, 1.0]


def test_a_sequence_of_kitti_is_one_log(tmp_path: Path) -> None:
    folder_of(tmp_path / "velodyne", "000000", "000001")
    (tmp_path / "times.txt").write_text("0.0\n1.036e-01\n")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    (tmp_path / "image_2").mkdir()
    source = open_log(tmp_path)
    assert source.form == "sequence of KITTI"
    scans, poses = source.streams()
    assert (scans.name, scans.use, scans.messages) == ("velodyne/*.bin", Use.SCANS, 2)
    assert (poses.name, poses.use) == ("poses.txt", Use.NOTHING)
    for path in (tmp_path, tmp_path / "velodyne"):
        assert stamps_in(path) == [0.0, 0.1036]


def test_the_raw_recordings_of_kitti_have_dates_and_lack_scans(tmp_path: Path) -> None:
    folder = tmp_path / "velodyne_points"
    folder_of(folder / "data", "0000000000", "0000000002")
    lines = [f"2011-09-26 13:02:{25 + second}.500000000" for second in range(3)]
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")
    first_s = 1317042145.5
    assert stamps_in(tmp_path) == [first_s, first_s + 2.0]


def test_the_caller_says_where_the_sensor_is(tmp_path: Path) -> None:
    folder_of(tmp_path, "0")
    pose = planar_pose(1.0, 2.0, 0.5)
    log = read_log(tmp_path, min_range_m=1.0, max_range_m=50.0, body_from_sensor=pose)
    (scan,) = scans_in(log)
    np.testing.assert_allclose(scan.points_in_body, transform_points(pose, NEAR), atol=1e-6)
    assert scan.sensor_in_body.tolist() == [1.0, 2.0, 0.0]
    assert (log.mounting.says, read(tmp_path).mounting.says) == (Says.CALLER, Says.NOBODY)


def test_scans_in_other_formats_are_named(tmp_path: Path) -> None:
    folder_of(tmp_path, "0", "1")
    write_open3d(tmp_path / "0.ply", POINTS)
    assert read(tmp_path).unread == ("1 files *.ply",)


# ------------------------------------------------------------------ stamps


@pytest.mark.parametrize(
    ("names", "stamps_s"),
    [
        (("1305031102.25", "1305031102.5"), [1305031102.25, 1305031102.5]),
        (("1305031102", "1305031103"), [1305031102.0, 1305031103.0]),
        (("1305031102250", "1305031102500"), [1305031102.25, 1305031102.5]),
        (("1305031102250000", "1305031102500000"), [1305031102.25, 1305031102.5]),
        (("1305031102250000000", "1305031102500000000"), [1305031102.25, 1305031102.5]),
        (
            ("cloud_1305031102_250000000", "cloud_1305031102_500000000"),
            [1305031102.25, 1305031102.5],
        ),
        (("scan-0.5", "scan-1.25"), [0.5, 1.25]),
    ],
)
def test_names_that_are_stamps_are_taken(
    tmp_path: Path, names: tuple[str, ...], stamps_s: list[float]
) -> None:
    assert stamps_in(folder_of(tmp_path, *names)) == stamps_s
    assert read(tmp_path).notes == ()


def test_scans_are_in_the_order_of_their_stamps_not_of_their_names(tmp_path: Path) -> None:
    folder_of(tmp_path, "0", "1", "2")
    (tmp_path / "timestamps.txt").write_text("5.0\n4.0\n6.0\n")
    assert stamps_in(tmp_path) == [4.0, 5.0, 6.0]


def test_numbers_in_names_are_in_the_order_of_their_values(tmp_path: Path) -> None:
    for number in (9, 10, 100):
        write_bin(tmp_path / f"scan_{number}.bin", np.array([[float(number), 0.0, 0.0]]))
    log = read_log(tmp_path, min_range_m=1.0, max_range_m=500.0)
    assert [scan.points_in_body[0, 0] for scan in scans_in(log)] == [9.0, 10.0, 100.0]


def test_without_stamps_a_rate_is_assumed_and_said(tmp_path: Path) -> None:
    folder_of(tmp_path, "a", "b", "c")
    assert stamps_in(tmp_path) == pytest.approx([0.0, 0.1, 0.2])
    (note,) = read(tmp_path).notes
    assert "10 scans per second are assumed" in note.what
    assert "--scan-rate" in note.step
    assert stamps_in(tmp_path, rate=4.0) == [0.0, 0.25, 0.5]
    assert read(tmp_path, rate=4.0).notes == ()


def test_a_rate_is_for_folders_without_stamps(tmp_path: Path) -> None:
    folder_of(tmp_path, "1305031102.25")
    with pytest.raises(InvalidInput, match="stamped by their names: leave out --scan-rate"):
        read(tmp_path, rate=5.0)
    with pytest.raises(InvalidInput, match="no folder of scans"):
        read(tmp_path / "a.mcap", rate=5.0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("0.0\n", "1 stamps for 2 scans"),
        ("0.0\nsoon\n", "line 2: 'soon' is no stamp"),
        ("0.0\nnan\n", "line 2: 'nan' is no stamp"),
        ("0.0 1.0\n2.0 3.0\n", "line 1: '0.0 1.0' is no stamp"),
    ],
)
def test_stamps_that_do_not_fit_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    folder_of(tmp_path, "a", "b")
    (tmp_path / "times.txt").write_text(text)
    with pytest.raises(InvalidLog, match=reason):
        read(tmp_path)


# ------------------------------------------------------------------ what is broken


def test_a_broken_file_costs_itself_and_is_named(tmp_path: Path) -> None:
    folder_of(tmp_path, "0", "1", "2", "3")
    (tmp_path / "1.bin").write_bytes(b"1234567")
    (tmp_path / "2.bin").write_bytes(b"")
    write_bin(tmp_path / "3.bin", np.full((5, 3), np.nan))
    log = read(tmp_path)
    assert len(scans_in(log)) == 1
    told = {each.place: each.reason for each in log.malformed}
    assert told.keys() == {"1.bin", "2.bin", "3.bin"}
    assert "7 bytes are no multiple of 16" in told["1.bin"]
    assert (told["2.bin"], told["3.bin"]) == ("empty", "nan_ranges")


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "bin"])
def test_a_file_that_ends_early_is_left_out(tmp_path: Path, name: str) -> None:
    suffix, write = WRITERS[name]
    write(tmp_path / f"0{suffix}", POINTS)
    content = (tmp_path / f"0{suffix}").read_bytes()
    (tmp_path / f"1{suffix}").write_bytes(content[:-20])
    (tmp_path / f"2{suffix}").write_bytes(content[:30])
    (tmp_path / f"3{suffix}").write_bytes(b"nothing of the kind\n")
    (tmp_path / f"4{suffix}").write_bytes(b"")
    log = read(tmp_path)
    assert len(scans_in(log)) == 1
    assert sum(each.count for each in log.malformed) == 4


def test_a_cloud_without_coordinates_is_left_out(tmp_path: Path) -> None:
    write_open3d(tmp_path / "0.ply", POINTS)
    content = (tmp_path / "0.ply").read_bytes()
    (tmp_path / "1.ply").write_bytes(content.replace(b" z\n", b" w\n"))
    log = read(tmp_path)
    assert len(scans_in(log)) == 1
    assert "has no x, y and z" in log.malformed[0].reason


def test_a_folder_without_a_usable_scan_is_refused_with_the_first_reason(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.bin").write_bytes(b"123")
    with pytest.raises(InvalidLog, match=r"no usable scan in 3 files \*\.bin; 0\.bin: 3 bytes"):
        read(tmp_path)


def test_scans_in_several_folders_are_refused_with_their_names(tmp_path: Path) -> None:
    for name in ("left", "right"):
        folder_of(tmp_path / name, "0")
    with pytest.raises(InvalidLog, match=r"scans in 2 folders \(left, right\)"):
        read(tmp_path)


def test_what_is_no_folder_of_scans_says_the_next_step(tmp_path: Path) -> None:
    (tmp_path / "drive.mcap").touch()
    with pytest.raises(InvalidLog, match=r"neither metadata\.yaml .* such as .*drive\.mcap"):
        read(tmp_path)
    with pytest.raises(InvalidLog, match="one scan, which makes no map: name the folder"):
        read(tmp_path / "scan.pcd")


def test_a_sample_is_spread_over_the_folder(tmp_path: Path) -> None:
    folder_of(tmp_path, *map(str, range(10)))
    sampled = [scan.stamp_s for scan in read(tmp_path).sample(4)]
    assert sampled == pytest.approx([0.0, 0.3, 0.6, 0.9])


def test_the_recorded_piece_of_kitti_is_read(hmt_data: Path) -> None:
    log = read_log(hmt_data / "3d/kitti00-part", min_range_m=1.0, max_range_m=100.0)
    scans = scans_in(log)
    assert (log.scans, len(scans), log.malformed) == (110, 110, ())
    assert [scan.stamp_s for scan in scans[:3]] == [0.0, 0.2, 0.4]
