"""The metric graph of one hypothesis: Gaussian arcs between visits, globally consistent poses.

The only module that knows gtsam.

References:
    Blanco et al. 2008, section IV-C (globally consistent poses), after Lu and Milios 1997.
"""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from hmt_service.core.geometry import (
    GaussianPose,
    Pose,
    adjoint,
    identity,
    inverse,
    project_planar,
    symmetric,
)

# The first frame is the reference: fixed, up to what keeps the normal equations well conditioned.
_REFERENCE_SIGMA = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """A Gaussian arc between two visits."""

    visit_a: int
    """One end."""
    visit_b: int
    """The other end."""
    a_from_b: GaussianPose
    """Relative pose."""


class PoseGraph:
    """Poses of visits tied by Gaussian arcs; cheap to copy, solved on demand."""

    def __init__(self, *, is_planar: bool) -> None:
        """Start empty.

        Args:
            is_planar: Whether solved poses are kept planar exactly.
        """
        self._is_planar = is_planar
        self._factors: dict[tuple[int, int], Factor] = {}
        self._poses: dict[int, Pose] = {}
        self._marginals: gtsam.Marginals | None = None
        self._is_solved = True

    def copy(self) -> PoseGraph:
        """Return an independent graph that shares the factors, which are immutable."""
        other = PoseGraph(is_planar=self._is_planar)
        other._factors = dict(self._factors)
        other._poses = dict(self._poses)
        other._marginals = self._marginals
        other._is_solved = self._is_solved
        return other

    @property
    def factors(self) -> tuple[Factor, ...]:
        """All factors, in the order of their visits."""
        return tuple(self._factors[key] for key in sorted(self._factors))

    @property
    def visits(self) -> tuple[int, ...]:
        """All visits in the graph."""
        return tuple(self._poses)

    def add_reference(self, visit: int) -> None:
        """Add the first visit, at the origin."""
        self._poses[visit] = identity()
        self._change()

    def add_factor(self, factor: Factor) -> None:
        """Add an arc, or replace the one between the same two visits.

        Repeated matches of the same two visits are not independent: the latest one counts, alone.
        A visit that is new to the graph is placed by the arc.
        """
        self._factors[_key(factor.visit_a, factor.visit_b)] = factor
        if factor.visit_b not in self._poses:
            self._poses[factor.visit_b] = self._poses[factor.visit_a] @ factor.a_from_b.mean
        self._change()

    def pose(self, visit: int) -> Pose:
        """Return the globally consistent pose of a visit's frame, shape (4, 4)."""
        self._solve()
        return self._poses[visit]

    def relative(self, visit_a: int, visit_b: int) -> GaussianPose:
        """Return `a_from_b` with its covariance from the joint marginal of the two visits."""
        a_from_b = inverse(self.pose(visit_a)) @ self.pose(visit_b)
        if visit_a == visit_b:
            return GaussianPose(identity(), np.zeros((6, 6)))
        marginal = self._solved_marginals().jointMarginalCovariance(
            gtsam.KeyVector([visit_a, visit_b])
        )
        joint = np.block(
            [
                [marginal.at(visit_a, visit_a), marginal.at(visit_a, visit_b)],
                [marginal.at(visit_b, visit_a), marginal.at(visit_b, visit_b)],
            ]
        )
        jacobian = np.hstack([-adjoint(inverse(a_from_b)), np.eye(6)])
        return GaussianPose(a_from_b, symmetric(jacobian @ joint @ jacobian.T))

    def _change(self) -> None:
        self._is_solved = False
        self._marginals = None

    def _solve(self) -> None:
        if self._is_solved:
            return
        graph, values = self._gtsam()
        parameters = gtsam.LevenbergMarquardtParams()
        solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        poses = {visit: solution.atPose3(visit).matrix() for visit in self._poses}
        if self._is_planar:
            poses = {visit: project_planar(pose) for visit, pose in poses.items()}
        self._poses = poses
        self._is_solved = True

    def _solved_marginals(self) -> gtsam.Marginals:
        self._solve()
        if self._marginals is None:
            self._marginals = gtsam.Marginals(*self._gtsam())
        return self._marginals

    def _gtsam(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for visit, pose in self._poses.items():
            values.insert(visit, gtsam.Pose3(pose))
        first = min(self._poses)
        graph.add(
            gtsam.PriorFactorPose3(
                first,
                gtsam.Pose3(identity()),
                gtsam.noiseModel.Isotropic.Sigma(6, _REFERENCE_SIGMA),
            )
        )
        for factor in self.factors:
            noise = gtsam.noiseModel.Gaussian.Covariance(factor.a_from_b.covariance)
            measured = gtsam.Pose3(factor.a_from_b.mean)
            graph.add(gtsam.BetweenFactorPose3(factor.visit_a, factor.visit_b, measured, noise))
        return graph, values


def _key(visit_a: int, visit_b: int) -> tuple[int, int]:
    return (min(visit_a, visit_b), max(visit_a, visit_b))
