from __future__ import annotations

import numpy as np
import pytest

from hmt_service.sim.raycasting import RayCaster
from hmt_service.sim.worlds.office import office
from hmt_service.sim.worlds.world import World
from tests.sim.worlds import beams


@pytest.mark.parametrize("seed", range(40))
def test_route_is_long_and_keeps_inside_the_building(seed: int) -> None:
    world = office(seed)
    length = np.linalg.norm(np.diff(world.route_m, axis=0), axis=1).sum()
    assert 150.0 < length < 230.0
    assert np.all(world.route_m[:, :2] > world.vertices[:, :2].min(axis=0))
    assert np.all(world.route_m[:, :2] < world.vertices[:, :2].max(axis=0))


def test_route_passes_the_first_junction_three_times() -> None:
    route = office(0).route_m
    passes = np.all(route == route[0], axis=1)
    assert passes.sum() == 3


def test_mesh_is_made_of_closed_boxes() -> None:
    world = office(0)
    edges = world.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    directed = {(int(a), int(b)) for a, b in edges}
    # On a closed, consistently oriented surface every edge is used once in each direction.
    assert len(directed) == len(edges)
    assert directed == {(b, a) for a, b in directed}


def test_faces_look_outwards() -> None:
    world = office(0)
    a, b, c = (world.vertices[world.triangles[:, corner]].astype(float) for corner in range(3))
    centres = world.vertices.reshape(-1, 8, 3).mean(axis=1).repeat(12, axis=0)
    outwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), a - centres)
    assert np.all(outwards > 0.0)


def test_floor_and_ceiling_change_no_horizontal_beam() -> None:
    world = office(0)
    slabs = 2 * 12
    bare = World(world.name, world.vertices, world.triangles[:-slabs], world.route_m)
    eyes = world.route_m + (0.0, 0.0, 0.3)
    with_slabs, without = (
        beams.ranges(RayCaster(each), eyes, beams.level(180)) for each in (world, bare)
    )
    assert np.array_equal(with_slabs, without)
    down = np.array([[0.0, 0.0, -1.0]])
    assert np.all(np.isinf(beams.ranges(RayCaster(bare), eyes, down)))
