"""`hmt run` on a log that the test writes, and on recorded ones."""

from __future__ import annotations

import bz2
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hmt_service.cli.app import app
from hmt_service.core.geometry import inverse, planar_pose, yaw_of
from hmt_service.io.map_check import check_map
from hmt_service.io.map_file import read_map
from hmt_service.io.relations import evaluate, read_relations
from hmt_service.io.trajectory import read_tum
from tests.flat import BEAMS, path, ranges_from
from tests.ros import Ros, Stamped, write_bag2

SCANS = 240
BEARINGS = np.radians(np.arange(180) - 90.0)


def carmen_lines(scans: int) -> list[str]:
    """Return a drive through both rooms of the flat as FLASER lines."""
    lines = []
    for index, world_from_body in enumerate(path(scans)):
        ranges = np.minimum(ranges_from(world_from_body, BEARINGS), 81.83)
        x, y = world_from_body[:2, 3]
        pose = f"{x:.6f} {y:.6f} {yaw_of(world_from_body):.6f}"
        readings = " ".join(f"{r:.3f}" for r in ranges)
        stamp = f"{100.0 + 0.2 * index:.6f} nohost 0"
        lines.append(f"FLASER 180 {readings} {pose} {pose} {stamp}")
    return lines


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lines = carmen_lines(SCANS)
    lines[10:10] = ["FLASER 180 1.0 2.0", "FLASER 180 nonsense"]
    file = tmp_path_factory.mktemp("log") / "flat.clf.bz2"
    file.write_bytes(bz2.compress("\n".join(lines).encode()))
    return file


def run(log: Path, out: Path, *arguments: str) -> Result:
    return CliRunner().invoke(app, ["run", str(log), "--out", str(out), *arguments])


def test_run_writes_a_pose_per_scan_near_the_truth(log: Path, tmp_path: Path) -> None:
    assert run(log, tmp_path / "out").exit_code == 0
    poses = read_tum(tmp_path / "out" / "trajectory.tum")
    truth = path(SCANS)
    errors = [
        np.linalg.norm((truth[0] @ p.reference_from_body)[:2, 3] - t[:2, 3])
        for p, t in zip(poses, truth, strict=True)
    ]
    assert np.max(errors) < 0.05
    assert poses[0].stamp_s == pytest.approx(100.0)


def test_a_bag_of_ros_is_run_with_its_laser_upside_down_and_sideways(tmp_path: Path) -> None:
    truth, bearings = path(SCANS), np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    body_from_sensor = planar_pose(0.2, 0.0, np.pi / 2.0)
    sent: list[Stamped] = []
    for index, world_from_body in enumerate(truth):
        stamp_s = 100.0 + 0.2 * index
        ranges = ranges_from(world_from_body @ body_from_sensor, -bearings)
        odom_from_body = inverse(truth[0]) @ world_from_body
        sent.append(("/odom", stamp_s, Ros().odometry(odom_from_body, stamp_s=stamp_s)))
        sent.append(("/scan", stamp_s, Ros().laser_scan(ranges, stamp_s=stamp_s)))
    pose = ("--sensor-pose", "0.2", "0", "0", "180", "0", "90")
    result = run(write_bag2(tmp_path / "flat", sent), tmp_path / "out", *pose)
    assert f"{SCANS} scans, {SCANS} odometry readings" in result.stderr
    assert "malformed" not in result.stderr
    for found, true in zip(read_tum(tmp_path / "out" / "trajectory.tum"), truth, strict=True):
        at = (truth[0] @ found.reference_from_body)[:2, 3]
        np.testing.assert_allclose(at, true[:2, 3], atol=0.05)


def test_a_pose_of_the_sensor_is_for_ros(log: Path, tmp_path: Path) -> None:
    result = run(log, tmp_path, "--sensor-pose", *"000000")
    assert "say where the laser sits" in str(result.exception)
    result = run(log, tmp_path, "--sensor-pose", *"00000", "nan")
    assert "not finite" in str(result.exception)


def test_run_reports_malformed_lines_by_number(log: Path, tmp_path: Path) -> None:
    result = run(log, tmp_path)
    assert f"{SCANS} scans, {SCANS} odometry readings" in result.stderr
    assert "malformed and left out: 2" in result.stderr
    assert "line 11:" in result.stderr
    assert "line 12:" in result.stderr


def test_same_log_and_seed_give_the_same_bytes(log: Path, tmp_path: Path) -> None:
    for name in ("first", "second"):
        run(log, tmp_path / name, "--seed", "7")
    for file in ("trajectory.tum", "map.hmt", "events.jsonl", "posterior.jsonl"):
        first, second = ((tmp_path / name / file).read_bytes() for name in ("first", "second"))
        assert first == second


