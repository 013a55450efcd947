"""What was unlikely wins when its evidence comes; what nothing tells apart stays divided.

Rooms look the same from their fronts, and some differ behind a partition. A robot that has been in
all of them, and then elsewhere, comes back into one after a trip of which only its wheels tell, or
wakes up in one. In front, each room has the mass that the wheels give it: no more is to be known.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
import pytest

from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    certain,
    identity,
    inverse,
    planar_pose,
)
from hmt_service.core.types import Snapshot, Tracking
from tests.core.factories import (
    ROOM,
    Walls,
    box,
    line,
    motion_covariance,
    points_from,
    processed,
    shifted,
    trackings_of,
)

FRONT = np.concatenate(
    [
        [[1.0, -3.0, -4.0, -3.0], [-4.0, -3.0, -4.0, 3.0], [-4.0, 3.0, 1.0, 3.0]],
        [[-2.5, 1.5, -1.0, 1.5], [-1.5, -3.0, -1.5, -2.2], [-4.0, 0.8, -3.4, 0.8]],
        box(-3.2, -2.2, -2.4, -1.6),
        [[1.0, -3.0, 1.0, 2.0]],
    ]
)
"""The last wall is the partition: it leaves a gap of 1 m to pass."""


def back(depth_m: float, *standing: Walls) -> Walls:
    """Return what is behind the partition, where that is seen only by who goes there."""
    end_m = 1.0 + depth_m
    around = [[1.0, -3.0, end_m, -3.0], [end_m, -3.0, end_m, 3.0], [end_m, 3.0, 1.0, 3.0]]
    return np.concatenate([around, *standing])


BACKS = {
    "short": back(2.0, box(1.2, -2.8, 2.0, -2.0)),
    "deep": back(5.0, box(2.8, -2.6, 3.6, -1.0)),
    "screen": back(3.5, np.array([[1.0, -1.6, 4.5, -1.6]])),
}
IN_FRONT = line(planar_pose(-2.5, 0.0, 0.0), length_m=2.0, step_m=0.4)
BEHIND = [
    *[planar_pose(-0.4 + 0.2 * i, 0.3 + 0.45 * i, 0.8) for i in range(4)],
    *[planar_pose(0.5 + 0.4 * i, 2.4, 0.5 - 0.4 * i) for i in range(4)],
    *[planar_pose(2.1 + 0.1 * i, 1.8 - 0.6 * i, -1.2) for i in range(4)],
]
INSIDE = [*IN_FRONT, *BEHIND]
ELSEWHERE = line(planar_pose(60.0, 60.0, 0.0), length_m=2.0)
KNOWN = motion_covariance(0.01, 0.1)
"""Of the trips from room to room."""
ENTERED = load_config().areas.min_keyframes - 1
"""Keyframe of a stay at which it is known to be another area than the one before."""


@dataclass(frozen=True)
class Building:
    """Rooms with the same front, each with a back of its own, and one that is like none of them."""

    backs: tuple[str, ...]
    rooms_m: tuple[tuple[float, float], ...]
    """Where they are."""

    @property
    def walls(self) -> Walls:
        rooms = [
            shifted(np.concatenate([FRONT, BACKS[name]]), *room_m)
            for name, room_m in zip(self.backs, self.rooms_m, strict=True)
        ]
        return np.concatenate([*rooms, shifted(ROOM, 61.0, 60.0)])

    def stay(self, room: int) -> list[Pose]:
        """Return the way through a room, from its front to its back."""
        return [planar_pose(*self.rooms_m[room], 0.0) @ pose for pose in INSIDE]

    def stays(self) -> list[list[Pose]]:
        """Return the way through all rooms, and on to elsewhere."""
        return [*(self.stay(room) for room in range(len(self.backs))), ELSEWHERE]

    def trackings(self, stays: list[list[Pose]], seed: int, *trips: GaussianPose) -> list[Tracking]:
        """Return what the odometry says of some stays; of the trips to the last ones, as told."""
        known = [GaussianPose(inverse(a[-1]) @ b[0], KNOWN) for a, b in pairwise(stays)]
        motions = [certain(identity()), *known][: len(stays) - len(trips)]
        return trackings_of(
            *((self.walls, *each) for each in zip(stays, [*motions, *trips], strict=True)),
            noise=np.random.default_rng(seed),
        )


def pair(*backs: str) -> Building:
    return Building(backs, ((0.0, 0.0), (12.0, 0.0)))


def triangle(*backs: str) -> Building:
    return Building(backs, ((0.0, 0.0), (12.0, 0.0), (6.0, 6.0 * np.sqrt(3.0))))


@dataclass(frozen=True)
class Return:
    """A robot that is back in a room."""

    engine: Engine
    snapshots: list[Snapshot]
    """One per keyframe since."""
    truth: list[Pose]
    """Where all keyframes are."""

    def shares(self, rooms: int) -> FloatArray:
        """Return the mass of each of so many rooms at each keyframe, shape (K, rooms)."""
        beliefs = [snapshot.posterior.current_area for snapshot in self.snapshots]
        return np.array([[b.get(room, 0.0) for room in range(rooms)] for b in beliefs])

    def errors_m(self) -> FloatArray:
        """Return how far the map has each keyframe from where it is, shape (K,)."""
        first = inverse(self.truth[0])
        return np.array(
            [
                np.linalg.norm((first @ true)[:2, 3] - found.reference_from_body[:2, 3])
                for true, found in zip(self.truth, self.engine.trajectory(), strict=True)
            ]
        )


def returned(
    building: Building,
    room: int,
    *,
    wheels_m: tuple[float, float],
    sigma_m: float,
    seed: int,
    budget: int = 15,
) -> Return:
    """Let a robot come back into a room.

    Args:
        building: Rooms, all of which it knows.
        room: The room.
        wheels_m: Where that room would be if the wheels were right.
        sigma_m: Standard deviation of what they say.
        seed: Seed of the noise of the ranges.
        budget: Most hypotheses that may be kept.
    """
    stays = [*building.stays(), building.stay(room)]
    arrival = inverse(ELSEWHERE[-1]) @ planar_pose(*wheels_m, 0.0) @ INSIDE[0]
    blind = GaussianPose(arrival, motion_covariance(0.01, sigma_m))
    config = load_config(text=f"particles: {{budget: {budget}}}")
    engine, snapshots = processed(building.trackings(stays, seed, blind), config)
    engine.finish()
    return Return(engine, snapshots[-len(INSIDE) :], [*chain(*stays)])


def awakened(building: Building, room: int, *, seed: int) -> Return:
    """Let a robot wake up in a room of a building that is in its map."""
    stays = building.stays()
    engine, _ = processed(building.trackings(stays, seed))
    engine.finish()
    going_on = Engine.restored(engine.stored())
    stay = building.stay(room)
    engine, snapshots = processed(building.trackings([stay], seed + 100), known=going_on)
    return Return(engine, snapshots, [*chain(*stays, stay)])


def shares_by_wheels(
    building: Building, wheels_m: tuple[float, float], sigma_m: float
) -> FloatArray:
    """Return the probability of each room if nothing but the wheels tells where the robot is."""
    gaps_m = np.linalg.norm(np.array(building.rooms_m) - wheels_m, axis=1)
    masses = np.exp(-0.5 * (gaps_m / sigma_m) ** 2)
    return np.asarray(masses / masses.sum())


DIFFERENT = [pair("deep", "screen"), pair("short", "screen")]


@pytest.mark.parametrize("building", [*DIFFERENT, triangle("short", "deep", "screen")])
def test_fronts_tell_nothing_apart(building: Building) -> None:
    ways = [building.stay(room) for room in range(len(building.backs))]
    for same in list(zip(*ways, strict=True))[: len(IN_FRONT)]:
        first, *others = (points_from(building.walls, pose) for pose in same)
        assert all(other == pytest.approx(first, abs=1e-9) for other in others)


@pytest.mark.parametrize("building", DIFFERENT)
@pytest.mark.parametrize("room", [0, 1])
@pytest.mark.parametrize("sigma_m", [5.0, 6.0])
def test_right_but_unlikely_wins_later_and_only_among_several(
    building: Building, room: int, sigma_m: float
) -> None:
    # The wheels have gone 1 m from the other room: they are wrong by about twice what they say.
    wheels_m = ((11.0, 0.0), (1.0, 0.0))[room]
    expected = shares_by_wheels(building, wheels_m, sigma_m)[room]
    assert 0.05 < expected < 0.2
    for seed in range(3):
        several, one = (
            returned(building, room, wheels_m=wheels_m, sigma_m=sigma_m, seed=seed, budget=budget)
            for budget in (15, 1)
        )
        right = several.shares(2)[:, room]
        assert right[ENTERED : len(IN_FRONT)] == pytest.approx(expected, abs=0.05)
        assert right[-1] > 0.95
        snapshot = several.snapshots[-1]
        assert snapshot.posterior.hypotheses[0].topological_path == (0, 1, 2, room)
        assert several.errors_m().max() < 0.2
        # What was most likely at first is all that a single hypothesis knows ever after.
        assert one.shares(2)[-1, 1 - room] == 1.0
        assert one.errors_m()[-1] > 10.0


@pytest.mark.parametrize(
    ("building", "wheels_m"),
    [
        (pair("short", "deep"), (6.0, 0.0)),
        (triangle("short", "deep", "screen"), (6.0, 2.0 * np.sqrt(3.0))),
    ],
)
def test_loop_to_rooms_that_look_alike_is_divided_evenly_until_they_do_not(
    building: Building, wheels_m: tuple[float, float]
) -> None:
    rooms = len(building.backs)
    for room in range(rooms):
        back = returned(building, room, wheels_m=wheels_m, sigma_m=5.0, seed=room)
        shares = back.shares(rooms)
        assert shares[ENTERED : len(IN_FRONT)] == pytest.approx(1.0 / rooms, abs=0.1)
        assert shares[-1, room] > 0.95
        assert back.errors_m().max() < 0.2


@pytest.mark.parametrize("x_m", [6.0, 7.5, 3.0])
def test_loop_to_identical_rooms_stays_divided_as_the_wheels_say(x_m: float) -> None:
    building = pair("deep", "deep")
    expected = shares_by_wheels(building, (x_m, 0.0), 6.0)
    for room in (0, 1):
        shares = returned(building, room, wheels_m=(x_m, 0.0), sigma_m=6.0, seed=room).shares(2)
        for share in shares[ENTERED:]:
            assert share == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("building", [pair("deep", "deep"), triangle("deep", "deep", "deep")])
def test_who_wakes_up_in_one_of_identical_rooms_stays_divided_evenly(building: Building) -> None:
    rooms = len(building.backs)
    for room in range(rooms):
        shares = awakened(building, room, seed=room).shares(rooms)
        assert shares == pytest.approx(1.0 / rooms, abs=0.1)


@pytest.mark.parametrize("building", [pair("short", "deep"), triangle("short", "deep", "screen")])
def test_who_wakes_up_in_rooms_that_look_alike_knows_where_they_do_not(building: Building) -> None:
    rooms = len(building.backs)
    for room in range(rooms):
        woken = awakened(building, room, seed=room)
        shares = woken.shares(rooms)
        assert shares[: len(IN_FRONT)] == pytest.approx(1.0 / rooms, abs=0.1)
        assert shares[-1, room] > 0.95
        assert woken.errors_m().max() < 0.2
