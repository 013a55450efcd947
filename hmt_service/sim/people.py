"""People who walk up and down beside the route: upright cylinders that a sensor sees.

References:
    own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.errors import InvalidInput
from hmt_service.sim.raycasting import Fans

RADIUS_M = 0.2
"""Radius of a person."""
HEIGHT_M = 1.75
"""Height of a person."""
BESIDE_M = 0.5
"""Distance of a person's middle from the route."""
_SPEED_M_S = 1.2
_SPEED_SPREAD = 0.15
_STRETCH_M = (8.0, 30.0)
# A person does not follow the route round sharper corners, but turns back before them.
_SHARP_COS = math.cos(math.radians(60.0))
_STRIDE_M = 0.5
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class _Person:
    """Somebody who walks up and down a stretch of the route."""

    start_m: float
    """Where the stretch starts, along the route."""
    length_m: float
    """Its length."""
    speed_m_s: float
    """Of walking."""
    phase_m: float
    """Way walked before time zero."""
    side: float
    """1: to the left of the route, -1: to the right."""


class Crowd:
    """All people of a world; where each one is at any time is known beforehand."""

    def __init__(self, route_m: FloatArray, people: int, rng: np.random.Generator) -> None:
        """Draw the people.

        Args:
            route_m: Waypoints, shape (W, 3), m; consecutive ones differ in x or y.
            people: How many.
            rng: Source of their ways.

        Raises:
            InvalidInput: If there are fewer than none.
        """
        if people < 0:
            raise InvalidInput(f"{people} people")
        legs = np.diff(route_m, axis=0)
        lengths = np.linalg.norm(legs[:, :2], axis=1)
        self._heights_m = route_m[:, 2]
        self._route = route_m[:, 0] + 1j * route_m[:, 1]
        self._travelled = np.concatenate([[0.0], np.cumsum(lengths)])
        self._people = _drawn(legs[:, :2] / lengths[:, None], self._travelled, people, rng)
        # Nobody goes farther from the middle of the stretch than half its length.
        middles = np.array([each.start_m + each.length_m / 2 for each in self._people])
        level = self._level(middles)
        self._middles_m = np.column_stack([level.real, level.imag])
        self._radii_m = np.array([each.length_m / 2 + BESIDE_M + RADIUS_M for each in self._people])

    def occlude(
        self, ranges: npt.NDArray[np.float32], fans: Fans, times_s: FloatArray, reach_m: float
    ) -> None:
        """Shorten the ranges of rays that meet somebody.

        A ray that starts inside a person does not meet that person.

        Args:
            ranges: How far the world is along each ray, shape (S, C, R), m; changed in place.
            fans: The rays.
            times_s: When each fan is taken, shape (S, P).
            reach_m: People farther away may be left out.
        """
        near = self._near(fans.origins_m, reach_m)
        if not near:
            return
        normals = np.cross(fans.forward, fans.up)
        beside_m, behind_m = _extents(normals), _extents(fans.forward)
        for person in near:
            ways = self._at(person, times_s) + (0.0, 0.0, HEIGHT_M / 2) - fans.origins_m
            # A fan lies in a half-plane. It misses somebody who is beside the plane or behind the
            # origin altogether.
            may_meet = np.abs(_dot(normals, ways)) <= beside_m
            may_meet &= _dot(fans.forward, ways) >= -behind_m
            may_meet &= _dot(ways, ways) <= (reach_m + HEIGHT_M) ** 2
            ways, up = (np.broadcast_to(each, normals.shape)[may_meet] for each in (ways, fans.up))
            ahead = _cylinder_ranges(ways, fans.forward[may_meet], up, fans.elevations_rad)
            ranges[may_meet] = np.minimum(ranges[may_meet], ahead)

    def positions(self, stamp_s: float) -> FloatArray:
        """Return where the feet of all people are at a time, shape (N, 3), m."""
        at = np.array(stamp_s)
        return np.array([self._at(person, at) for person in self._people]).reshape(-1, 3)

    def _near(self, origins_m: FloatArray, reach_m: float) -> list[_Person]:
        """Return those whose stretch is within reach of any origin, and perhaps a few more."""
        level = origins_m[..., :2]
        nearest = np.clip(self._middles_m, level.min(axis=(0, 1)), level.max(axis=(0, 1)))
        gaps = np.linalg.norm(self._middles_m - nearest, axis=1)
        return [self._people[each] for each in np.flatnonzero(gaps <= reach_m + self._radii_m)]

    def _at(self, person: _Person, times_s: FloatArray) -> FloatArray:
        """Return where the feet of a person are, shape (...) -> (..., 3)."""
        walked = (person.phase_m + person.speed_m_s * times_s) % (2.0 * person.length_m)
        along = person.start_m + np.minimum(walked, 2.0 * person.length_m - walked)
        # A stride back and forth, so that nobody jumps sideways where the route bends.
        ends = person.start_m, person.start_m + person.length_m
        ahead, behind = (np.clip(along + step, *ends) for step in (_STRIDE_M, -_STRIDE_M))
        heading = self._level(ahead) - self._level(behind)
        level = self._level(along) + 1j * person.side * BESIDE_M * heading / np.abs(heading)
        height = np.interp(along, self._travelled, self._heights_m)
        return np.stack([level.real, level.imag, height], axis=-1)

    def _level(self, at: FloatArray) -> npt.NDArray[np.complex128]:
        """Return points of the route as x + i y (turning one to the left is a product with i)."""
        return np.asarray(np.interp(at, self._travelled, self._route), dtype=np.complex128)


