"""A chain that commits: at every visit it closes the loop that fits best, if that fits well enough.

It has our odometry, our visits, our registration and our graph, so that what differs is how a loop
is decided. Where it looks, and when it accepts, is what Cartographer does by default.

References:
    Hess et al., Real-Time Loop Closure in 2D LIDAR SLAM, ICRA 2016.
    cartographer, configuration_files/pose_graph.lua (the four numbers).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hmt_service.core.alignment import Aligner, Mode
from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    confined,
    inverse,
    isotropic_covariance,
)
from hmt_service.core.graph import Factor, PoseGraph
from hmt_service.core.submap import Visit

MIN_SCORE = 0.55
"""`min_score`: least share of a visit that an earlier one must explain."""
MAX_DISTANCE_M = 15.0
"""`max_constraint_distance`: farthest that the graph may say that the two are apart."""
WINDOW_M, WINDOW_RAD = 7.0, math.radians(30.0)
"""`linear_search_window` and `angular_search_window`: how far from there a loop may be."""


def greedy_poses(visits: Sequence[Visit], config: Config) -> FloatArray:
    """Return the poses of visits in the map of the greedy chain, shape (V, 4, 4).

    Args:
        visits: All visits in the order of time, numbered from 0.
        config: Settings of all stages.
    """
    aligner = Aligner(config)
    graph = PoseGraph(is_planar=config.sensor.is_planar)
    graph.add_reference(0)
    for before, visit in pairwise(visits):
        motion = before.motion_to(visit)
        graph.add_factor(Factor(before.visit, visit.visit, motion))
        if found := _best(visit, visits[: before.visit], graph, aligner, config):
            target, mode = found
            graph.add_factor(Factor(target.visit, visit.visit, mode.target_from_visit))
    return graph.poses()


def _best(
    visit: Visit, earlier: Sequence[Visit], graph: PoseGraph, aligner: Aligner, config: Config
) -> tuple[Visit, Mode] | None:
    """Return where a visit fits best, if that is well enough."""
    poses = graph.poses()
    gate = config.alignment.gate_sigma
    window = confined(
        isotropic_covariance(sigma_rad=WINDOW_RAD / gate, sigma_m=WINDOW_M / gate),
        is_planar=config.sensor.is_planar,
    )
    found = []
    for target in earlier:
        target_from_visit = inverse(poses[target.visit]) @ poses[visit.visit]
        if np.linalg.norm(target_from_visit[:3, 3]) <= MAX_DISTANCE_M:
            modes = aligner.modes(visit, target, GaussianPose(target_from_visit, window))
            found += [(target, mode) for mode in modes if mode.overlap >= MIN_SCORE]
    return max(found, key=lambda each: each[1].overlap, default=None)
