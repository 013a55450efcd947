"""Between what the engine holds and what is stored of it.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Mapping

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
from hmt_service.core.submap import Visit, visit_of
from hmt_service.core.visits import Visits


def stored_visits(visits: Mapping[int, Visit]) -> tuple[StoredVisit, ...]:
    """Return what is stored of the visits but their keyframes."""
    return tuple(
        StoredVisit(visit.visit, visit.first_keyframe, visit.last_keyframe)
        for visit in visits.values()
    )


def stored_hypothesis(hypothesis: Hypothesis) -> StoredHypothesis:
    """Return what is stored of a hypothesis."""
    graph = hypothesis.graph
    return StoredHypothesis(
        hypothesis=hypothesis.hypothesis,
        log_weight=hypothesis.log_weight,
        assignments=tuple(
            StoredAssignment(a.visit, a.area, a.area_from_visit)
            for a in hypothesis.topology.assignments
        ),
        reference_from_visit={visit: graph.pose(visit) for visit in graph.visits},
        factors=tuple(StoredFactor(f.visit_a, f.visit_b, f.a_from_b) for f in graph.factors),
    )


def restored_visits(stored: StoredMap, config: Config) -> Visits:
    """Return the visits of a stored map; of those that were forgotten, the paths."""
    visits = Visits()
    forgotten = _eliminated(stored.hypotheses[0])
    for each in stored.visits:
        keyframes = stored.keyframes[each.first_keyframe : each.last_keyframe + 1]
        visits.put(visit_of(each.visit, keyframes, config))
        if each.visit in forgotten:
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
        {visit: area_of[visit] for visit in sorted(_eliminated(stored))},
        is_planar=is_planar,
    )
    if is_frozen:
        graph = graph.frozen(area_of)
    assignments = tuple(Assignment(a.visit, a.area, a.area_from_visit) for a in stored.assignments)
    return Hypothesis(stored.hypothesis, stored.log_weight, Topology(assignments), graph)


def _eliminated(stored: StoredHypothesis) -> set[int]:
    """Return the visits that no arc leads to: what they said is in the arcs of their areas."""
    tied = {0, *(f.visit_a for f in stored.factors), *(f.visit_b for f in stored.factors)}
    return set(stored.reference_from_visit) - tied
