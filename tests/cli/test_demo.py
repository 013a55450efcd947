"""`hmt demo` as a user runs it: a process, a daemon, files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from matplotlib.image import imread

from hmt_service.io.map_file import read_map


def test_demo_maps_a_building_over_zenoh_and_draws_it(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "hmt_service", "demo", "--out", str(tmp_path / "demo")],
        capture_output=True,
        text=True,
        timeout=180.0,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for title in ("shortest paths against consistent", "contradiction between arc and areas"):
        assert title in done.stdout
    stored = read_map(tmp_path / "demo" / "map.hmt")
    assert any(a.area_from_visit is not None for a in stored.hypotheses[0].assignments)
    picture = imread(tmp_path / "demo" / "map.png")
    assert picture.shape[0] > 500
    assert picture.std() > 0.01
