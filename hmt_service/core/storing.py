"""Between what the engine holds and what is stored of it.

References:
    own.
"""

from __future__ import annotations

from itertools import accumulate, pairwise

from hmt_service.core.config import Config
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.hypotheses import Assignment, Hypothesis, Topology
from hmt_service.core.stored import (
    StoredAssignment,
    StoredFactor,
    StoredHypothesis,
    StoredMap,
    StoredVisit,
)
from hmt_service.core.submap import visit_of
from hmt_service.core.visits import MemoryBudget, Visits


def stored_visits(visits: Visits) -> tuple[StoredVisit, ...]:
    """Return what is stored of the visits but their keyframes."""
    ends = list(accumulate(map(visits.keyframes, visits), initial=0))
    return tuple(
        StoredVisit(visit, first, end - 1, visits.is_forgotten(visit))
        for visit, (first, end) in enumerate(pairwise(ends))
    )


def stored_hypothesis(hypothesis: Hypothesis) -> StoredHypothesis:
    """Return what is stored of a hypothesis."""
    graph = hypothesis.graph
    return StoredHypothesis(
        hypothesis=hypothesis.hypothesis,
        log_weight=hypothesis.log_weight,
        assignments=tuple(
            StoredAssignment(a.visit, a.area, a.area_from_visit, a.is_carried)
            for a in hypothesis.topology.assignments
        ),
        reference_from_visit={visit: graph.pose(visit) for visit in graph.visits},
        factors=tuple(StoredFactor(f.visit_a, f.visit_b, f.a_from_b) for f in graph.factors),
    )


def restored_visits(stored: StoredMap, config: Config, budget: MemoryBudget | None) -> Visits:
    """Return the visits of a stored map; of those that were forgotten, the paths."""
    visits = Visits(budget=budget)
    for each in stored.visits:
        keyframes = stored.keyframes[each.first_keyframe : each.last_keyframe + 1]
        visits.put(visit_of(each.visit, keyframes, config))
        if each.is_forgotten:
            visits.forget(each.visit)
    return visits


def restored_hypothesis(
    stored: StoredHypothesis, *, is_planar: bool, is_frozen: bool
) -> Hypothesis:
    """Return a hypothesis as it was, with a graph of its own.

    Args:
        stored: What was stored of it.
        is_planar: Whether solved poses are kept planar exactly.
        is_frozen: Whether all areas stay where they are.
    """
    area_of = {assignment.visit: assignment.area for assignment in stored.assignments}
    graph = PoseGraph.restored(
        stored.reference_from_visit,
        [Factor(f.visit_a, f.visit_b, f.a_from_b) for f in stored.factors],
        {visit: area_of[visit] for visit in sorted(stored.eliminated)},
        is_planar=is_planar,
    )
    if is_frozen:
        graph = graph.frozen(area_of)
    assignments = tuple(
        Assignment(a.visit, a.area, a.area_from_visit, a.is_carried) for a in stored.assignments
    )
    return Hypothesis(stored.hypothesis, stored.log_weight, Topology(assignments), graph)
