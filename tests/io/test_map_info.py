"""`map_info` against the engine that made the map."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from math import log
from pathlib import Path

import numpy as np
import pytest

from hmt_service import __version__
from hmt_service.core.config import Preset, load_config
from hmt_service.io.map_file import write_map
from hmt_service.io.map_info import map_info
from hmt_service.io.map_rows import SCHEMA_VERSION
from tests.mapped import SCANS, map_file_in, mapped


def test_numbers_are_those_of_the_engine(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    info, engine, stored = map_info(path), mapped(), mapped().stored()
    snapshot = engine.snapshot()
    assert snapshot is not None
    assert (info.scans, info.keyframes, info.visits) == (SCANS, len(stored.keyframes), 3)
    assert info.points == sum(len(k.points_in_body) for k in stored.keyframes)
    assert info.file_bytes == path.stat().st_size
    assert (info.schema_version, info.created_by) == (SCHEMA_VERSION, f"hmt-service {__version__}")
    assert (info.revision, info.seed) == (stored.revision, stored.seed)
    positions = [pose.reference_from_body[:3, 3] for pose in engine.trajectory()]
    assert info.length_m == pytest.approx(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    assert info.length_m == pytest.approx(29.9, abs=0.2)
    assert (info.first_stamp_s, info.last_stamp_s) == pytest.approx((1000.0, 1014.95))
    (found,), (known,) = info.hypotheses, snapshot.posterior.hypotheses
    assert (found.hypothesis, found.areas) == (known.hypothesis, known.areas)
    assert (found.loop_closures, found.arcs) == (known.loop_closures, snapshot.arcs)
    assert found.probability == pytest.approx(known.probability)


@pytest.mark.parametrize(("preset", "sensor"), [(Preset.PLANAR, "planar"), (Preset.INDOOR, "3-D")])
def test_sensor_and_preset_are_known_by_the_settings(
    tmp_path: Path, preset: Preset, sensor: str
) -> None:
    config = load_config(preset)
    stored = replace(mapped().stored(), config_json=config.model_dump_json())
    write_map(tmp_path / "map.hmt", stored)
    info = map_info(tmp_path / "map.hmt")
    assert (info.sensor, info.preset, info.config_hash) == (sensor, preset, config.hash())


def test_settings_that_are_no_preset_are_none(tmp_path: Path) -> None:
    assert map_info(map_file_in(tmp_path)).preset is None


def test_hypotheses_come_with_the_most_probable_first(tmp_path: Path) -> None:
    stored = mapped().stored()
    (only,) = stored.hypotheses
    two = (replace(only, hypothesis=8, log_weight=log(0.2)), replace(only, log_weight=log(0.8)))
    write_map(tmp_path / "map.hmt", replace(stored, hypotheses=two))
    found = map_info(tmp_path / "map.hmt").hypotheses
    assert [h.hypothesis for h in found] == [only.hypothesis, 8]
    assert [h.probability for h in found] == pytest.approx([0.8, 0.2])


def test_points_are_not_decompressed(tmp_path: Path) -> None:
    path = map_file_in(tmp_path)
    expected = map_info(path).points
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("UPDATE keyframes SET points_in_body = substr(points_in_body, 1, 40)")
    assert map_info(path).points == expected