def test_a_map_goes_on_with_another_log(log: Path, tmp_path: Path) -> None:
    run(log, tmp_path / "first")
    known = tmp_path / "first" / "map.hmt"
    before = known.read_bytes()
    for name in ("second", "again"):
        assert run(log, tmp_path / name, "--map", str(known)).exit_code == 0
    assert known.read_bytes() == before
    second, again = (tmp_path / name / "map.hmt" for name in ("second", "again"))
    assert second.read_bytes() == again.read_bytes()
    assert check_map(second) == ()
    first, both = read_map(known), read_map(second)
    assert len(both.scans) == 2 * len(first.scans)
    assert len(both.keyframes) == 2 * len(first.keyframes)
    # Where it went on is where it had begun.
    last, end = read_tum(second.with_name("trajectory.tum"))[-1], path(SCANS)
    truth = inverse(end[0]) @ end[-1]
    assert last.reference_from_body[:2, 3] == pytest.approx(truth[:2, 3], abs=0.1)
    other = run(log, tmp_path / "third", "--map", str(known), "--preset", "2d")
    assert "has settings of its own" in str(other.exception)
    missing = run(log, tmp_path / "third", "--map", str(tmp_path / "none.hmt"))
    assert "does not exist" in str(missing.exception)


def test_a_memory_budget_changes_no_byte_of_the_map(log: Path, tmp_path: Path) -> None:
    outs = [tmp_path / name for name in ("all", "some")]
    for out, arguments in zip(outs, ([], ["--memory-budget", "32MB"]), strict=True):
        result = run(log, out, *arguments)
        assert result.exit_code == 0, result.output
    for name in ("map.hmt", "trajectory.tum"):
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()
    summary = json.loads((outs[1] / "summary.json").read_text())
    # The whole flat fits.
    assert 0.0 < summary["submaps_mb"]["memory"] < 32.0
    assert summary["submaps_mb"]["disk"] == 0.0


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ("many", "no size of memory"),
        ("-1GB", "no size of memory"),
        ("900kB", "0.9 MB is too small"),
    ],
)
def test_a_budget_that_is_none_is_refused(
    log: Path, tmp_path: Path, size: str, expected: str
) -> None:
    result = run(log, tmp_path, "--memory-budget", size)
    assert expected in str(result.exception)


def test_summary_and_map_file_agree(log: Path, tmp_path: Path) -> None:
    run(log, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text())
    stored = read_map(tmp_path / "map.hmt")
    assert summary["scans"] == len(stored.scans) == SCANS
    assert summary["keyframes"] == len(stored.keyframes)
    assert sum(h["probability"] for h in summary["posterior"]) == pytest.approx(1.0)
    assert summary["busy_s"]["odometry"] > 0.0
    assert summary["peak_memory_mb"] > 10.0


def test_a_wrong_preset_is_a_warning_with_numbers_and_no_error(log: Path, tmp_path: Path) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text("odometry: {keyframe_distance_m: 0.4}")  # enough for a verdict
    result = run(log, tmp_path, "--preset", "3d-indoor", "--config", str(settings))
    assert result.exit_code == 0
    (warning,) = json.loads((tmp_path / "summary.json").read_text())["warnings"]
    assert "of one plane through the sensor: 2d would fit better" in warning
    assert [line for line in result.stderr.splitlines() if "warning: " in line] == [
        f"warning: {warning}"
    ]


def test_the_right_preset_gives_no_warning(log: Path, tmp_path: Path) -> None:
    assert "warning" not in run(log, tmp_path).stderr
    assert json.loads((tmp_path / "summary.json").read_text())["warnings"] == []


def test_settings_change_the_map_and_its_hash(log: Path, tmp_path: Path) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text("odometry: {keyframe_distance_m: 1.0}")
    run(log, tmp_path / "preset")
    run(log, tmp_path / "changed", "--config", str(settings))
    preset, changed = (
        json.loads((tmp_path / name / "summary.json").read_text()) for name in ("preset", "changed")
    )
    assert changed["keyframes"] < preset["keyframes"]
    assert changed["config_hash"] != preset["config_hash"]


def test_a_log_without_a_scan_is_an_error(tmp_path: Path) -> None:
    empty = tmp_path / "empty.log"
    empty.write_text("FLASER 180 1.0\n")
    result = run(empty, tmp_path / "out")
    assert result.exit_code != 0
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "most_m", "pairs"),
    # The bounds are the project's targets for these logs, not what was last measured.
    [("intel", 0.05, 2984), ("fr079", 0.08, 1685)],
)
def test_recorded_log_within_its_target(
    hmt_data: Path, tmp_path: Path, name: str, most_m: float, pairs: int
) -> None:
    assert run(hmt_data / "2d" / f"{name}.clf.bz2", tmp_path).exit_code == 0
    relations = read_relations(hmt_data / "2d" / f"{name}.relations")
    errors = evaluate(read_tum(tmp_path / "trajectory.tum"), relations)
    assert (errors.matched, errors.unmatched) == (pairs, 0)
    assert errors.all_pairs.translation_mean_m <= most_m
    assert errors.loop_closures is not None
    assert errors.loop_closures.translation_mean_m <= 2.0 * most_m


def test_trajectory_starts_at_the_origin_of_the_reference(log: Path, tmp_path: Path) -> None:
    run(log, tmp_path)
    first = read_tum(tmp_path / "trajectory.tum")[0].reference_from_body
    np.testing.assert_allclose(first, np.eye(4), atol=1e-9)
