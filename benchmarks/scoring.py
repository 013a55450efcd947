"""Which topologies are right: hypotheses of the engine held against what a simulator knows.

A *visit* is one stay in an area; a topology says of every visit which area it was to, and where the
visit lies in its map. An area is what the visit that founded it is: its identifier is that visit's,
and an assignment is a claim about places, which is true or not.

Known area.
    "Visit v was to area a": take the keyframe of v and the keyframe of the founding visit a that
    the map places nearest to each other. If their true relative pose is what the map says, to
    within `TOLERANCE_M` and `TOLERANCE_RAD`, the claim is right; if not it is a *false loop*. The
    nearest pair has no lever arm, so bends of the map elsewhere do not enter; the tolerance is
    smaller than the pitch of rooms that look alike, and than the way to the next mode along a
    corridor. The area right but the place in it wrong is a false loop. Only the founder is asked:
    visits that earlier decisions have wrongly added to an area do not change what it is.

New area.
    A keyframe *returns* when an earlier visit has a keyframe in the same true place, at most
    `NEAR_M` away, and at least `AWAY_M` of path before. A visit returns when at least
    `RETURN_SHARE` of its keyframes do. A new area is a *missed loop* if the visit returns, and
    right if not. Keyframes that are as near to a visit to the area that the topology says the robot
    has just left do not count: a border may fall in the middle of a known place, or where the robot
    turns round, and the two areas are tied where they touch.

A topology is right if all of its assignments are. One wrong assignment often makes those after it
wrong too (the robot goes on along the wrong corridor); each of them counts.

*True returns* are the visits that a map of nothing but new areas gets wrong. They do not depend on
what is believed, except for where the borders between visits are.

A decision is what is believed of one visit when it has just been over: hypotheses that say the same
of the visit (the same area at the same pose, within the tolerance, or a new area) are one option,
which is as right as its most probable hypothesis and as probable as all of them.

Both a known area and a new one may be right: a visit that begins in the unknown and ends in a known
place, or the other way round, has no single true answer.

What this cannot see: a loop inside one visit or back into the area just left, and whether an area
is of a sensible size. `placement` does not care where borders are: of the keyframes that return,
how many does a map place rightly relative to where the place was seen before?

References:
    Blanco et al. 2008, Eq. (14) (probabilities of topological paths); the scoring is own.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray, Pose, inverse, log

TOLERANCE_M = 1.5
"""Largest error of the position in a loop that is right."""
TOLERANCE_RAD = math.radians(15.0)
"""Largest error of the attitude in a loop that is right."""
NEAR_M = 2.0
"""Farthest that two keyframes are apart where the robot has come back."""
AWAY_M = 10.0
"""Least path between them."""
RETURN_SHARE = 2.0 / 3.0
"""Least share of the keyframes of a visit that has come back: if it is less, the visit is on the
border of what is known."""


class Verdict(StrEnum):
    """What one assignment of a visit to an area is."""

    RIGHT = "right"
    FALSE_LOOP = "false loop"
    MISSED_LOOP = "missed loop"


@dataclass(frozen=True, eq=False)
class Journey:
    """Where the robot really was, keyframe by keyframe, and how this was cut into visits."""

    world_from_keyframe: FloatArray
    """True pose of each keyframe, shape (K, 4, 4)."""
    place: npt.NDArray[np.int64]
    """True place of each keyframe, shape (K,): equal numbers, same place."""
    visit_from_keyframe: FloatArray
    """Estimated pose of each keyframe in the frame of its visit, shape (K, 4, 4)."""
    first_keyframe: tuple[int, ...]
    """First keyframe of each visit, from 0 and ascending: visits have no gaps."""

    def keyframes_of(self, visit: int) -> slice:
        """Return which keyframes belong to a visit."""
        return slice(*(*self.first_keyframe, len(self.place))[visit : visit + 2])

    @cached_property
    def travelled_m(self) -> FloatArray:
        """True length of the path up to each keyframe, shape (K,)."""
        steps = np.linalg.norm(np.diff(self.world_from_keyframe[:, :3, 3], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """One hypothesis about all visits so far."""

    probability: float
    """Its posterior mass."""
    areas: tuple[int, ...]
    """Area of each visit: the visit that founded it, which for a new area is the visit itself."""
    reference_from_visit: FloatArray
    """Pose of each visit in the map of this hypothesis, shape (V, 4, 4)."""


@dataclass(frozen=True, slots=True)
class Option:
    """One thing that may be said of a visit."""

    probability: float
    """Mass of the hypotheses that say so."""
    is_known: bool
    """Whether it is a loop: an area that was there before."""
    is_right: bool
    """Whether it is true."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What is believed of one visit."""

    options: tuple[Option, ...]
    """At least one, the most probable first; the probabilities sum to one."""
    is_return: bool
    """Whether it is a true return."""


@dataclass(frozen=True, slots=True)
class Placement:
    """How a map places the keyframes that return."""

    returning: int
    """How many keyframes return."""
    right: int
    """How many of them are where the map says, relative to the keyframe seen before."""


def judge(journey: Journey, topology: Topology, visit: int) -> Verdict:
    """Return what the assignment of one visit is."""
    area = topology.areas[visit]
    if area != visit:
        return Verdict.RIGHT if _is_there(journey, topology, visit, area) else Verdict.FALSE_LOOP
    just_left = {v for v in range(visit) if topology.areas[v] == topology.areas[visit - 1]}
    return Verdict.MISSED_LOOP if _returns(journey, visit, just_left) else Verdict.RIGHT


