"""The metric graph of one hypothesis: Gaussian arcs between visits, globally consistent poses.

The only module that knows gtsam. Solving is incremental: it measured faster than batch optimisation
at every size (an arc 0.1 ms at 100 poses and 2 ms at 10,000, where a batch takes 0.1 s).

References:
    Blanco et al. 2008, section IV-C (globally consistent poses), after Lu and Milios 1997.
    Kaess et al., iSAM2: incremental smoothing and mapping using the Bayes tree, IJRR 2012.
    Kretzschmar and Stachniss, Information-theoretic compression of pose graphs for laser-based
    SLAM, IJRR 2012 (what an eliminated pose says is kept in sparse arcs).
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace

import gtsam
import networkx as nx
import numpy as np
import numpy.typing as npt

from hmt_service.core.awakening import anywhere, is_anywhere
from hmt_service.core.geometry import (
    FloatArray,
    GaussianPose,
    Pose,
    adjoint,
    confined,
    identity,
    inverse,
    isotropic_covariance,
    planar_covariance,
    planar_pose,
    symmetric,
    yaw_of,
)

_Key = tuple[int, ...]
"""Both visits of an arc, the lower one first; of a statement its identifier, too."""
# The first frame is the reference: 1e-6 rad move what is a kilometre away by a millimetre.
_REFERENCE_SIGMA = 1e-6
# Poses that have moved farther than this, m and rad, are linearised anew.
_RELINEARISED = 1e-5
_MAX_UPDATES = 20
# No number of observations, each worth centimetres, moves what is known so well.
_FROZEN_M, _FROZEN_RAD = 1e-4, 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """A Gaussian arc between two visits, or two keyframes where these are the nodes."""

    visit_a: int
    """One end."""
    visit_b: int
    """The other end."""
    a_from_b: GaussianPose
    """Relative pose."""
    statement: int | None = None
    """What it was stated in, if somebody has said so: an arc of its own, beside what was seen."""

    @property
    def reversed(self) -> Factor:
        """The same arc, told from its other end."""
        return replace(
            self, visit_a=self.visit_b, visit_b=self.visit_a, a_from_b=self.a_from_b.inverse()
        )


@dataclass(frozen=True, slots=True)
class _Space:
    """The poses that a graph is over, as gtsam has them."""

    axes: npt.NDArray[np.intp]
    """Rows of our tangent `[rotation, translation]`, in the order of gtsam's."""
    value: Callable[[Pose], gtsam.Pose2 | gtsam.Pose3]
    """Makes a value of gtsam."""
    poses: Callable[[gtsam.Values], FloatArray]
    """Takes all poses out of a solution, in the order of their keys, shape (N, 4, 4)."""
    estimate: Callable[[gtsam.ISAM2, int], Pose]
    """Takes one pose out of an incremental solution."""
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
        return symmetric(covariance) if len(self.axes) == 6 else planar_covariance(covariance)

    def reference(self, visit: int) -> gtsam.NonlinearFactor:
        """Return what holds the first pose at the origin."""
        known = self.noise(_REFERENCE_SIGMA**2 * np.eye(6))
        return self.prior(visit, self.value(identity()), known)

    def factor(self, factor: Factor) -> gtsam.NonlinearFactor:
        """Return an arc as gtsam has it."""
        measured = factor.a_from_b
        noise = self.noise(measured.covariance)
        return self.between(factor.visit_a, factor.visit_b, self.value(measured.mean), noise)


def _poses3_of(values: gtsam.Values) -> FloatArray:
    rows = gtsam.utilities.extractPose3(values)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses


def _poses2_of(values: gtsam.Values) -> FloatArray:
    x, y, yaw = gtsam.utilities.extractPose2(values).T
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 0, 3] = np.cos(yaw), -np.sin(yaw), x
    poses[:, 1, 0], poses[:, 1, 1], poses[:, 1, 3] = np.sin(yaw), np.cos(yaw), y
    return poses


def _from_pose2(pose: gtsam.Pose2) -> Pose:
    return planar_pose(pose.x(), pose.y(), pose.theta())


