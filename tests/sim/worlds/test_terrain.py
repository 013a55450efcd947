from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_service.sim.worlds.plan import Box, mesh_of
from hmt_service.sim.worlds.terrain import Footprint, Site, Terrain

AREA = Box(-100.0, -80.0, 100.0, 80.0)


def drawn(relief_m: float, *level: Footprint, seed: int = 0) -> Terrain:
    return Terrain.drawn(relief_m, level, np.random.default_rng(seed))


def test_footprint_frame_goes_there_and_back() -> None:
    place = Footprint(10.0, 20.0, 4.0, 2.0, math.pi / 2)
    assert place.to_world(np.array([2.0, 0.0])) == pytest.approx([10.0, 22.0])
    assert place.to_world(np.array([0.0, 1.0])) == pytest.approx([9.0, 20.0])
    points = np.random.default_rng(0).normal(size=(5, 2))
    assert place.from_world(place.to_world(points)) == pytest.approx(points)


@pytest.mark.parametrize("seed", range(5))
def test_hills_stay_within_the_relief(seed: int) -> None:
    heights = drawn(1.5, seed=seed).mesh(Box(-500.0, -500.0, 500.0, 500.0)).vertices[:, 2]
    assert 0.5 < np.abs(heights).max() <= 1.5


def test_no_relief_is_flat() -> None:
    assert np.all(drawn(0.0).mesh(AREA).vertices[:, 2] == 0.0)


def test_mesh_follows_the_heights_between_its_corners() -> None:
    terrain = drawn(1.5, Footprint(0.0, 0.0, 30.0, 15.0))
    mesh = terrain.mesh(AREA)
    middles = mesh.vertices[mesh.triangles].astype(float).mean(axis=1)
    assert middles[:, 2] == pytest.approx(terrain.heights(middles[:, :2]), abs=0.02)


def test_ground_is_level_under_a_footprint_and_no_step_leads_there() -> None:
    place = Footprint(20.0, -10.0, 40.0, 16.0, 0.7)
    terrain = drawn(3.0, place)
    inside = np.random.default_rng(0).uniform((-20.0, -8.0), (20.0, 8.0), (50, 2))
    heights = terrain.heights(place.to_world(inside))
    assert heights == pytest.approx(heights[0])
    line = place.to_world(np.column_stack([np.linspace(0.0, 120.0, 1201), np.zeros(1201)]))
    assert np.abs(np.diff(terrain.heights(line))).max() < 0.02
    # Far away the hills are as without it.
    bare = Terrain(terrain.amplitudes, terrain.waves_rad_per_m, terrain.phases_rad)
    assert terrain.heights(line[-1]) == pytest.approx(bare.heights(line[-1]))


def test_site_refuses_ground_that_is_taken() -> None:
    site = Site(AREA, drawn(0.0))
    thing = mesh_of([Box(-1.0, -1.0, 1.0, 1.0)])
    assert site.add(thing, Footprint(0.0, 0.0, 4.0, 2.0, 0.3))
    assert not site.add(thing, Footprint(1.5, 0.0, 4.0, 2.0))
    assert site.add(thing, Footprint(0.0, 4.0, 4.0, 2.0))
    site.take(Footprint(30.0, 0.0, 60.0, 3.0))
    assert not site.add(thing, Footprint(50.0, 1.0, 1.0, 1.0))
    assert len(site.meshes) == 1 + 2


def test_site_puts_things_on_the_ground() -> None:
    terrain = drawn(2.0)
    site = Site(AREA, terrain)
    site.add(mesh_of([Box(-1.0, -1.0, 1.0, 1.0, 3.0)]), Footprint(40.0, 30.0, 2.0, 2.0, 1.0))
    ground = float(terrain.heights(np.array([40.0, 30.0])))
    assert site.meshes[-1].vertices[:, 2].min() == pytest.approx(ground)
    assert site.meshes[-1].vertices[:, :2].mean(axis=0) == pytest.approx([40.0, 30.0])


def test_somewhere_is_inside_the_area() -> None:
    site, rng = Site(AREA, drawn(0.0)), np.random.default_rng(0)
    for _ in range(50):
        place = site.somewhere(30.0, 20.0, rng)
        corners = place.to_world(np.array([[x, y] for x in (-15.0, 15.0) for y in (-10.0, 10.0)]))
        assert np.all(corners > (AREA.x_min, AREA.y_min))
        assert np.all(corners < (AREA.x_max, AREA.y_max))
