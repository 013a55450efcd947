"""The metric graph of one hypothesis: Gaussian arcs between visits, globally consistent poses.

The only module that knows gtsam.

References:
    Blanco et al. 2008, section IV-C (globally consistent poses), after Lu and Milios 1997.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    adjoint,
    identity,
    inverse,
    planar_covariance,
    planar_pose,
    symmetric,
    yaw_of,
)

# The first frame is the reference. How well it is known cancels in relative poses: of the order of
# an arc's own uncertainty, it keeps the normal equations well conditioned.
_REFERENCE_SIGMA = 1e-2


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """A Gaussian arc between two visits, or two keyframes where these are the nodes."""

    visit_a: int
    """One end."""
    visit_b: int
    """The other end."""
    a_from_b: GaussianPose
    """Relative pose."""


@dataclass(frozen=True, slots=True)
class _Space:
    """The poses that a graph is over, as gtsam has them."""

    axes: npt.NDArray[np.intp]
    """Rows of our tangent `[rotation, translation]`, in the order of gtsam's."""
    value: Callable[[Pose], gtsam.Pose2 | gtsam.Pose3]
    """Makes a value of gtsam."""
    pose: Callable[[gtsam.Values, int], Pose]
    """Takes the pose of a visit out of a solution."""
    prior: Callable[..., gtsam.NonlinearFactor]
    """Factor of one pose."""
    between: Callable[..., gtsam.NonlinearFactor]
    """Factor of two poses."""

    def noise(self, covariance: FloatArray) -> gtsam.noiseModel.Base:
        """Return the noise of a factor with this covariance, shape (6, 6)."""
        return gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_(self.axes, self.axes)])

    def covariance(self, reduced: FloatArray) -> FloatArray:
        """Return a covariance in gtsam's order as one in ours, shape (6, 6)."""
        covariance = np.zeros((6, 6))
        covariance[np.ix_(self.axes, self.axes)] = reduced
        return covariance if len(self.axes) == 6 else planar_covariance(covariance)


_SPATIAL = _Space(
    axes=np.arange(6),
    value=gtsam.Pose3,
    pose=lambda values, visit: values.atPose3(visit).matrix(),
    prior=gtsam.PriorFactorPose3,
    between=gtsam.BetweenFactorPose3,
)
# Not Pose3 with tiny variances off the plane: over long chains they leave a matrix that gtsam
# cannot factorise.
_PLANAR = _Space(
    axes=np.array([3, 4, 2]),
    value=lambda pose: gtsam.Pose2(pose[0, 3], pose[1, 3], yaw_of(pose)),
    pose=lambda values, visit: _from_pose2(values.atPose2(visit)),
    prior=gtsam.PriorFactorPose2,
    between=gtsam.BetweenFactorPose2,
)


def _from_pose2(pose: gtsam.Pose2) -> Pose:
    return planar_pose(pose.x(), pose.y(), pose.theta())


class PoseGraph:
    """Poses of visits (of keyframes, in smoothing) tied by Gaussian arcs; solved on demand."""

    def __init__(self, *, is_planar: bool) -> None:
        """Start empty.

        Args:
            is_planar: Whether solved poses are kept planar exactly.
        """
        self._space = _PLANAR if is_planar else _SPATIAL
        self._factors: dict[tuple[int, int], Factor] = {}
        self._poses: dict[int, Pose] = {}
        self._marginals: gtsam.Marginals | None = None
        self._is_solved = True

    @classmethod
    def of(
        cls, poses: Sequence[Pose] | FloatArray, factors: Iterable[Factor], *, is_planar: bool
    ) -> PoseGraph:
        """Return a graph over nodes 0 to N - 1, the first of them the reference.

        Args:
            poses: Where to start, shape (N, 4, 4).
            factors: Arcs between any two.
            is_planar: Whether solved poses are kept planar exactly.
        """
        graph = cls(is_planar=is_planar)
        graph._poses = dict(enumerate(poses))
        for factor in factors:
            graph.add_factor(factor)
        return graph

    def copy(self) -> PoseGraph:
        """Return an independent graph that shares the factors, which are immutable."""
        other = PoseGraph(is_planar=self._space is _PLANAR)
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
        axes = self._space.axes
        moved = adjoint(inverse(a_from_b))[np.ix_(axes, axes)]
        jacobian = np.hstack([-moved, np.eye(len(axes))])
        covariance = self._space.covariance(jacobian @ joint @ jacobian.T)
        return GaussianPose(a_from_b, symmetric(covariance))

    def _change(self) -> None:
        self._is_solved = False
        self._marginals = None

    def _solve(self) -> None:
        if self._is_solved:
            return
        graph, values = self._gtsam()
        parameters = gtsam.LevenbergMarquardtParams()
        solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        self._poses = {visit: self._space.pose(solution, visit) for visit in self._poses}
        self._is_solved = True

    def _solved_marginals(self) -> gtsam.Marginals:
        self._solve()
        if self._marginals is None:
            self._marginals = gtsam.Marginals(*self._gtsam())
        return self._marginals

    def _gtsam(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        space = self._space
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for visit, pose in self._poses.items():
            values.insert(visit, space.value(pose))
        known = space.noise(_REFERENCE_SIGMA**2 * np.eye(6))
        graph.add(space.prior(min(self._poses), space.value(identity()), known))
        for factor in self.factors:
            measured, noise = factor.a_from_b, space.noise(factor.a_from_b.covariance)
            graph.add(
                space.between(factor.visit_a, factor.visit_b, space.value(measured.mean), noise)
            )
        return graph, values


def _key(visit_a: int, visit_b: int) -> tuple[int, int]:
    return (min(visit_a, visit_b), max(visit_a, visit_b))