_SPATIAL = _Space(
    axes=np.arange(6),
    value=gtsam.Pose3,
    poses=_poses3_of,
    estimate=lambda isam, visit: isam.calculateEstimatePose3(visit).matrix(),
    prior=gtsam.PriorFactorPose3,
    between=gtsam.BetweenFactorPose3,
)
# Not Pose3 with tiny variances off the plane: over long chains they leave a matrix that gtsam
# cannot factorise.
_PLANAR = _Space(
    axes=np.array([3, 4, 2]),
    value=lambda pose: gtsam.Pose2(pose[0, 3], pose[1, 3], yaw_of(pose)),
    poses=_poses2_of,
    estimate=lambda isam, visit: _from_pose2(isam.calculateEstimatePose2(visit)),
    prior=gtsam.PriorFactorPose2,
    between=gtsam.BetweenFactorPose2,
)


def optimised(poses: FloatArray, factors: Iterable[Factor], *, is_planar: bool) -> FloatArray:
    """Return the most probable poses of nodes 0 to N - 1, the first at the origin, all at once.

    Args:
        poses: Where to start, shape (N, 4, 4).
        factors: Arcs between any two.
        is_planar: Whether poses are kept planar exactly.
    """
    space = _PLANAR if is_planar else _SPATIAL
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for node, pose in enumerate(poses):
        values.insert(node, space.value(pose))
    graph.add(space.reference(0))
    for factor in factors:
        graph.add(space.factor(factor))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return space.poses(solution)


