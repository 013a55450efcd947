"""Which scans were taken in the same place: the true topology of a drive.

References:
    own.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.sim.raycasting import RayCaster

RADIUS_M = 3.0
"""How far a place reaches from where it was founded."""
_EYE_M = 0.5
"""Height above the ground at which one place must see the other."""


class Places:
    """Places founded one after the other; grows with the explored space only."""

    def __init__(self, caster: RayCaster, radius_m: float = RADIUS_M) -> None:
        """Start without a place.

        Args:
            caster: World, for what stands between two positions.
            radius_m: How far a place reaches from where it was founded.
        """
        self._caster = caster
        self._radius_m = radius_m
        self._founded_m: list[FloatArray] = []
        self._cells: dict[tuple[int, ...], list[int]] = {}

    def at(self, position_m: FloatArray) -> int:
        """Return the place that a position on the ground, shape (3,), is in.

        It is the nearest one that was founded within the radius and in sight; if there is none,
        the position founds the next one.
        """
        eye = position_m + (0.0, 0.0, _EYE_M)
        near = self._near(position_m)
        if near:
            founded = np.array([self._founded_m[place] for place in near])
            is_seen = self._caster.sees(eye, founded + (0.0, 0.0, _EYE_M))
            if is_seen.any():
                return near[int(np.argmax(is_seen))]
        return self._found(position_m)

    def _near(self, position_m: FloatArray) -> list[int]:
        """Return the places within the radius, the nearest first."""
        around = product(*((cell - 1, cell, cell + 1) for cell in self._cell(position_m)))
        distances = [
            (math.dist(position_m, self._founded_m[place]), place)
            for cell in around
            for place in self._cells.get(cell, ())
        ]
        return [place for distance, place in sorted(distances) if distance <= self._radius_m]

    def _found(self, position_m: FloatArray) -> int:
        place = len(self._founded_m)
        self._founded_m.append(position_m.copy())  # of a whole drive of poses, it may be a view
        self._cells.setdefault(self._cell(position_m), []).append(place)
        return place

    def _cell(self, position_m: FloatArray) -> tuple[int, ...]:
        return tuple(math.floor(each / self._radius_m) for each in position_m)
