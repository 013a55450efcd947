"""A map that does not fit into its memory is the same map."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import pytest

from hmt_service.core.config import Config, Preset, load_config
from hmt_service.core.engine import Engine
from hmt_service.core.types import EventKind, MapMethod, Reading
from hmt_service.core.visits import MemoryBudget
from hmt_service.io.carmen import read_carmen
from hmt_service.io.map_file import write_map
from hmt_service.io.map_store import MapStore
from hmt_service.io.shelf import DiskShelf
from hmt_service.runtime.offline import map_readings
from hmt_service.sim.sensors import Laser2d
from hmt_service.sim.simulation import Robot, simulate
from hmt_service.sim.worlds.families import Family, draw
from tests.core.budgets import tiny

TINY = 300_000


def office(scans: int) -> list[Reading]:
    # A few rooms, and back through some of them: loops close.
    robot = Robot(sensor=Laser2d(beams=181, max_range_m=12.0), scan_period_s=0.5)
    instants = simulate(draw(Family.OFFICE, 3), robot, 3)
    return [reading for instant in islice(instants, scans) for reading in instant.readings]


def outcome(engine: Engine, file: Path) -> tuple[str, list[bytes]]:
    """Return everything that there is to ask for."""
    maps = [engine.global_map(method) for method in MapMethod]
    areas = [area for placed in maps for area in placed.areas]
    numbers = [pose.reference_from_body.tobytes() for pose in engine.trajectory()]
    numbers += [area.points_in_area.tobytes() for area in areas]
    numbers += [area.reference_from_area.covariance.tobytes() for area in areas]
    return write_map(file, engine.stored()), numbers


def assert_same_with(
    readings: Iterable[Reading], config: Config, budget: MemoryBudget, tmp_path: Path
) -> None:
    readings, file = tuple(readings), tmp_path / "map.hmt"
    whole = map_readings(readings, config)[0]
    expected, data = outcome(whole, file), file.read_bytes()
    small = map_readings(readings, config, known=Engine(config, budget=budget))[0]
    assert outcome(small, file) == expected
    assert file.read_bytes() == data
    # Half of the points, and more of what is made of them, is not in memory.
    usage = small.memory_usage
    assert whole.memory_usage is None
    assert usage is not None
    assert usage.shelf_bytes > 0.5 * sum(k.points_in_body.nbytes for k in whole.stored().keyframes)


def test_a_map_on_the_shelf_is_the_same_in_every_bit(tmp_path: Path) -> None:
    assert_same_with(office(900), load_config(), tiny(TINY), tmp_path)


def test_a_known_map_is_gone_on_with_from_the_shelf(tmp_path: Path) -> None:
    known, later = tmp_path / "known.hmt", office(300)
    write_map(known, map_readings(office(500), load_config())[0].stored())
    outcomes = []
    for budget in (None, tiny(TINY)):
        with MapStore(known).reading() as stored:
            assert stored is not None
            engine = Engine.restored(stored, budget=budget)
        usage = engine.memory_usage
        assert usage is None or usage.held_bytes < 3 * TINY
        map_readings(later, load_config(), known=engine)
        outcomes.append(outcome(engine, tmp_path / "later.hmt"))
    assert outcomes[0] == outcomes[1]


def test_a_map_that_the_disk_has_no_room_for_is_the_same_and_says_so(tmp_path: Path) -> None:
    readings, file, shelf = office(400), tmp_path / "map.hmt", DiskShelf()
    pages = 40
    shelf._opened().execute(f"PRAGMA max_page_count = {pages}")
    expected = outcome(map_readings(readings, load_config())[0], file)
    engine = Engine(load_config(), budget=tiny(TINY, shelf))
    assert outcome(map_readings(readings, load_config(), known=engine)[0], file) == expected
    (event,) = [e for e in engine.audit.events if e.kind is EventKind.OVER_BUDGET]
    assert "do not fit into the folder for temporary files" in event.message
    assert event.numbers["held_bytes"] > TINY
    assert 0 < event.numbers["shelf_bytes"] < 4096 * pages


@pytest.mark.parametrize("budget_bytes", [1, 1_500_000])
def test_intel_on_the_shelf_is_the_same_in_every_bit(
    hmt_data: Path, tmp_path: Path, budget_bytes: int
) -> None:
    config = load_config(Preset.PLANAR)
    log = hmt_data / "2d/intel.clf.bz2"
    sensor = config.sensor
    recorded = read_carmen(log, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m)
    # A third of it, several loops.
    assert_same_with(recorded.readings[:18_000], config, tiny(budget_bytes), tmp_path)