def _drawn(
    headings: FloatArray, travelled: FloatArray, people: int, rng: np.random.Generator
) -> tuple[_Person, ...]:
    """Draw people on the runs of the route that bend gently, each as likely as it is long."""
    turns = np.sum(headings[:-1] * headings[1:], axis=1)
    (sharp,) = np.nonzero(turns < _SHARP_COS)
    borders = np.concatenate([[0], sharp + 1, [len(headings)]])
    starts, ends = travelled[borders[:-1]], travelled[borders[1:]]
    drawn = []
    for _ in range(people):
        run = rng.choice(len(starts), p=(ends - starts) / travelled[-1])
        length = min(rng.uniform(*_STRETCH_M), ends[run] - starts[run])
        drawn.append(
            _Person(
                start_m=rng.uniform(starts[run], ends[run] - length),
                length_m=length,
                speed_m_s=_SPEED_M_S * rng.uniform(1.0 - _SPEED_SPREAD, 1.0 + _SPEED_SPREAD),
                phase_m=rng.uniform(0.0, 2.0 * length),
                side=rng.choice((-1.0, 1.0)),
            )
        )
    return tuple(drawn)


def _extents(directions: FloatArray) -> FloatArray:
    """Return how far a person reaches from its middle along unit vectors, (..., 3) -> (...), m."""
    level = np.hypot(directions[..., 0], directions[..., 1])
    return np.asarray(RADIUS_M * level + HEIGHT_M / 2 * np.abs(directions[..., 2]))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the scalar products over the last axis: faster than a sum of so few."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def _cylinder_ranges(
    ways: FloatArray, forward: FloatArray, up: FloatArray, elevations_rad: FloatArray
) -> FloatArray:
    """Return how far a person is along the rays of fans, shape (K, R), m; infinite: missed.

    Args:
        ways: From the origins to the middle of the person, shape (K, 3), m.
        forward: Unit vectors of elevation zero, shape (K, 3).
        up: Unit vectors of elevation 90 degrees, shape (K, 3).
        elevations_rad: Of the rays, shape (R,).
    """
    level, rise = np.cos(elevations_rad), np.sin(elevations_rad)
    x, y, z = (forward[:, axis, None] * level + up[:, axis, None] * rise for axis in range(3))
    way_x, way_y, way_z = ways.T[..., None]
    # Between the two points where the ray crosses the mantle, seen from above ...
    square = x**2 + y**2 + _TINY
    nearest = (x * way_x + y * way_y) / square
    half2 = (RADIUS_M**2 - way_x**2 - way_y**2) / square + nearest**2
    half = np.sqrt(np.maximum(half2, 0.0))
    # ... and between those where it crosses the planes of feet and head, it is inside.
    steep = np.where(np.abs(z) < _TINY, _TINY, z)
    thick = HEIGHT_M / 2 / np.abs(steep)
    entry = np.maximum(nearest - half, way_z / steep - thick)
    leave = np.minimum(nearest + half, way_z / steep + thick)
    is_met = (half2 > 0.0) & (entry < leave) & (entry > 0.0)
    return np.asarray(np.where(is_met, entry, np.inf))
