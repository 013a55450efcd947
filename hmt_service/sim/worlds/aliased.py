"""A building made to deceive: rooms that look the same and are not.

References:
    own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_service.sim.worlds.plan import CLEARANCE_M, Box, furniture, interior, on_floor
from hmt_service.sim.worlds.world import World

_RASTER_M = 1.0 / 64.0
"""All copies lie on this raster, which floating point holds exactly: they are equal to the bit."""
_WALL_M = 10.0 * _RASTER_M
_CORRIDOR_M = 2.5
_DOOR_M = 1.125
_DEPTH_M = 4.75
_REACH_M = 2.5
"""How far the route goes into a room, measured from its door."""

_Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Slot:
    """Where a room is: the middle of its corridor wall; the room lies ahead of who looks along y.

    What belongs to a room is given in this frame, so that copies are equal.
    """

    x: float
    y: float
    quarter_turns: int

    def place(self, box: Box) -> Box:
        """Return a box of the room in the frame of the building."""
        return box.moved(self.x, self.y, self.quarter_turns)

    def point(self, x: float, y: float) -> _Point:
        """Return a point of the room in the frame of the building."""
        placed = self.place(Box(x, y, x, y))
        return placed.x_min, placed.y_min


@dataclass(frozen=True, slots=True)
class _Building:
    """What is there before any room is furnished."""

    corridors: list[Box]
    slots: list[_Slot]
    stops: list[_Slot | _Point]
    """Way of the robot: rooms to enter and leave, and corners of corridors."""
    is_doubly_lined: bool
    """Whether there are rooms on both sides of each corridor."""


@dataclass(frozen=True, slots=True)
class _Room:
    """A room and its stretch of the corridor, in the frame of its slot."""

    door_x: float
    free: list[Box]
    standing: list[Box]


def aliased(seed: int, severity: float = 0.9) -> World:
    """Draw a building of rooms of one width: a ring of corridors, or two wings joined by a link.

    Each room is, with probability `severity`, an exact copy of one furnished room, and its stretch
    of the corridor is blank; else it has a depth, a place of the door and furniture of its own, and
    a cabinet stands in the corridor. The route of 150 m to 300 m enters some rooms, comes back to
    some of them, and passes many that it never enters.

    Args:
        seed: The same seed gives the same world.
        severity: From 0, no room is like another, to 1, all are equal to the bit.
    """
    rng = np.random.default_rng(seed)
    pitch = 4.0 + _on_raster(rng.uniform(0.25, 0.75))
    building = _ring(pitch, rng) if rng.random() < 0.5 else _twin_wings(pitch, rng)
    copied = _furnished(pitch, 0.0, _DEPTH_M, rng)
    rooms = {}
    for slot in building.slots:
        # Drawn even where it is not needed, so that another severity changes no other room.
        own = _individual(pitch, building.is_doubly_lined, rng)
        rooms[slot] = copied if rng.random() < severity else own

    free, standing = list(building.corridors), []
    for slot, room in rooms.items():
        free += [slot.place(box) for box in room.free]
        standing += [slot.place(box) for box in room.standing]
    route: list[_Point] = []
    for stop in building.stops:
        if isinstance(stop, _Slot):
            outside, inside = (
                stop.point(rooms[stop].door_x, y) for y in (-_CORRIDOR_M / 2, _REACH_M)
            )
            route += [outside, inside, outside]
        else:
            route.append(stop)
    mesh = interior(free, standing)
    return World(f"aliased-{seed}", mesh.vertices, mesh.triangles, on_floor(route))


def _on_raster(value: float) -> float:
    """Return the nearest multiple of the raster."""
    return round(value / _RASTER_M) * _RASTER_M


def _box_on_raster(box: Box) -> Box:
    """Return the box with its corners on the raster."""
    return Box(
        _on_raster(box.x_min),
        _on_raster(box.y_min),
        _on_raster(box.x_max),
        _on_raster(box.y_max),
        box.height,
    )


def _ring(pitch: float, rng: np.random.Generator) -> _Building:
    """Draw a ring of four corridors with rooms on their outer sides.

    The route runs once around, entering a room on each side, then enters the same rooms of the
    first two sides again and a new one on the third.
    """
    counts = [int(count) for count in rng.integers(5, 8, 2)] * 2
    width, height = counts[0] * pitch, counts[1] * pitch
    corners = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)]
    headings = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    half = _CORRIDOR_M / 2
    sides = [
        [
            _Slot(
                x + (k + 0.5) * pitch * along_x + half * along_y,
                y + (k + 0.5) * pitch * along_y - half * along_x,
                2 + side,
            )
            for k in range(counts[side])
        ]
        for side, ((x, y), (along_x, along_y)) in enumerate(zip(corners, headings, strict=True))
    ]
    corridors = [
        Box(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)).grown(half)
        for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    entered = [side[rng.integers(len(side))] for side in sides]
    never_before = [slot for slot in sides[2] if slot != entered[2]]
    stops: list[_Slot | _Point] = [corners[0]]
    for slot, corner in zip(entered, corners[1:] + corners[:1], strict=True):
        stops += [slot, corner]
    stops += [entered[0], corners[1], entered[1], corners[2]]
    stops.append(never_before[rng.integers(len(never_before))])
    return _Building(corridors, [slot for side in sides for slot in side], stops, False)


def _twin_wings(pitch: float, rng: np.random.Generator) -> _Building:
    """Draw two parallel corridors with rooms on both sides, joined by a link in the middle.

    The route enters a room on either side of the link in the first wing, the same in the second,
    then comes back: once more into the first room, and into a new one.
    """
    count, half = int(rng.integers(3, 5)), _CORRIDOR_M / 2
    nearest = half + 2 * _WALL_M
    other_y = _CORRIDOR_M + 2 * _DEPTH_M + _on_raster(rng.uniform(0.5, 6.0))
    xs = [nearest + (k + 0.5) * pitch for k in range(count)]
    # Rooms by wing and side of the link: pairs that face each other across the corridor.
    rooms = {
        (y, sign): [
            _Slot(sign * x, y + turn, 0 if turn > 0.0 else 2) for x in xs for turn in (half, -half)
        ]
        for y in (0.0, other_y)
        for sign in (-1.0, 1.0)
    }
    end = nearest + count * pitch
    corridors = [Box(-end, y - half, end, y + half) for y in (0.0, other_y)]
    corridors.append(Box(-half, 0.0, half, other_y))
    west, east, other_west, other_east = (
        slots[rng.integers(2, len(slots))] for slots in rooms.values()
    )
    unseen = [slot for slot in rooms[0.0, 1.0] if slot != east]
    start, far = (0.0, 0.0), (0.0, other_y)
    stops: list[_Slot | _Point]
    stops = [start, west, east, start, far, other_west, other_east, far, start, west]
    stops += [start, unseen[rng.integers(len(unseen))], start]
    return _Building(corridors, [slot for slots in rooms.values() for slot in slots], stops, True)


def _furnished(pitch: float, door_x: float, depth: float, rng: np.random.Generator) -> _Room:
    """Draw the furniture of a room."""
    half = (pitch - _WALL_M) / 2
    inside = Box(-half, _WALL_M, half, depth)
    doorway = Box(door_x - _DOOR_M / 2, -_WALL_M, door_x + _DOOR_M / 2, 2 * _WALL_M)
    lane = Box(door_x - CLEARANCE_M, 0.0, door_x + CLEARANCE_M, _REACH_M + CLEARANCE_M)
    pieces = furniture(inside, [lane], int(rng.integers(5, 9)), rng)
    return _Room(door_x, [inside, doorway], [_box_on_raster(piece) for piece in pieces])


def _individual(pitch: float, is_doubly_lined: bool, rng: np.random.Generator) -> _Room:
    """Draw a room that is like no other, and a cabinet in its stretch of the corridor."""
    room = _furnished(pitch, rng.uniform(-0.9, 0.9), rng.uniform(3.9, _DEPTH_M), rng)
    length, depth = rng.uniform(0.5, 1.2), rng.uniform(0.15, 0.4)
    if is_doubly_lined:
        # On its own wall, on the wider side of the door.
        x = -pitch / 2 if room.door_x > 0.0 else pitch / 2 - length
        cabinet = Box(x, -depth, x + length, 0.0, 1.2)
    else:
        # On the opposite wall, which ends sooner at the corners of the ring.
        free = (pitch - _CORRIDOR_M) / 2
        x = rng.uniform(-free, free - length)
        cabinet = Box(x, -_CORRIDOR_M, x + length, depth - _CORRIDOR_M, 1.2)
    return _Room(room.door_x, room.free, [*room.standing, cabinet])
