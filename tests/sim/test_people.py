from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.core.geometry import FloatArray, exp, planar_pose
from hmt_service.errors import InvalidInput
from hmt_service.sim.people import BESIDE_M, HEIGHT_M, RADIUS_M, Crowd
from hmt_service.sim.raycasting import Fans, RayCaster
from hmt_service.sim.worlds.world import World

# A street up a slope of 10 %, then level and to the left, then the same way back.
STREET = np.array(
    [[0.0, 0.0, 0.0], [40.0, 0.0, 4.0], [40.0, 30.0, 4.0], [40.0, 0.0, 4.0], [0.0, 0.0, 0.0]]
)
REACH_M = 30.0


def crowd(people: int, seed: int = 0, route: FloatArray = STREET) -> Crowd:
    return Crowd(route, people, np.random.default_rng(seed))


def around(origin: FloatArray, rotation: FloatArray, columns: int, elevations: FloatArray) -> Fans:
    """Return one sweep all round of a sensor with this attitude."""
    angles = np.linspace(0.0, 2 * np.pi, columns, endpoint=False)
    level = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(columns)])
    return Fans(
        origin[None, None], rotation[None, None, :, 2], (level @ rotation.T)[None], elevations
    )


def seen(people: Crowd, fans: Fans, stamp_s: float) -> FloatArray:
    """Return the ranges to people in a world of nothing else, shape (C, R)."""
    shape = (*fans.forward.shape[:2], len(fans.elevations_rad))
    ranges = np.full(shape, np.inf, dtype=np.float32)
    people.occlude(ranges, fans, np.array([[stamp_s]]), REACH_M)
    return np.asarray(ranges[0], dtype=np.float64)


def prisms(feet_m: FloatArray, sides: int) -> World:
    """Return people as a mesh: upright prisms of many sides, with a foot and a head."""
    angles = np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    ring = RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    top = (0.0, 0.0, HEIGHT_M)
    vertices = np.concatenate([[*(feet + ring), *(feet + ring + top)] for feet in feet_m])
    a = np.arange(sides)
    b = (a + 1) % sides
    low = np.column_stack([a[1:-1] * 0, a[1:-1], a[2:]])
    faces = np.concatenate(
        [
            np.column_stack([a, b, b + sides]),
            np.column_stack([a, b + sides, a + sides]),
            low,
            low + sides,
        ]
    )
    triangles = np.concatenate([faces + 2 * sides * person for person in range(len(feet_m))])
    return World("people", vertices.astype(np.float32), triangles.astype(np.uint32), STREET)


def test_people_walk_beside_the_route_on_its_ground() -> None:
    people = crowd(40)
    for stamp_s in (0.0, 7.3, 100.0):
        feet = people.positions(stamp_s)
        assert feet.shape == (40, 3)
        on_first = np.abs(np.abs(feet[:, 1]) - BESIDE_M) < 1e-9
        on_second = np.abs(np.abs(feet[:, 0] - 40.0) - BESIDE_M) < 1e-9
        assert np.all(on_first | on_second)
        assert feet[on_first, 2] == pytest.approx(0.1 * feet[on_first, 0])
        assert feet[on_second, 2] == pytest.approx(4.0)


def test_people_walk_steadily_up_and_down() -> None:
    people = crowd(30)
    ways = np.array([people.positions(stamp_s)[:, :2] for stamp_s in np.arange(0.0, 120.0, 0.25)])
    speeds = np.linalg.norm(np.diff(ways, axis=0), axis=2) / 0.25
    assert np.median(speeds, axis=0).min() >= 1.2 * 0.85 - 1e-6
    assert speeds.max() <= 1.2 * 1.15 + 1e-6
    spans = np.ptp(ways, axis=0).max(axis=1)
    assert np.all((spans > 7.5) & (spans < 30.0 + 1e-6))


def test_nobody_jumps_where_the_route_bends_gently() -> None:
    angles = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    ring = 12.0 * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(12)])
    people = crowd(20, route=np.tile(ring, (3, 1)))
    ways = np.array([people.positions(stamp_s) for stamp_s in np.arange(0.0, 60.0, 0.05)])
    assert np.linalg.norm(np.diff(ways, axis=0), axis=2).max() < 0.2


def test_level_rays_meet_a_person_where_the_circle_is() -> None:
    people = crowd(1)
    (feet,) = people.positions(5.0)
    sensor = feet + (-3.0, 0.0, 0.5)
    fans = around(sensor, np.eye(3), 3600, np.zeros(1))
    angles = np.linspace(0.0, 2 * np.pi, 3600, endpoint=False)
    inside = RADIUS_M**2 - (3.0 * np.sin(angles)) ** 2
    is_met = (inside > 0.0) & (np.cos(angles) > 0.0)
    expected = np.where(is_met, 3.0 * np.cos(angles) - np.sqrt(np.maximum(inside, 0.0)), np.inf)
    assert seen(people, fans, 5.0)[:, 0] == pytest.approx(expected, rel=1e-6)
    assert is_met.sum() > 70


