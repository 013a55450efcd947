"""The audit: what was decided and what was believed, when, and for which reasons.

References:
    Blanco et al. 2008, Fig. 10 (effective sample size and current-area marginal over time).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hmt_service.core.types import (
    Belief,
    DropReason,
    Event,
    EventKind,
    Keyframe,
    Posterior,
    Registration,
    StatementEffect,
    TrackingFailure,
)

if TYPE_CHECKING:
    from hmt_service.core.hypotheses import Dropped, Hypothesis, ParticleLayer
    from hmt_service.core.transition import Successor
    from hmt_service.core.visits import MemoryUsage

# What is said of a hypothesis that is dropped, and the name of the number that caused it.
_WHY = {
    DropReason.NEGLIGIBLE: ("less than {:.0e}", "negligible_mass"),
    DropReason.RESAMPLED: ("the budget is {:g}", "budget"),
    DropReason.UNLIKELY: ("unlikely for more than {:g} areas", "patience_areas"),
    DropReason.SAME_MAP: ("the same map as {:g}", "same_as"),
}
# Beliefs that differ by no more than this are one that lasts.
_EQUAL = 1e-6
# One hypothesis weighs at most 0.995 then.
_DOUBT_ESS = 1.01


class Audit:
    """The latest events and beliefs, the oldest first; what is older than many is dropped."""

    def __init__(self, *, events: int = 10_000, beliefs: int = 50_000) -> None:
        """Start empty.

        Args:
            events: Most events kept.
            beliefs: Most beliefs kept; one that lasts takes two.
        """
        self._events: deque[Event] = deque(maxlen=events)
        self._beliefs: deque[Belief] = deque(maxlen=beliefs)

    @property
    def events(self) -> tuple[Event, ...]:
        """What was decided."""
        return tuple(self._events)

    @property
    def beliefs(self) -> tuple[Belief, ...]:
        """What was believed: where that changed, just before and just after."""
        return tuple(self._beliefs)

    def note(self, events: Iterable[Event]) -> None:
        """Take what has been decided."""
        self._events.extend(events)

    def believe(self, belief: Belief) -> None:
        """Take what is believed now."""
        before = self._beliefs
        if len(before) > 1 and _is_same(before[-1], belief) and _is_same(before[-2], belief):
            before.pop()
        before.append(belief)


def belief_of(posterior: Posterior) -> Belief:
    """Return what a posterior says of where the robot is."""
    return Belief(
        posterior.stamp_s,
        posterior.current_area,
        posterior.effective_sample_size,
        {summary.hypothesis: summary.probability for summary in posterior.hypotheses},
    )


def between(beliefs: Sequence[Belief], start_s: float, end_s: float) -> tuple[Belief, ...]:
    """Return which of some beliefs, in order of time, hold in an interval: also at its ends."""
    known = [belief for belief in beliefs if belief.stamp_s <= end_s]
    before = [belief for belief in known if belief.stamp_s < start_s]
    inside = known[len(before) :]
    is_cut = len(known) < len(beliefs)
    if before and (inside or is_cut) and (not inside or inside[0].stamp_s > start_s):
        inside.insert(0, replace(before[-1], stamp_s=start_s))
    if inside and is_cut:
        inside.append(replace(inside[-1], stamp_s=end_s))
    return tuple(inside)


def decisive(events: Sequence[Event], most: int) -> tuple[Event, ...]:
    """Return the decisions that most probability hung on, in order of time.

    At a branch that is what a successor got of its parent, or what the others got, whichever is
    less; of a hypothesis that was dropped, or of the last others at an acceptance, what it weighed.

    Args:
        events: In order of time.
        most: How many at most.
    """
    shares = _shares(events)
    mass = {}
    for place, event in enumerate(events):
        numbers = event.numbers
        if place in shares:
            mass[place] = numbers["parent_probability"] * min(shares[place], 1.0 - shares[place])
        elif event.kind is EventKind.PRUNED and "same_as" not in numbers:
            mass[place] = math.exp(numbers["log_weight"])
        elif event.kind is EventKind.ACCEPTED:
            mass[place] = numbers.get("last_dropped_mass", 0.0)
    chosen = sorted(mass, key=lambda place: (-mass[place], place))[:most]
    return tuple(events[place] for place in sorted(chosen))


def _shares(events: Sequence[Event]) -> dict[int, float]:
    """Return the share of its parent that each branch got, by its place among the events."""
    families: dict[tuple[float, float], list[int]] = {}
    for place, event in enumerate(events):
        if event.kind is EventKind.BRANCHED:
            families.setdefault((event.stamp_s, event.numbers["parent"]), []).append(place)
    shares: dict[int, float] = {}
    for family in families.values():
        factors = np.array([events[place].numbers["log_factor"] for place in family])
        weights = np.exp(factors - factors.max())
        shares.update(zip(family, (weights / weights.sum()).tolist(), strict=True))
    return shares


def longest_doubt(beliefs: Sequence[Belief]) -> tuple[float, float] | None:
    """Return begin and end, sensor time, of what was in doubt most and longest, and of its margin.

    That is where more than one topology counted, an effective sample size above one, summed over
    time; None if there was no doubt.

    Args:
        beliefs: In order of time; each lasts until the next.
    """
    best, most, begin, doubt = None, 0.0, None, 0.0
    for belief, after in pairwise(beliefs):
        if belief.effective_sample_size < _DOUBT_ESS:
            begin, doubt = None, 0.0
            continue
        begin = belief.stamp_s if begin is None else begin
        doubt += (after.stamp_s - belief.stamp_s) * (belief.effective_sample_size - 1.0)
        if doubt > most:
            best, most = (begin, after.stamp_s), doubt
    if best is None:
        return None
    margin_s = 0.25 * (best[1] - best[0])
    return best[0] - margin_s, best[1] + margin_s


def _is_same(first: Belief, second: Belief) -> bool:
    gap = first.effective_sample_size - second.effective_sample_size
    return (
        abs(gap) <= _EQUAL
        and _are_equal(first.current_area, second.current_area)
        and _are_equal(first.hypotheses, second.hypotheses)
    )


def _are_equal(first: Mapping[int, float], second: Mapping[int, float]) -> bool:
    return first.keys() == second.keys() and all(
        abs(p - second[each]) <= _EQUAL for each, p in first.items()
    )


# ---------------------------------------------------------------------- what events say


def entered(particles: ParticleLayer, stamp_s: float) -> Event:
    """Return that the robot has entered an area, says the best hypothesis."""
    best = particles.best
    numbers = {
        "area": float(best.current.area),
        "probability": float(particles.probabilities[0]),
        "hypotheses": float(len(particles.hypotheses)),
        "effective_sample_size": particles.effective_sample_size,
    }
    kind = "known" if best.current.area_from_visit is not None else "new"
    return Event(
        EventKind.AREA_ENTERED, stamp_s, f"entered {kind} area {best.current.area}", numbers
    )


def branched(parent: Hypothesis, child: Hypothesis, successor: Successor, stamp_s: float) -> Event:
    """Return that one hypothesis has become another: where it says that the robot is, and why.

    Args:
        parent: What was believed before.
        child: What may be believed since.
        successor: The place that makes the difference.
        stamp_s: Sensor time.
    """
    current = child.current
    # With what new areas gain by those that they look like.
    overlap, log_factor = successor.overlap, child.log_weight - parent.log_weight
    place = "a new area" if current.area_from_visit is None else f"area {current.area} again"
    if current.area_from_visit is None and overlap > 0.0:
        place = "a new area that sees a known one"
    numbers = {
        "hypothesis": float(child.hypothesis),
        "parent": float(parent.hypothesis),
        "area": float(current.area),
        "overlap": overlap,
        "log_factor": log_factor,
        "parent_probability": float(np.exp(parent.log_weight)),
    }
    message = (
        f"hypothesis {child.hypothesis} from {parent.hypothesis}: {place}, "
        f"overlap {overlap:.2f}, log factor {log_factor:.1f}"
    )
    return Event(EventKind.BRANCHED, stamp_s, message, numbers)


def pruned(dropped: Sequence[Dropped], stamp_s: float) -> tuple[Event, ...]:
    """Return that hypotheses are no longer followed."""
    return tuple(_pruned(each, stamp_s) for each in dropped)


def _pruned(dropped: Dropped, stamp_s: float) -> Event:
    why, limit = _WHY[dropped.reason]
    message = (
        f"dropped hypothesis {dropped.hypothesis} in area {dropped.area}, "
        f"probability {np.exp(dropped.log_weight):.2g}: {why.format(dropped.limit)}"
    )
    numbers = {
        "hypothesis": float(dropped.hypothesis),
        "area": float(dropped.area),
        "log_weight": dropped.log_weight,
        limit: float(dropped.limit),
    }
    return Event(EventKind.PRUNED, stamp_s, message, numbers)


def accepted(particles: ParticleLayer, dropped: Sequence[Dropped], stamp_s: float) -> Event:
    """Return that only one hypothesis is left, and what the last others weighed."""
    best = particles.best
    numbers = {
        "hypothesis": float(best.hypothesis),
        "areas": float(len(best.topology.areas)),
        "loop_closures": float(len(best.topology.assignments) - len(best.topology.areas)),
        "last_dropped": float(len(dropped)),
        "last_dropped_mass": float(sum(np.exp(each.log_weight) for each in dropped)),
    }
    message = f"accepted hypothesis {best.hypothesis}: no other is left"
    return Event(EventKind.ACCEPTED, stamp_s, message, numbers)


def recognised(visit: int, best: Hypothesis, stamp_s: float) -> Event:
    """Return that a visit to a new area, as all of it shows, was to a known one."""
    area = best.topology.assignments[visit].area
    numbers = {"hypothesis": float(best.hypothesis), "visit": float(visit), "area": float(area)}
    message = f"area {visit} is area {area}: what was seen is known"
    return Event(EventKind.ACCEPTED, stamp_s, message, numbers)


def over_budget(usage: MemoryUsage, failure: str, stamp_s: float) -> Event:
    """Return that more is in memory than may be."""
    numbers = {
        "held_bytes": float(usage.held_bytes),
        "shelf_bytes": float(usage.shelf_bytes),
    }
    return Event(EventKind.OVER_BUDGET, stamp_s, failure, numbers)


def asserted(effect: StatementEffect, stamp_s: float) -> Event:
    """Return what a statement about two areas did."""
    right = sum(h.after for h in effect.hypotheses if h.is_right)
    message = (
        f"statement {effect.statement}: areas {effect.area_a} and {effect.area_b} are where "
        f"somebody says with probability {right:.3f}"
    )
    return Event(EventKind.ARC_ASSERTED, stamp_s, message, {**_of(effect), "probability": right})


def retracted(effect: StatementEffect, stamp_s: float) -> Event:
    """Return that a statement was taken back."""
    message = f"statement {effect.statement} is taken back"
    return Event(EventKind.ARC_RETRACTED, stamp_s, message, _of(effect))


def _of(effect: StatementEffect) -> dict[str, float]:
    return {
        "statement": float(effect.statement),
        "area_a": float(effect.area_a),
        "area_b": float(effect.area_b),
    }


def lost(keyframe: Keyframe, failure: TrackingFailure, registration: Registration | None) -> Event:
    """Return that a keyframe was not registered."""
    numbers = {
        "keyframe": float(keyframe.index),
        "sigma_m": keyframe.previous_from_body.sigma_m,
        "sigma_rad": keyframe.previous_from_body.sigma_rad,
    }
    if registration is not None:
        numbers["inlier_share"] = registration.inlier_share
        numbers["correction_m"] = registration.correction_m
    message = f"keyframe {keyframe.index} was not registered ({failure})"
    if failure is TrackingFailure.NEW_SESSION:
        message = f"a new session begins with keyframe {keyframe.index}: the robot may be anywhere"
    return Event(EventKind.LOST, keyframe.stamp_s, message, numbers)
