"""Arcs between areas, and global poses by composing them along shortest paths.

References:
    Blanco et al. 2008, section IV-C, Eq. (10) (fusion of independent traversals), Eq. (15)
    (composition by Monte Carlo) and Fig. 7.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import networkx as nx
import numpy as np

from hmt_service.core.awakening import is_anywhere
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    certain,
    exp,
    identity,
    inverse,
    log,
    symmetric,
)
from hmt_service.core.graph import Factor
from hmt_service.core.hypotheses import Hypothesis
from hmt_service.core.types import Arc

_SAMPLES = 2000


def arcs_of(hypothesis: Hypothesis, motions: Sequence[Factor]) -> tuple[Arc, ...]:
    """Return the arcs between areas, each fused over its traversals, Eq. (10).

    A traversal is known from the motion between two visits and the alignment of each visit with its
    area; nothing of the rest of the graph enters, so arcs are relative and local.

    Args:
        hypothesis: Says which area each visit was to.
        motions: Motion from each visit to the next.

    Returns:
        Arcs in the order of their areas.
    """
    fused: dict[tuple[int, int], tuple[GaussianPose, int]] = {}
    for motion in motions:
        start = hypothesis.topology.assignments[motion.visit_a]
        end = hypothesis.topology.assignments[motion.visit_b]
        if start.area == end.area:
            continue
        if end.is_carried or is_anywhere(motion.a_from_b):
            # What ties what follows to what was before is no motion, but what was recognised.
            a_from_b = hypothesis.graph.relative(start.area, end.area)
        else:
            a_from_b = _aligned(start.area_from_visit) @ motion.a_from_b
            a_from_b = a_from_b @ _aligned(end.area_from_visit).inverse()
        pair = (start.area, end.area)
        if pair[0] > pair[1]:
            pair, a_from_b = (pair[1], pair[0]), a_from_b.inverse()
        if pair in fused:
            known, traversals = fused[pair]
            fused[pair] = known.fuse(a_from_b), traversals + 1
        else:
            fused[pair] = a_from_b, 1
    return tuple(Arc(*pair, *fused[pair]) for pair in sorted(fused))


def compose_shortest_paths(
    arcs: Sequence[Arc], reference: int, rng: np.random.Generator
) -> dict[int, GaussianPose]:
    """Return the pose of every area that arcs lead to, along the shortest path from one of them.

    The length of an arc is the trace of its translational covariance: the shortest path is the best
    known one. Means are composed; covariances are those of Monte Carlo samples of the composition,
    Eq. (15), drawn arc by arc so that areas share the samples of the path that they share.

    Args:
        arcs: Arcs between areas.
        reference: Area whose frame the poses are in.
        rng: Source of the samples.

    Returns:
        `reference_from_area` by area, the reference itself included.
    """
    graph: nx.Graph[int] = nx.Graph()
    graph.add_node(reference)
    relative: dict[tuple[int, int], GaussianPose] = {}
    for arc in arcs:
        graph.add_edge(
            arc.area_a, arc.area_b, length=float(np.trace(arc.a_from_b.covariance[3:, 3:]))
        )
        relative[arc.area_a, arc.area_b] = arc.a_from_b
        relative[arc.area_b, arc.area_a] = arc.a_from_b.inverse()
    predecessors, distances = nx.dijkstra_predecessor_and_distance(
        graph, reference, weight="length"
    )
    poses = {reference: certain(identity())}
    samples: dict[int, FloatArray] = {reference: np.broadcast_to(identity(), (_SAMPLES, 4, 4))}
    for area in sorted(distances, key=distances.__getitem__):
        if area == reference:
            continue
        before = predecessors[area][0]
        step = relative[before, area]
        noise = rng.multivariate_normal(
            np.zeros(6), step.covariance, size=_SAMPLES, method="cholesky"
        )
        samples[area] = samples[before] @ step.mean @ exp(noise)
        mean = poses[before].mean @ step.mean
        poses[area] = GaussianPose(mean, _covariance(samples[area], mean))
    return poses


def residual_m(arc: Arc, poses: Mapping[int, Pose]) -> float:
    """Return how far, in m, two area poses are from what the arc between them says."""
    a_from_b = inverse(poses[arc.area_a]) @ poses[arc.area_b]
    return float(np.linalg.norm(log(inverse(arc.a_from_b.mean) @ a_from_b)[3:]))


def _aligned(area_from_visit: GaussianPose | None) -> GaussianPose:
    return certain(identity()) if area_from_visit is None else area_from_visit


def _covariance(samples: FloatArray, mean: Pose) -> FloatArray:
    xi = log(inverse(mean) @ samples)
    return symmetric(xi.T @ xi / len(xi))
