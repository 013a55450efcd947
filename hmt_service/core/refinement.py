"""Refinement of a visit that is over: its place in its area, and arcs to all that it overlaps.

Where a visit is, is not decided here: a pair of visits is tied only where the hypothesis' own graph
already says, with little doubt, that they have seen the same space. Only then a visit to a new area
may turn out to be one to a known area: where such areas explain what all of the visit has seen.

References:
    Blanco et al. 2008, section V (local maps are fused once the topology is settled).
"""

from __future__ import annotations

from dataclasses import replace

from hmt_service.core.alignment import Aligner, Mode
from hmt_service.core.config import Config, RefinementConfig
from hmt_service.core.geometry import GaussianPose
from hmt_service.core.graph import Factor
from hmt_service.core.hypotheses import SAME_AREA, Hypothesis
from hmt_service.core.submap import Visit
from hmt_service.core.visits import Visits, gaps_m, share_new

# chi-square 99.9 % for 6 degrees of freedom: a match beyond it contradicts the graph.
_GATE = 22.46


def is_certain(prior: GaussianPose, config: RefinementConfig) -> bool:
    """Return whether a relative pose is known so well that the topology there is not in doubt."""
    return prior.sigma_m <= config.max_sigma_m and prior.sigma_rad <= config.max_sigma_rad


class Refinement:
    """Ties a finished visit to the visits that it overlaps."""

    def __init__(self, config: Config, aligner: Aligner) -> None:
        """Build the stage.

        Args:
            config: Settings of all stages.
            aligner: Registers one submap in another.
        """
        self._config = config.refinement
        self._aligner = aligner

    def refine(self, hypothesis: Hypothesis, visit: Visit, visits: Visits) -> Hypothesis:
        """Return the hypothesis with the arcs that all of the visit's observations support.

        Args:
            hypothesis: What to refine.
            visit: The visit that is over.
            visits: All visits up to and including it.
        """
        assignment = hypothesis.topology.assignments[visit.visit]
        founder = assignment.area
        ties: list[tuple[int, Mode]] = []
        for other in self._neighbours(hypothesis, visit, visits):
            prior = hypothesis.graph.relative(other, visit.visit)
            if not is_certain(prior, self._config):
                continue
            mode = self._aligner.refine(
                visit, visits[other], prior.mean, min_overlap=self._config.min_overlap
            )
            if mode is not None and self._agrees(prior, mode):
                ties.append((other, mode))
        if not ties:
            return hypothesis
        graph = hypothesis.graph.copy()
        for other, mode in ties:
            # All ties share the visit's own points and bends: together they are worth one.
            tie = GaussianPose(
                mode.target_from_visit.mean, len(ties) * mode.target_from_visit.covariance
            )
            graph.add_factor(Factor(other, visit.visit, tie))
            if other == founder:
                assignment = replace(assignment, area_from_visit=mode.target_from_visit)
        if founder == visit.visit:
            # Who goes along the border of two areas is in neither for the most part, and in no new.
            new = share_new(visit, [visits[other] for other, _ in ties], graph.poses())
            if new <= 1.0 - SAME_AREA:
                area, mode = max(ties, key=lambda tie: tie[1].overlap)
                assignment = replace(assignment, area=area, area_from_visit=mode.target_from_visit)
        topology = hypothesis.topology.with_visit(assignment)
        # What is known now does not look like something else.
        is_new = assignment.area == visit.visit
        log_unlike = hypothesis.log_unlike if is_new else None
        return replace(hypothesis, graph=graph, topology=topology, log_unlike=log_unlike)

    def _neighbours(self, hypothesis: Hypothesis, visit: Visit, visits: Visits) -> list[int]:
        """Return the founders of the areas near enough to overlap, that of the visit's own first.

        Only founders: ties of every visit to every other in the same place would make the cost of
        a visit grow with their number.
        """
        # The visit just before is tied by the motion, from the same observations.
        areas = [area for area in hypothesis.topology.areas if area < visit.visit - 1]
        if not areas:
            return []
        poses, extents = hypothesis.graph.poses(), visits.extents(visit.visit)
        gaps = gaps_m(visit, poses[visit.visit], poses[areas], extents[areas])
        own = hypothesis.topology.assignments[visit.visit].area
        near = [
            (area != own, float(gap), area)
            for area, gap in zip(areas, gaps, strict=True)
            if gap <= self._config.max_gap_m
        ]
        return [area for _, _, area in sorted(near)[: self._config.max_neighbours]]

    @staticmethod
    def _agrees(prior: GaussianPose, mode: Mode) -> bool:
        return prior.disagreement2(mode.target_from_visit) <= _GATE