class _Solver:
    """An incremental solution that graphs share as long as they are the same."""

    def __init__(self, space: _Space) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(_RELINEARISED)
        parameters.relinearizeSkip = 1
        # Chains of a kilometre with a late loop leave a matrix that Cholesky cannot factorise.
        parameters.setFactorization("QR")
        parameters.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.1 * _RELINEARISED))
        self._space = space
        self._isam = gtsam.ISAM2(parameters)
        self._index_of: dict[_Key, int] = {}
        self._factors = 0
        self._forget()
        self.graphs: weakref.WeakSet[PoseGraph] = weakref.WeakSet()

    def copy(self) -> _Solver:
        other = copy(self)
        other._isam = gtsam.ISAM2(self._isam)
        other._index_of = dict(self._index_of)
        other.graphs = weakref.WeakSet()
        other._forget()
        return other

    def _forget(self) -> None:
        """Begin without what was found of an earlier solution."""
        self._all_poses: FloatArray | None = None
        self.poses: dict[int, Pose] = {}
        self.relatives: dict[tuple[int, int], GaussianPose] = {}

    def update(
        self,
        reference: int | None,
        factors: Iterable[Factor],
        removed: Iterable[_Key] = (),
    ) -> None:
        """Solve with some more arcs, and without some; a visit that has none left is gone.

        An arc between the same two visits replaces what was there.
        """
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        replaced = [self._index_of.pop(key) for key in removed if key in self._index_of]
        if reference is not None:
            graph.add(self._space.reference(reference))
            values.insert(reference, self._space.value(identity()))
            self._factors += 1
            self.poses[reference] = identity()
        for factor in factors:
            key = _key_of(factor)
            if key in self._index_of:
                replaced.append(self._index_of[key])
            self._index_of[key] = self._factors
            self._factors += 1
            graph.add(self._space.factor(factor))
            self._place(factor, values)
        self._solve(graph, values, replaced)

    def _solve(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, replaced: list[int]
    ) -> None:
        result = self._isam.update(graph, values, replaced)
        for _ in range(_MAX_UPDATES):
            if not result.getVariablesRelinearized():
                break
            result = self._isam.update()
        self._forget()

    def begin(self, poses: Mapping[int, Pose], factors: Iterable[Factor]) -> None:
        """Solve for the first time, with arcs between visits whose poses are known about."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(self._space.reference(min(poses)))
        for visit, pose in poses.items():
            values.insert(visit, self._space.value(pose))
        for index, factor in enumerate(factors, start=1):
            graph.add(self._space.factor(factor))
            self._index_of[_key_of(factor)] = index
        self._factors = graph.size()
        self._solve(graph, values, [])

    def _place(self, factor: Factor, values: gtsam.Values) -> None:
        """Put the end of an arc that is new to where the arc says."""
        known, new, known_from_new = factor.visit_a, factor.visit_b, factor.a_from_b.mean
        if known not in self.poses and not self._isam.valueExists(known):
            known, new, known_from_new = new, known, inverse(known_from_new)
        if new in self.poses or self._isam.valueExists(new):
            return
        self.poses[new] = self.pose(known) @ known_from_new
        values.insert(new, self._space.value(self.poses[new]))

    def pose(self, visit: int) -> Pose:
        if visit not in self.poses:
            self.poses[visit] = self._space.estimate(self._isam, visit)
        return self.poses[visit]

    def all_poses(self, held: Mapping[int, tuple[int, Pose]]) -> FloatArray:
        if self._all_poses is None:
            solved = self._space.poses(self._isam.calculateEstimate())
            is_held = np.isin(np.arange(len(solved) + len(held)), list(held))
            self._all_poses = np.empty((len(is_held), 4, 4))
            self._all_poses[~is_held] = solved
            for visit, (anchor, anchor_from_visit) in held.items():
                self._all_poses[visit] = self._all_poses[anchor] @ anchor_from_visit
        return self._all_poses

    def covariance(self, visit: int) -> FloatArray:
        return self._space.covariance(self._isam.marginalCovariance(visit))

    def joint_covariance(self, visit_a: int, visit_b: int) -> FloatArray:
        marginal = self._isam.jointMarginalCovariance(gtsam.KeyVector([visit_a, visit_b]))
        return np.block(
            [
                [marginal.at(visit_a, visit_a), marginal.at(visit_a, visit_b)],
                [marginal.at(visit_b, visit_a), marginal.at(visit_b, visit_b)],
            ]
        )


class PoseGraph:
    """Poses of visits tied by Gaussian arcs; cheap to copy, solved on demand."""

    def __init__(self, *, is_planar: bool) -> None:
        """Start empty.

        Args:
            is_planar: Whether solved poses are kept planar exactly.
        """
        self._space = _PLANAR if is_planar else _SPATIAL
        self._visits: dict[int, None] = {}
        self._factors: dict[_Key, Factor] = {}
        self._pending: dict[_Key, Factor] = {}
        self._removed: tuple[_Key, ...] = ()
        self._held: dict[int, tuple[int, Pose]] = {}
        self._has_parts = False
        self._use(_Solver(self._space))

    @classmethod
    def restored(
        cls,
        poses: Mapping[int, Pose],
        factors: Iterable[Factor],
        anchors: Mapping[int, int],
        *,
        is_planar: bool,
    ) -> PoseGraph:
        """Return the graph that another one was.

        Args:
            poses: Of all visits by their numbers, near the solution; the first at the origin.
            factors: All arcs.
            anchors: Of each visit that was eliminated the visit that it keeps its place beside.
            is_planar: Whether solved poses are kept planar exactly.
        """
        graph = cls(is_planar=is_planar)
        graph._visits = dict.fromkeys(sorted(poses))
        graph._factors = {_key_of(f): f for f in factors}
        graph._has_parts = any(is_anywhere(f.a_from_b) for f in graph._factors.values())
        graph._held = {
            visit: (anchor, inverse(poses[anchor]) @ poses[visit])
            for visit, anchor in anchors.items()
        }
        free = {visit: pose for visit, pose in poses.items() if visit not in anchors}
        graph._solver.begin(free, graph._factors.values())
        return graph

    def frozen(self, area_of: Mapping[int, int]) -> PoseGraph:
        """Return a graph in which all areas stay where they are, whatever is added.

        Args:
            area_of: The area of each visit: those that founded none keep their places beside it,
                but the last, which the robot goes on from.
        """
        poses, is_planar = dict(enumerate(self.poses())), self.is_planar
        last = len(poses) - 1
        anchors = {v: area for v, area in area_of.items() if v not in (area, last)}
        fixed = confined(
            isotropic_covariance(sigma_rad=_FROZEN_RAD, sigma_m=_FROZEN_M), is_planar=is_planar
        )
        factors = []
        rest = set(self._visits)
        while rest:
            first = min(rest)
            part = self.part_of(first)
            rest -= part
            if first != 0:
                factors.append(Factor(0, first, anywhere(is_planar=is_planar)))
            factors += [
                Factor(first, visit, GaussianPose(inverse(poses[first]) @ poses[visit], fixed))
                for visit in sorted(part - {first})
                if visit not in anchors
            ]
        return PoseGraph.restored(poses, factors, anchors, is_planar=is_planar)

    def part_of(self, visit: int) -> frozenset[int]:
        """Return the visits whose pose relative to one is known, that one included.

        A session that began anywhere is a part of its own until an alignment ties it.
        """
        if self.is_whole:
            return frozenset(self._visits)
        known = nx.Graph(
            (f.visit_a, f.visit_b) for f in self._factors.values() if not is_anywhere(f.a_from_b)
        )
        known.add_nodes_from(self._visits)
        known.add_edges_from((held, anchor) for held, (anchor, _) in self._held.items())
        return frozenset(nx.node_connected_component(known, visit))

    @property
    def is_planar(self) -> bool:
        """Whether solved poses are kept planar exactly."""
        return self._space is _PLANAR

    @property
    def is_whole(self) -> bool:
        """Whether there never was an arc that says nothing: then all is one part."""
        return not self._has_parts

    def joined(self, factor: Factor) -> PoseGraph:
        """Return a graph with one more arc, also between two parts that had no place before.

        The part that is without the first visit goes where the arc says: a solver would not find
        there, whose steps are small.
        """
        part = self.part_of(factor.visit_b)
        if factor.visit_a in part:
            graph = self.copy()
        elif next(iter(self._visits)) in part:
            return self.joined(factor.reversed)
        else:
            there = self.pose(factor.visit_a) @ factor.a_from_b.mean
            graph = self._moved(part, there @ inverse(self.pose(factor.visit_b)))
        graph.fuse_factor(factor)
        return graph

    def _moved(self, part: frozenset[int], moved: Pose) -> PoseGraph:
        """Return a graph of the same arcs in which one part lies elsewhere."""
        poses = {v: moved @ self.pose(v) if v in part else self.pose(v) for v in self._visits}
        anchors = {visit: anchor for visit, (anchor, _) in self._held.items()}
        arcs = self._factors.values()
        return PoseGraph.restored(poses, arcs, anchors, is_planar=self.is_planar)

    def without(self, statement: int) -> PoseGraph:
        """Return a graph without the arc that somebody has stated."""
        graph = self.copy()
        for key in [key for key, f in graph._factors.items() if f.statement == statement]:
            graph._remove(key)
        return graph

    def _remove(self, key: _Key) -> None:
        del self._factors[key]
        self._pending.pop(key, None)
        self._removed = (*self._removed, key)

    def copy(self) -> PoseGraph:
        """Return an independent graph that shares factors and solution until one changes."""
        other = copy(self)
        other._visits = dict(self._visits)
        other._factors = dict(self._factors)
        other._pending = dict(self._pending)
        other._held = dict(self._held)
        other._use(self._solver)
        return other

    @property
    def factors(self) -> tuple[Factor, ...]:
        """What is known of each pair of visits that an arc joins, in their order."""
        known: dict[_Key, Factor] = {}
        for key in sorted(self._factors):
            pair, factor = key[:2], self._factors[key]
            if pair in known:
                a_from_b = _between(known[pair], pair[0]).fuse(_between(factor, pair[0]))
                factor = Factor(pair[0], pair[1], a_from_b)
            known[pair] = factor
        return tuple(known.values())

    @property
    def visits(self) -> tuple[int, ...]:
        """All visits in the graph."""
        return tuple(self._visits)

    def add_reference(self, visit: int) -> None:
        """Add the first visit, at the origin: none that follows may have a lower number."""
        self._visits[visit] = None
        self._solver.update(visit, ())

    def add_factor(self, factor: Factor) -> None:
        """Add an arc, or replace the one between the same two visits.

        Repeated matches of the same two visits are not independent: the latest one counts, alone.
        A visit that is new to the graph is placed by the arc.
        """
        key = _key_of(factor)
        self._factors[key] = self._pending[key] = factor
        self._has_parts |= is_anywhere(factor.a_from_b)
        self._visits.setdefault(factor.visit_b)

    def eliminate(self, visit: int, anchor: int) -> None:
        """Take a visit out, and keep what it says of those that it has arcs to, Eq. (10).

        Nobody may have stated an arc to it.

        Exact for a visit between two others. Where there are more, what is known of it by its arc
        to the anchor is shared out among the arcs that follow from it, so that nothing counts
        twice.

        Args:
            visit: What is taken out; later arcs may not lead to it.
            anchor: A visit that it has an arc to: it keeps its place beside that one.
        """
        self._held[visit] = anchor, inverse(self.pose(anchor)) @ self.pose(visit)
        arcs = {key: _between(arc, visit) for key, arc in self._factors.items() if visit in key[:2]}
        known = arcs.pop(_key(visit, anchor)).inverse()
        shared = GaussianPose(known.mean, max(len(arcs), 1) * known.covariance)
        for (first, second, *_), visit_from_other in arcs.items():
            other = second if first == visit else first
            self.fuse_factor(Factor(anchor, other, shared @ visit_from_other))
        for key in (*arcs, _key(visit, anchor)):
            self._remove(key)

    def fuse_factor(self, factor: Factor) -> None:
        """Add an arc to what is known of the same two visits by other observations."""
        if factor.statement is not None:
            self.add_factor(factor)
            return
        key = _key(factor.visit_a, factor.visit_b)
        a_from_b = _between(factor, key[0])
        if key in self._factors:
            a_from_b = _between(self._factors[key], key[0]).fuse(a_from_b)
        self.add_factor(Factor(key[0], key[1], a_from_b))

    def has_arc(self, visit_a: int, visit_b: int) -> bool:
        """Return whether there is an arc between two visits."""
        return _key(visit_a, visit_b) in self._factors

    def pose(self, visit: int) -> Pose:
        """Return the globally consistent pose of a visit's frame, shape (4, 4)."""
        if visit in self._held:
            anchor, anchor_from_visit = self._held[visit]
            return self.pose(anchor) @ anchor_from_visit
        return self._solved().pose(visit)

    def poses(self) -> FloatArray:
        """Return the globally consistent poses of all visits by their numbers, shape (V, 4, 4)."""
        return self._solved().all_poses(self._held)

    def relative(self, visit_a: int, visit_b: int) -> GaussianPose:
        """Return `a_from_b` with its covariance from the joint marginal of the two visits.

        Neither may have been eliminated.
        """
        known = self._solved().relatives
        if (visit_a, visit_b) not in known:
            known[visit_a, visit_b] = self._relative(visit_a, visit_b)
        return known[visit_a, visit_b]

    def _relative(self, visit_a: int, visit_b: int) -> GaussianPose:
        solver, reference = self._solved(), next(iter(self._visits))
        a_from_b = inverse(solver.pose(visit_a)) @ solver.pose(visit_b)
        if visit_a == visit_b:
            return GaussianPose(identity(), np.zeros((6, 6)))
        if visit_a == reference:
            return GaussianPose(a_from_b, solver.covariance(visit_b))
        if visit_b == reference:
            return self.relative(visit_b, visit_a).inverse()
        axes = self._space.axes
        moved = adjoint(inverse(a_from_b))[np.ix_(axes, axes)]
        jacobian = np.hstack([-moved, np.eye(len(axes))])
        joint = solver.joint_covariance(visit_a, visit_b)
        return GaussianPose(a_from_b, self._space.covariance(jacobian @ joint @ jacobian.T))

    def _use(self, solver: _Solver) -> None:
        self._solver = solver
        solver.graphs.add(self)

    def _solved(self) -> _Solver:
        if self._pending or self._removed:
            if len(self._solver.graphs) > 1:
                self._solver.graphs.discard(self)
                self._use(self._solver.copy())
            self._solver.update(None, self._pending.values(), self._removed)
            self._pending, self._removed = {}, ()
        return self._solver


def _between(factor: Factor, visit: int) -> GaussianPose:
    """Return what an arc says of its other end, in the frame of one of its ends."""
    return factor.a_from_b if factor.visit_a == visit else factor.a_from_b.inverse()


def _key(visit_a: int, visit_b: int) -> _Key:
    return (min(visit_a, visit_b), max(visit_a, visit_b))


def _key_of(factor: Factor) -> _Key:
    pair = _key(factor.visit_a, factor.visit_b)
    return pair if factor.statement is None else (*pair, factor.statement)