@pytest.mark.parametrize("seed", range(4))
def test_tilted_sweeps_meet_people_as_they_would_a_mesh_of_them(seed: int) -> None:
    rng = np.random.default_rng(seed)
    people = crowd(25, seed)
    stamp_s = rng.uniform(0.0, 100.0)
    feet = people.positions(stamp_s)
    tilt = exp(np.array([*rng.uniform(-0.3, 0.3, 2), 0.0, 0.0, 0.0, 0.0]))
    rotation = planar_pose(0.0, 0.0, rng.uniform(0.0, 6.0))[:3, :3] @ tilt[:3, :3]
    # Seed 2 looks down on a head.
    sensor = feet[0] + (1.0, 0.4, 2.2 if seed == 2 else 0.9)
    fans = around(sensor, rotation, 720, np.linspace(-1.2, 0.6, 40))
    ranges = seen(people, fans, stamp_s)
    mesh = RayCaster(prisms(feet, 720), REACH_M).ranges(fans)[0]
    near = np.minimum(ranges, mesh) < REACH_M
    # Rays that graze a person may miss the prism inside of it.
    both = np.isfinite(ranges) & np.isfinite(mesh) & near
    assert np.count_nonzero(near & ~both) < 0.01 * np.count_nonzero(both)
    assert np.percentile(np.abs(ranges[both] - mesh[both]), 99) < 2e-3
    assert np.count_nonzero(both) > 300


def test_only_rays_that_meet_somebody_change() -> None:
    people = crowd(10)
    fans = around(
        people.positions(3.0)[0] + (0.0, -0.5, 0.5), np.eye(3), 360, np.array([-0.1, 0.2])
    )
    before = np.random.default_rng(1).uniform(0.1, 10.0, (1, 360, 2)).astype(np.float32)
    after = before.copy()
    people.occlude(after, fans, np.array([[3.0]]), REACH_M)
    ahead = seen(people, fans, 3.0).astype(np.float32)[None]
    assert np.array_equal(after, np.minimum(before, ahead))
    assert 10 < np.count_nonzero(after != before) < 360


def test_each_column_sees_people_where_they_are_then() -> None:
    people = crowd(1)
    times = np.linspace(20.0, 21.0, 50)
    feet = np.array([people.positions(stamp_s)[0] for stamp_s in times])
    sensor = feet[0] + (2.0, -2.0, 0.5)
    ways = feet - sensor
    distances = np.hypot(ways[:, 0], ways[:, 1])
    level = np.column_stack([ways[:, :2] / distances[:, None], np.zeros(50)])
    origins = np.broadcast_to(sensor, (1, 50, 3))
    up = np.broadcast_to([0.0, 0.0, 1.0], (1, 50, 3))
    ranges = np.full((1, 50, 1), np.inf, dtype=np.float32)
    people.occlude(ranges, Fans(origins, up, level[None], np.zeros(1)), times[None], REACH_M)
    assert ranges[0, :, 0] == pytest.approx(distances - RADIUS_M, rel=1e-6)
    assert np.ptp(distances) > 0.3


def test_somebody_around_the_sensor_or_behind_it_is_not_seen() -> None:
    people = crowd(1)
    (feet,) = people.positions(0.0)
    inside = around(feet + (0.05, 0.0, 1.0), np.eye(3), 90, np.array([-1.0, 0.0, 1.0]))
    assert np.isinf(seen(people, inside, 0.0)).all()
    away = Fans(
        (feet + (3.0, 0.0, 1.0))[None, None],
        np.array([[[0.0, 0.0, 1.0]]]),
        np.array([[[1.0, 0.0, 0.0]]]),
        np.linspace(-1.5, 1.5, 31),
    )
    assert np.isinf(seen(people, away, 0.0)).all()


def test_people_are_as_likely_everywhere_along_the_route() -> None:
    people = crowd(600, seed=3)
    on_slope = np.abs(np.abs(people.positions(0.0)[:, 1]) - BESIDE_M) < 1e-9
    # 80 m of 140 m; five standard deviations of a share of 600.
    share = 80.0 / 140.0
    assert on_slope.mean() == pytest.approx(share, abs=5 * math.sqrt(share * (1 - share) / 600))


def test_same_seed_draws_the_same_people() -> None:
    assert np.array_equal(crowd(5, 1).positions(9.0), crowd(5, 1).positions(9.0))
    assert not np.array_equal(crowd(5, 1).positions(9.0), crowd(5, 2).positions(9.0))


def test_fewer_people_than_none_are_refused() -> None:
    with pytest.raises(InvalidInput, match="-1 people"):
        crowd(-1)


def test_nobody_changes_nothing() -> None:
    nobody = crowd(0)
    assert nobody.positions(1.0).shape == (0, 3)
    assert np.isinf(seen(nobody, around(np.zeros(3), np.eye(3), 8, np.zeros(1)), 0.0)).all()
