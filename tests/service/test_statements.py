"""What an operator says of two areas, through a real daemon: weighed, stored, taken back."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hmt_service.cli.app import app
from hmt_service.client import HmtClient
from hmt_service.core.geometry import Pose, inverse
from hmt_service.core.types import EventKind, StatementEffect
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.map_file import read_map
from tests.flat import readings
from tests.mapped import map_file_in, mapped
from tests.service.harness import RunningDaemon, running_daemon, wait_until

SCANS = 120


def drive_away(client: HmtClient) -> None:
    """Let the robot begin anywhere in the map, and leave both of its areas for good."""
    for reading in readings(SCANS):
        client.publish(replace(reading, stamp_s=reading.stamp_s + 1e4))
    wait_until(lambda: client.status().processed_scans == SCANS)


def second_in_first(client: HmtClient) -> tuple[int, int, Pose]:
    first, second = sorted(client.areas().areas, key=lambda area: area.area)[:2]
    a, b = (area.reference_from_area.mean for area in (first, second))
    return first.area, second.area, inverse(a) @ b


def test_a_statement_is_weighed_explained_stored_and_taken_back(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    with running_daemon(tmp_path / "out", map_file=known) as daemon, daemon.client() as client:
        first, second, pose = second_in_first(client)
        before = client.status()
        effect = client.assert_arc(
            first, second, pose, sigma_m=0.05, sigma_rad=0.01, probability=0.9
        )
        assert isinstance(effect, StatementEffect)
        assert sum(one.after for one in effect.hypotheses if one.is_right) > 0.85
        assert sum(one.after for one in effect.hypotheses) == pytest.approx(1.0)
        assert effect.revision == before.revision + 1
        # No scan has come, and everybody knows it, and the file has it.
        wait_until(lambda: client.status().revision == effect.revision)
        assert client.posterior().revision == effect.revision
        wait_until(lambda: EventKind.ARC_ASSERTED in {e.kind for e in client.events()})
        assert read_map(known).revision == effect.revision
        with_it = client.area(second, with_points=False).area.reference_from_area.sigma_m
        drive_away(client)
        taken_back = client.retract_arc(effect.statement)
        assert taken_back.statement == effect.statement
        without_it = client.area(second, with_points=False).area.reference_from_area.sigma_m
        assert with_it < without_it
        with pytest.raises(NotFound, match="is not one of this run"):
            client.retract_arc(effect.statement)


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    folder = tmp_path_factory.mktemp("said")
    with running_daemon(folder / "out", map_file=map_file_in(folder)) as running:
        yield running


def test_a_daemon_says_what_is_wrong_with_a_statement(daemon: RunningDaemon) -> None:
    with daemon.client() as client:
        first, second, pose = second_in_first(client)
        with pytest.raises(InvalidInput, match="probability 1 is not"):
            client.assert_arc(first, second, pose, sigma_m=0.1, sigma_rad=0.01, probability=1.0)
        with pytest.raises(InvalidInput, match="not above 0"):
            client.assert_arc(first, second, pose, sigma_m=-0.1, sigma_rad=0.01, probability=0.9)
        with pytest.raises(NotFound, match="area 99"):
            client.assert_arc(first, 99, pose, sigma_m=0.1, sigma_rad=0.01, probability=0.5)
        with pytest.raises(InvalidInput, match="x='nan'"):
            client.assert_arc(
                first, second, pose * float("nan"), sigma_m=0.1, sigma_rad=0.01, probability=0.5
            )
        assert client.status().keyframes == len(mapped().stored().keyframes)


def test_a_frozen_map_does_not_listen(tmp_path: Path) -> None:
    known = map_file_in(tmp_path)
    options = ["--frozen"]
    with (
        running_daemon(tmp_path / "out", map_file=known, options=options) as running,
        running.client() as client,
    ):
        first, second, pose = second_in_first(client)
        with pytest.raises(Unavailable, match="frozen"):
            client.assert_arc(first, second, pose, sigma_m=0.1, sigma_rad=0.01, probability=0.5)


def test_the_commands_show_what_a_statement_did(daemon: RunningDaemon) -> None:
    at = ["--connect", daemon.endpoint]
    with daemon.client() as client:
        first, second, pose = second_in_first(client)
    numbers = [f"{number:.6f}" for number in (*pose[:3, 3], 0.0, 0.0, 0.0)]
    options = ["--pose", *numbers, "--sigma-deg", "0.1", "--probability", "0.8"]
    asserted = CliRunner().invoke(
        app, ["ctl", "assert-arc", str(first), str(second), *options, *at, "--json"]
    )
    assert asserted.exit_code == 0, asserted.output
    effect = json.loads(asserted.output)
    assert {one["is_right"] for one in effect["hypotheses"]} == {True, False}
    retracted = CliRunner().invoke(app, ["ctl", "retract-arc", str(effect["statement"]), *at])
    assert retracted.exit_code == 0, retracted.output
    assert f"statement {effect['statement']}: areas {first} and {second}" in retracted.output
