"""The families of worlds by name, with what can be chosen about each.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, cast

from hmt_service.errors import InvalidInput

if TYPE_CHECKING:
    from hmt_service.sim.worlds.world import World


class Family(StrEnum):
    """Name of a family of worlds."""

    OFFICE = "office"
    ALIASED = "aliased"
    NESTED_LOOPS = "nested-loops"
    CAMPUS = "campus"
    WAREHOUSE = "warehouse"
    GARAGE = "garage"
    LONG = "long"

    @classmethod
    def of(cls, name: str) -> Family:
        """Return the family of that name.

        Raises:
            InvalidInput: If there is none.
        """
        if name not in list(cls):
            raise InvalidInput(f"no family of worlds {name!r}; there are {', '.join(cls)}")
        return cls(name)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number that can be chosen about a world."""

    name: str
    """As `draw` takes it."""
    low: float
    """Least value."""
    high: float
    """Greatest value."""
    default: float
    """Value where none is given."""
    description: str
    """One sentence."""
    is_whole: bool = False
    """Whether only whole numbers will do."""

    def __str__(self) -> str:
        """Return the name with its range and default."""
        kind = "whole number " if self.is_whole else ""
        return f"{self.name} ({kind}{self.low:g} to {self.high:g}, default {self.default:g})"

    def checked(self, value: float) -> float:
        """Return the value as its family takes it.

        Raises:
            InvalidInput: If it is out of range, or a fraction where only whole numbers will do.
        """
        if not self.low <= value <= self.high or (self.is_whole and value != int(value)):
            raise InvalidInput(f"{self.name} is {value!r}, not {self}")
        return int(value) if self.is_whole else float(value)


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a family is drawn."""

    description: str
    """One sentence."""
    route_m: tuple[float, float]
    """Least and greatest length of the route with default parameters, m."""
    parameters: tuple[Parameter, ...] = ()
    """What can be chosen."""


_LAPS = Parameter("laps", 1, 50, 1, "How often the route's loop is driven.", is_whole=True)

RECIPES: Mapping[Family, Recipe] = MappingProxyType(
    {
        Family.OFFICE: Recipe(
            "One floor of an office: a ring of corridors, one across it, rooms on both sides.",
            (150.0, 230.0),
            (_LAPS,),
        ),
        Family.ALIASED: Recipe(
            "A ring of corridors or twin wings, drawn by the seed, with rooms that look the same.",
            (150.0, 300.0),
            (Parameter("severity", 0, 1, 0.9, "Share of rooms that are exact copies of one."),),
        ),
        Family.NESTED_LOOPS: Recipe(
            "Long corridors: two small loops inside a large one, which is closed late.",
            (550.0, 800.0),
            (_LAPS,),
        ),
        Family.CAMPUS: Recipe(
            "2 km of paths between buildings, trees and cars, and through three halls, over hills.",
            (1800.0, 2200.0),
            (Parameter("relief_m", 0, 4, 1.5, "Greatest height over the mean; 0 is flat."),),
        ),
        Family.WAREHOUSE: Recipe(
            "Rows of equal racks with loads that vary a little, cross aisles, docks.",
            (300.0, 500.0),
        ),
        Family.GARAGE: Recipe(
            "Parking floors that look alike one above the other, joined by ramps; for LiDARs.",
            (550.0, 650.0),
            (Parameter("floors", 2, 6, 3, "Number of floors.", is_whole=True),),
        ),
        Family.LONG: Recipe(
            "Any number of small areas in rows, a loop in each row, to measure how cost grows.",
            (650.0, 850.0),
            (Parameter("areas", 1, 100_000, 100, "Number of areas.", is_whole=True),),
        ),
    }
)
"""Every family's recipe."""


def draw(family: Family, seed: int, **parameters: float) -> World:
    """Draw a world.

    Args:
        family: What kind of world.
        seed: At least 0; the same seed and parameters give the same world, byte for byte.
        parameters: Values by name, of those that `RECIPES` lists for the family.

    Raises:
        InvalidInput: If the seed is negative, or a parameter is unknown or out of range.
    """
    if seed < 0:
        raise InvalidInput(f"seed {seed} of a world is negative")
    recipe = RECIPES[family]
    known = {parameter.name: parameter for parameter in recipe.parameters}
    if unknown := sorted(set(parameters) - set(known)):
        choices = ", ".join(str(parameter) for parameter in recipe.parameters) or "none"
        raise InvalidInput(f"{family} has no parameter {', '.join(unknown)}; it has {choices}")
    checked = {name: known[name].checked(parameters[name]) for name in parameters}
    # Each family is a module with a function of its name, loaded only now: the command line lists
    # families before numpy is there.
    name = family.replace("-", "_")
    build = getattr(import_module(f"hmt_service.sim.worlds.{name}"), name)
    return cast("World", build(seed, **checked))