def judge_all(journey: Journey, topology: Topology) -> tuple[Verdict, ...]:
    """Return what the assignment of every visit is."""
    return tuple(judge(journey, topology, visit) for visit in range(len(topology.areas)))


def is_true_return(journey: Journey, visit: int) -> bool:
    """Return whether a map of nothing but new areas is wrong about a visit."""
    return _returns(journey, visit, range(max(visit - 1, 0), visit))


def decide(journey: Journey, topologies: Sequence[Topology], visit: int) -> Decision:
    """Return what a set of hypotheses says of a visit.

    Args:
        journey: The truth, up to the end of the visit or further.
        topologies: All hypotheses; their probabilities sum to one.
        visit: The visit.
    """
    groups: list[list[Topology]] = []
    for topology in sorted(topologies, key=lambda topology: -topology.probability):
        same = (group for group in groups if _say_the_same(group[0], topology, visit))
        group = next(same, None)
        if group is None:
            groups.append([topology])
        else:
            group.append(topology)
    options = [
        Option(
            probability=math.fsum(topology.probability for topology in group),
            is_known=group[0].areas[visit] != visit,
            is_right=judge(journey, group[0], visit) is Verdict.RIGHT,
        )
        for group in groups
    ]
    options.sort(key=lambda option: -option.probability)
    return Decision(tuple(options), is_true_return(journey, visit))


def always_new(journey: Journey, visit: int) -> Decision:
    """Return the decision of a filter that is certain that every area is new."""
    is_return = is_true_return(journey, visit)
    return Decision((Option(1.0, is_known=False, is_right=not is_return),), is_return)


def placement(journey: Journey, reference_from_keyframe: FloatArray) -> Placement:
    """Return how a map places the keyframes that return.

    Each is compared with the keyframe that was really nearest to it, of those that make it return.

    Args:
        journey: The truth.
        reference_from_keyframe: Pose of each keyframe in the map, shape (K, 4, 4).
    """
    world_from_keyframe = journey.world_from_keyframe
    returning = right = 0
    for k in range(1, len(journey.place)):
        apart_m, is_away = _sightings(journey, slice(k, k + 1))
        apart_m = np.where(is_away, apart_m, np.inf)[0]
        before = int(np.argmin(apart_m))
        if apart_m[before] > NEAR_M:
            continue
        returning += 1
        right += _agree(
            inverse(world_from_keyframe[before]) @ world_from_keyframe[k],
            inverse(reference_from_keyframe[before]) @ reference_from_keyframe[k],
        )
    return Placement(returning, right)


def _returns(journey: Journey, visit: int, just_left: Collection[int]) -> bool:
    own = journey.keyframes_of(visit)
    is_left = np.zeros(own.start, dtype=bool)
    for earlier in just_left:
        is_left[journey.keyframes_of(earlier)] = True
    apart_m, is_away = _sightings(journey, own)
    is_near = apart_m <= NEAR_M
    is_back = (is_near & is_away).any(axis=1) & ~(is_near & is_left).any(axis=1)
    return bool(is_back.mean() >= RETURN_SHARE)


def _sightings(journey: Journey, own: slice) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return how some keyframes relate to all before the first of them.

    Returns:
        Distances, infinite between different places, and whether enough path lies between.
    """
    position = journey.world_from_keyframe[:, :3, 3]
    apart_m = np.linalg.norm(position[own, None] - position[: own.start], axis=2)
    apart_m[journey.place[own, None] != journey.place[: own.start]] = np.inf
    is_away = journey.travelled_m[own, None] - journey.travelled_m[: own.start] >= AWAY_M
    return apart_m, is_away


def _is_there(journey: Journey, topology: Topology, visit: int, area: int) -> bool:
    of_area, of_visit = journey.keyframes_of(area), journey.keyframes_of(visit)
    from_area = topology.reference_from_visit[area] @ journey.visit_from_keyframe[of_area]
    from_visit = topology.reference_from_visit[visit] @ journey.visit_from_keyframe[of_visit]
    apart = np.linalg.norm(from_area[:, None, :3, 3] - from_visit[None, :, :3, 3], axis=2)
    a, v = np.unravel_index(np.argmin(apart), apart.shape)
    believed = inverse(from_area[a]) @ from_visit[v]
    true_a = journey.world_from_keyframe[of_area][a]
    true_v = journey.world_from_keyframe[of_visit][v]
    return _agree(inverse(true_a) @ true_v, believed)


def _say_the_same(one: Topology, other: Topology, visit: int) -> bool:
    area = one.areas[visit]
    if area != other.areas[visit]:
        return False
    return area == visit or _agree(_relative(one, area, visit), _relative(other, area, visit))


def _relative(topology: Topology, area: int, visit: int) -> Pose:
    area_from_visit: Pose = (
        inverse(topology.reference_from_visit[area]) @ topology.reference_from_visit[visit]
    )
    return area_from_visit


def _agree(one: Pose, other: Pose) -> bool:
    gap = inverse(one) @ other
    turn_rad = np.linalg.norm(log(gap)[:3])
    return bool(np.linalg.norm(gap[:3, 3]) <= TOLERANCE_M and turn_rad <= TOLERANCE_RAD)
