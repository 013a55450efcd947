"""`hmt view`: a recording, a page in a browser, and live beside a daemon."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv
from matplotlib.image import imread
from rerun.chunk import RrdReader
from selenium.webdriver.common.by import By
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.cli.view import LiveView
from hmt_service.client.local import free_endpoint
from hmt_service.core.geometry import FloatArray
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.exporters.rerun import colour_of
from hmt_service.viz.view import View
from tests.browser import browser
from tests.flat import readings
from tests.mapped import SCANS, saved_run_in
from tests.service.harness import running_daemon, wait_until

PAGE_DEADLINE_S = 300.0
"""The viewer compiles itself in the browser, and draws without a graphics card."""


def entities_in(recorded: Path) -> dict[str, int]:
    """Return how many rows every entity has."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(recorded).stream().to_chunks():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    return rows


@contextmanager
def viewing(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """Run `hmt view`, and end it as a service manager does."""
    command = [sys.executable, "-m", "hmt_service", "view", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(PAGE_DEADLINE_S)


def free_port() -> int:
    return int(free_endpoint().rpartition(":")[2])


def in_colour_of(area: int, picture: FloatArray) -> int:
    """Return how many pixels of a picture, shape (H, W, 3), have the hue of an area."""
    hsv = rgb_to_hsv(picture)
    (hue, _, _) = rgb_to_hsv(np.array(colour_of(area)) / 255.0)
    apart = np.abs((hsv[..., 0] - hue + 0.5) % 1.0 - 0.5)
    return int(((apart < 0.04) & (hsv[..., 1] > 0.3)).sum())


def test_a_map_is_written_as_a_recording(tmp_path: Path) -> None:
    folder, out = saved_run_in(tmp_path / "flat"), tmp_path / "view.rrd"
    result = CliRunner().invoke(app, ["view", str(folder), "--save", str(out)])
    assert result.exit_code == 0, result.output
    rows = entities_in(out)
    assert rows["/map/robot"] > 100
    assert {"/map/areas/1/points", "/rivals/1/areas/2/ellipsoid", "/events"} <= set(rows)


def test_options_that_exclude_each_other_are_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["view", "--web", "--save", str(tmp_path / "view.rrd")])
    assert isinstance(result.exception, InvalidInput)


def test_nobody_to_ask_is_said_before_anything_opens(tmp_path: Path) -> None:
    out = tmp_path / "view.rrd"
    arguments = ["view", "--connect", free_endpoint(), "--timeout", "1", "--save", str(out)]
    assert isinstance(CliRunner().invoke(app, arguments).exception, Unavailable)
    assert list(tmp_path.iterdir()) == []


def test_missing_extra_is_an_error_with_the_next_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "hmt_service.viz.view")
    monkeypatch.setitem(sys.modules, "rerun", None)
    result = CliRunner().invoke(app, ["view", str(tmp_path / "map.hmt")])
    assert "pip install 'hmt-service[view]'" in str(result.exception)


def test_the_served_page_draws_both_areas_in_a_browser(tmp_path: Path) -> None:
    folder = saved_run_in(tmp_path / "flat")
    with (
        browser(tmp_path / "profile", width=1200, height=800) as chrome,
        viewing(folder, "--web", "--port", free_port()) as process,
    ):
        assert process.stdout is not None
        chrome.get(process.stdout.readline().strip())
        pictures: list[FloatArray] = []

        def is_drawn() -> bool:
            canvases = chrome.find_elements(By.TAG_NAME, "canvas")
            if not canvases:
                return False
            picture = imread(io.BytesIO(canvases[0].screenshot_as_png))[..., :3]
            # The map: the other views have the colours of areas, too.
            pictures.append(picture[60 : len(picture) // 2, : picture.shape[1] // 2])
            return all(in_colour_of(area, pictures[-1]) > 200 for area in (0, 1))

        wait_until(is_drawn, timeout_s=PAGE_DEADLINE_S)
        assert len(np.unique((255 * pictures[-1]).astype(int).reshape(-1, 3), axis=0)) > 200
    assert process.returncode == 0


def test_a_window_without_a_screen_is_an_error_with_the_next_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    result = CliRunner().invoke(app, ["view", str(saved_run_in(tmp_path / "flat"))])
    assert isinstance(result.exception, Unavailable)
    assert "--web and --save need no screen" in str(result.exception)


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    folder, port = saved_run_in(tmp_path / "flat"), free_port()
    with viewing(folder, "--web", "--port", port) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith(f"http://127.0.0.1:{port}/")
        second = CliRunner().invoke(app, ["view", str(folder), "--web", "--port", str(port)])
        assert f"port {port + 1} of 127.0.0.1" in str(second.exception)


def test_live_it_follows_a_daemon_and_draws_what_changes(tmp_path: Path) -> None:
    sent = readings(SCANS)
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        view = View("test")
        view.save(tmp_path / "live.rrd")
        live = LiveView(client, view, None)
        half = len(sent) // 2
        for reading in sent[:half]:
            client.publish(reading)
        client.finish()
        rest = iter(sent[half:])

        def is_open() -> bool:
            for reading in rest:
                client.publish(reading)
            status = client.status()
            return status.processed_scans < SCANS or live.revision != status.revision

        live.run(is_open)
        known = client.map()
        view.disconnect()
    rows = entities_in(tmp_path / "live.rrd")
    assert len(known.areas) == 2
    for area in known.areas:
        assert f"/map/areas/{area.area}/points" in rows
    assert rows["/map/robot"] > 0
    assert rows["/belief/ess"] > 1
    assert rows["/map/path"] > 0


def test_live_a_recording_is_complete_when_it_is_stopped(tmp_path: Path) -> None:
    out = tmp_path / "live.rrd"
    part = out.with_name("live.rrd.part")
    with running_daemon(tmp_path / "out") as daemon, daemon.client() as client:
        for reading in readings(20):
            client.publish(reading)
        client.finish()
        with pytest.raises(NotFound, match="hypothesis 4711 is not one of"):
            LiveView(client, View("test"), 4711).run(lambda: True)
        with viewing("--connect", daemon.endpoint, "--save", out) as process:
            wait_until(lambda: part.exists() and b"/map/areas/0/points" in part.read_bytes())
            assert not out.exists()
    assert process.returncode == 0
    assert not part.exists()
    assert entities_in(out)["/map/areas/0/points"] == 1
