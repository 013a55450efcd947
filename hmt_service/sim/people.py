"""People who walk up and down beside the route: upright cylinders that a sensor sees.

References:
    own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

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
        self._route_m = route_m
        self._travelled = np.concatenate([[0.0], np.cumsum(lengths)])
        self._people = _drawn(legs[:, :2] / lengths[:, None], self._travelled, people, rng)

    def ranges(self, fans: Fans, stamps_s: FloatArray, reach_m: float) -> FloatArray:
        """Return how far the first person is along each ray, shape (M, R), m; infinite: none.

        A person whom the origin of a ray is inside of is not seen by it.

        Args:
            fans: Rays.
            stamps_s: Time of each fan, shape (M,).
            reach_m: People farther away may be left out.
        """
        ranges = np.full((len(stamps_s), len(fans.elevations_rad)), np.inf)
        for person in self._people:
            if not self._may_be_near(person, fans.origins_m, reach_m):
                continue
            middles = self._at(person, stamps_s)
            middles[:, 2] += HEIGHT_M / 2
            (seen,) = np.nonzero(_may_meet(fans, middles, reach_m))
            ranges[seen] = np.minimum(ranges[seen], _cylinder_ranges(fans, seen, middles[seen]))
        return ranges

    def positions(self, stamp_s: float) -> FloatArray:
        """Return where the feet of all people are at a time, shape (N, 3), m."""
        at = np.array([stamp_s])
        return np.array([self._at(person, at)[0] for person in self._people]).reshape(-1, 3)

    def _at(self, person: _Person, stamps_s: FloatArray) -> FloatArray:
        """Return where the feet of a person are, shape (M, 3)."""
        walked = (person.phase_m + person.speed_m_s * stamps_s) % (2.0 * person.length_m)
        along = person.start_m + np.minimum(walked, 2.0 * person.length_m - walked)
        feet = self._along(along)
        # A stride back and forth, so that nobody jumps sideways where the route bends.
        heading = (self._along(along + _STRIDE_M) - self._along(along - _STRIDE_M))[:, :2]
        heading /= np.linalg.norm(heading, axis=1, keepdims=True)
        feet[:, 0] -= person.side * BESIDE_M * heading[:, 1]
        feet[:, 1] += person.side * BESIDE_M * heading[:, 0]
        return feet

    def _along(self, at: FloatArray) -> FloatArray:
        return np.column_stack([np.interp(at, self._travelled, axis) for axis in self._route_m.T])

    def _may_be_near(self, person: _Person, origins_m: FloatArray, reach_m: float) -> bool:
        """Return whether any origin is within reach of the middle of the stretch, or of its ends.

        Nobody on the stretch is farther from its middle than half its length.
        """
        middle = self._along(np.array([person.start_m + person.length_m / 2]))[0, :2]
        low, high = origins_m[:, :2].min(axis=0), origins_m[:, :2].max(axis=0)
        nearest = np.clip(middle, low, high)
        return math.dist(middle, nearest) <= reach_m + person.length_m / 2 + BESIDE_M + RADIUS_M


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


def _may_meet(fans: Fans, middles_m: FloatArray, reach_m: float) -> np.ndarray:
    """Return which fans may have a ray that meets an upright cylinder, shape (M,).

    A fan lies in a half-plane. It misses the cylinder if that lies beside the plane or behind the
    origin altogether; the extent of a cylinder along any unit vector is known.

    Args:
        fans: Rays.
        middles_m: Middle of the cylinder when each fan is taken, shape (M, 3), m.
        reach_m: Cylinders farther away may be left out.
    """
    ways = middles_m - fans.origins_m
    normals = np.cross(fans.forward, fans.up)
    beside = np.abs(np.sum(normals * ways, axis=1)) <= _extent(normals)
    ahead = np.sum(fans.forward * ways, axis=1) >= -_extent(fans.forward)
    near = np.sum(ways**2, axis=1) <= (reach_m + HEIGHT_M) ** 2
    return np.asarray(beside & ahead & near)


def _extent(directions: FloatArray) -> FloatArray:
    """Return how far a person reaches from its middle along unit vectors, shape (M,), m."""
    level = np.hypot(directions[:, 0], directions[:, 1])
    return np.asarray(RADIUS_M * level + HEIGHT_M / 2 * np.abs(directions[:, 2]))


def _cylinder_ranges(fans: Fans, chosen: np.ndarray, middles_m: FloatArray) -> FloatArray:
    """Return how far an upright cylinder is along the rays of some fans, shape (K, R), m."""
    level, rise = np.cos(fans.elevations_rad)[:, None], np.sin(fans.elevations_rad)[:, None]
    rays = level * fans.forward[chosen, None] + rise * fans.up[chosen, None]
    x, y, z = np.moveaxis(rays, -1, 0)
    way_x, way_y, way_z = (middles_m - fans.origins_m[chosen]).T[..., None]
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
