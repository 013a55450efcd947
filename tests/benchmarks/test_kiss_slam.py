"""KISS-SLAM: when its environment is complete, what it is given; installing is not tested here."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import kiss_slam, kiss_slam_runner
from benchmarks.chain import read_readings
from benchmarks.kiss_slam import (
    PINS,
    KissSlamPeer,
    KissSlamRun,
    find_environment,
    make_environment,
)
from benchmarks.processes import ChildFailed, ChildRun
from hmt_service.core.geometry import planar_pose
from hmt_service.core.types import Scan, StampedPose


class Installer:
    """Stands in for the programs that make an environment."""

    def __init__(self, fails_at: str | None = None) -> None:
        self.commands: list[list[str]] = []
        self.fails_at = fails_at

    def __call__(self, command: Sequence[str | Path], **_: Any) -> ChildRun:
        words = [str(word) for word in command]
        self.commands.append(words)
        if self.fails_at in words:
            raise ChildFailed("pip ended with code 1\n  no network")
        if "venv" in words:
            Path(words[-1]).mkdir(parents=True)
        return ChildRun(0.0, 0.0, "", ())


def test_an_environment_is_made_once_with_the_pins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installer = Installer()
    monkeypatch.setattr(kiss_slam, "run_child", installer)
    folder = tmp_path / "environment"
    assert find_environment(folder) is None
    python = make_environment(folder)
    assert python == folder / "bin" / "python"
    assert len(installer.commands) == 3
    assert set(PINS) <= set(installer.commands[1])
    assert make_environment(folder) == find_environment(folder) == python
    assert len(installer.commands) == 3


def test_an_environment_with_other_pins_is_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kiss_slam, "run_child", Installer())
    make_environment(tmp_path / "environment")
    (tmp_path / "environment" / "left-over").touch()
    monkeypatch.setattr(kiss_slam, "PINS", ("kiss-slam==9",))
    assert find_environment(tmp_path / "environment") is None
    make_environment(tmp_path / "environment")
    assert not (tmp_path / "environment" / "left-over").exists()


@pytest.mark.parametrize("step", ["pip", "import kiss_slam.slam"])
def test_an_environment_that_fails_half_way_does_not_count(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kiss_slam, "run_child", Installer(fails_at=step))
    with pytest.raises(ChildFailed, match="no network"):
        make_environment(tmp_path / "environment")
    assert find_environment(tmp_path / "environment") is None


def test_the_runner_loads_without_our_package() -> None:
    code = (
        "import sys; sys.modules['hmt_service'] = None; import benchmarks.kiss_slam_runner as r; "
        "print(r.__name__)"
    )
    root = Path(kiss_slam_runner.__file__).parents[1]
    import_it = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, check=True, text=True
    )
    assert import_it.stdout.strip() == "benchmarks.kiss_slam_runner"


def test_as_a_peer_it_maps_what_was_taken_and_is_asked_at_other_stamps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(python: Path, readings: Path, folder: Path, *, timeout_s: float) -> KissSlamRun:
        scans = list(read_readings(readings))
        assert (python, folder) == (Path("python"), tmp_path)
        assert timeout_s > 0.0
        trajectory = tuple(StampedPose(s.stamp_s, planar_pose(s.stamp_s, 0, 0)) for s in scans)
        return KissSlamRun(0.0, 0.0, 0.0, np.zeros(len(scans)), trajectory, 0, ())

    monkeypatch.setattr(kiss_slam, "run_kiss_slam", run)
    peer = KissSlamPeer(Path("python"), tmp_path)
    for stamp_s in range(5):
        peer.take(Scan(float(stamp_s), np.ones((2, 3)), np.zeros(3)))
    poses = peer.poses(np.array([0.1, 2.6, 9.0]))
    assert poses[:, 0, 3].tolist() == [0.0, 3.0, 4.0]
