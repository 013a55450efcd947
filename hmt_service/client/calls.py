"""Everything that a daemon can be asked and told, as values: the words of both clients.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from hmt_service.core.geometry import Pose, quaternion_of
from hmt_service.core.types import (
    AreaDetails,
    Comparison,
    Event,
    GlobalMap,
    History,
    HmtPose,
    Hypotheses,
    MapMethod,
    PlacedArea,
    Posterior,
    StatementEffect,
    Trajectory,
)
from hmt_service.service.keys import Call, Control, Keys
from hmt_service.service.reports import Ack, Status

T = TypeVar("T")

_FINISH_S = 600.0
_CHANGE_S = 60.0


@dataclass(frozen=True, slots=True)
class Ask(Generic[T]):
    """One question, and what its answer must be."""

    key: str
    """Key of the call."""
    kind: type[T]
    """Type of the answer."""
    parameters: Mapping[str, object] = field(default_factory=dict)
    """Parameters; those that are None are left out."""
    timeout_s: float | None = None
    """How long to wait for the answer, wall clock; None for as long as the client usually does."""
    complete: Callable[[T], T] = field(default=lambda answer: answer)
    """Adds to an answer what was left out because it is known here."""

    def selector(self, more: Mapping[str, object]) -> str:
        """Return the question in the words of Zenoh, with some more parameters."""
        given = {**self.parameters, **more}
        pairs = [f"{name}={value}" for name, value in given.items() if value is not None]
        return f"{self.key}?{';'.join(pairs)}"


class Calls:
    """The questions about one robot; a client returns the answers.

    All of them raise the daemon's error (`NotFound`, `InvalidInput`, `Unavailable`, ...),
    `Unavailable` where no daemon answers, and `DeadlineExceeded` where none does in time.
    """

    def __init__(self, keys: Keys) -> None:
        self._keys = keys

    def status(self) -> Ask[Status]:
        """Return the daemon's counters."""
        return Ask(self._keys.call(Call.STATUS), Status)

    def pose(self) -> Ask[HmtPose]:
        """Return where the robot is."""
        return Ask(self._keys.call(Call.POSE), HmtPose)

    def posterior(self) -> Ask[Posterior]:
        """Return the belief over topologies."""
        return Ask(self._keys.call(Call.POSTERIOR), Posterior)

    def hypotheses(self) -> Ask[Hypotheses]:
        """Return all topologies that the robot may have travelled, the most probable first."""
        return Ask(self._keys.call(Call.HYPOTHESES), Hypotheses)

    def events(self) -> Ask[tuple[Event, ...]]:
        """Return the latest events, the oldest first."""
        return Ask(self._keys.call(Call.EVENTS), tuple)

    def history(self) -> Ask[History]:
        """Return what was believed of where the robot is, over time."""
        return Ask(self._keys.call(Call.HISTORY), History)

    def map(
        self,
        method: MapMethod = MapMethod.CONSISTENT,
        *,
        reference: int | None = None,
        hypothesis: int | None = None,
        with_points: bool = True,
        known: GlobalMap | None = None,
    ) -> Ask[GlobalMap]:
        """Return a global map.

        Args:
            method: How the poses of the areas are found.
            reference: Area whose frame the map is in; None for the daemon's choice.
            hypothesis: Hypothesis; None for the most probable one.
            with_points: Whether to fetch the submaps.
            known: A map fetched before: submaps that have not changed since are taken from it
                instead of being sent again.
        """
        submaps = _Known(() if known is None else known.areas)
        return Ask(
            self._keys.call(Call.MAP),
            GlobalMap,
            {
                "method": method,
                "reference": reference,
                "hypothesis": hypothesis,
                "points": int(with_points),
                "known": submaps.parameter,
            },
            complete=lambda answer: replace(
                answer, areas=tuple(map(submaps.put_into, answer.areas))
            ),
        )

    def areas(
        self, *, reference: int | None = None, hypothesis: int | None = None
    ) -> Ask[GlobalMap]:
        """Return the consistent map without points; the arguments are those of `map`."""
        parameters = {"reference": reference, "hypothesis": hypothesis}
        return Ask(self._keys.call(Call.AREAS), GlobalMap, parameters)

    def area(
        self,
        area: int,
        *,
        reference: int | None = None,
        hypothesis: int | None = None,
        with_points: bool = True,
        known: PlacedArea | None = None,
    ) -> Ask[AreaDetails]:
        """Return one area with its visits and the arcs to its neighbours.

        Args:
            area: Which one.
            reference: Area whose frame its pose is in; None for the daemon's choice.
            hypothesis: Hypothesis; None for the most probable one.
            with_points: Whether to fetch the submap.
            known: The area as it was fetched before: its points are not sent again if they have
                not changed since.
        """
        submaps = _Known(() if known is None else (known,))
        return Ask(
            self._keys.call(Call.AREA),
            AreaDetails,
            {
                "area": area,
                "reference": reference,
                "hypothesis": hypothesis,
                "points": int(with_points),
                "known": submaps.parameter,
            },
            complete=lambda answer: replace(answer, area=submaps.put_into(answer.area)),
        )

    def trajectory(
        self,
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        hypothesis: int | None = None,
    ) -> Ask[Trajectory]:
        """Return the globally consistent pose of every scan.

        Args:
            start_s: Sensor time of the first scan of interest; None for the first one.
            end_s: Sensor time of the last one; None for the last one.
            hypothesis: Hypothesis; None for the most probable one.
        """
        parameters = {"from": start_s, "to": end_s, "hypothesis": hypothesis}
        return Ask(self._keys.call(Call.TRAJECTORY), Trajectory, parameters)

    def compare(
        self, *, reference: int | None = None, hypothesis: int | None = None
    ) -> Ask[Comparison]:
        """Return how far both global maps are apart; the arguments are those of `map`."""
        parameters = {"reference": reference, "hypothesis": hypothesis}
        return Ask(self._keys.call(Call.COMPARE), Comparison, parameters)

    def finish(self, *, timeout_s: float = _FINISH_S) -> Ask[Ack]:
        """Have everything processed that was published here, and the map completed and saved.

        Args:
            timeout_s: How long to wait for that, wall clock, 600 at most.
        """
        return Ask(self._keys.control(Control.FINISH), Ack, timeout_s=timeout_s)

    def save(self) -> Ask[Ack]:
        """Have the map saved as it is."""
        return Ask(self._keys.control(Control.SAVE), Ack)

    def relocalize(self) -> Ask[Ack]:
        """Tell that the robot was carried: from its next keyframe on it may be anywhere."""
        return Ask(self._keys.control(Control.RELOCALIZE), Ack)

    def load(self, name: str) -> Ask[Ack]:
        """Have the map saved, and go on with another one, where the robot may be anywhere.

        Args:
            name: Name of its file, which is in the folder of the one that the daemon writes.
        """
        return Ask(self._keys.control(Control.LOAD), Ack, {"map": name}, timeout_s=_CHANGE_S)

    def reset(self) -> Ask[Ack]:
        """Have the map saved and its file given another name, and begin an empty one."""
        return Ask(self._keys.control(Control.RESET), Ack, timeout_s=_CHANGE_S)

    def assert_arc(
        self,
        area_a: int,
        area_b: int,
        a_from_b: Pose,
        *,
        sigma_m: float,
        sigma_rad: float,
        probability: float,
    ) -> Ask[StatementEffect]:
        """Tell where one area is beside another: evidence like any other, and what it did.

        Args:
            area_a: An area of the most probable hypothesis that the robot has left.
            area_b: Another one.
            a_from_b: Pose of its frame in that of the first, shape (4, 4).
            sigma_m: How well its position is known if it is right, per axis.
            sigma_rad: The same of its orientation.
            probability: How probably it is right, in (0, 1).
        """
        names = ("x", "y", "z", "qx", "qy", "qz", "qw")
        numbers = (*a_from_b[:3, 3].tolist(), *quaternion_of(a_from_b).tolist())
        parameters = {
            "area_a": area_a,
            "area_b": area_b,
            **{name: f"{number:.12g}" for name, number in zip(names, numbers, strict=True)},
            "sigma_m": f"{sigma_m:.12g}",
            "sigma_rad": f"{sigma_rad:.12g}",
            "probability": f"{probability:.12g}",
        }
        key = self._keys.control(Control.ASSERT_ARC)
        return Ask(key, StatementEffect, parameters, timeout_s=_CHANGE_S)

    def retract_arc(self, statement: int) -> Ask[StatementEffect]:
        """Take back what was told, since the daemon began with the map; return what that did.

        Args:
            statement: Identifier that `assert_arc` has returned.
        """
        parameters = {"statement": statement}
        key = self._keys.control(Control.RETRACT_ARC)
        return Ask(key, StatementEffect, parameters, timeout_s=_CHANGE_S)

    def shut_down(self) -> Ask[Ack]:
        """Have the daemon save the map and end."""
        return Ask(self._keys.control(Control.SHUTDOWN), Ack)


class _Known:
    """The submaps that a client has."""

    def __init__(self, areas: Iterable[PlacedArea]) -> None:
        self._points = {(a.area, a.version): a.points_in_area for a in areas if a.version}

    @property
    def parameter(self) -> str | None:
        """What they are, in the words of the question; None if there is none."""
        return ",".join(f"{area}:{version}" for area, version in self._points) or None

    def put_into(self, area: PlacedArea) -> PlacedArea:
        """Return an area with its points, if they were left out because they are known."""
        points = self._points.get((area.area, area.version))
        return area if points is None else replace(area, points_in_area=points)
