"""The frozen values that flow between the stages; each arrow of the data flow is one of them.

Lengths in m, angles in rad, stamps in s of the sensor's clock. `body` is the robot's centre, `area`
the frame of an area (the body frame of the keyframe that founded it), `reference` the frame of the
area that a global map is expressed in.

References:
    Blanco et al. 2008, section III and Table I (areas, arcs, HMT pose), section IV-C (global maps).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from hmt_service.core.choices import EventKind as EventKind
from hmt_service.core.choices import MapMethod as MapMethod
from hmt_service.core.geometry import FloatArray, GaussianPose, Pose

Points = npt.NDArray[np.float32]
"""Points of a keyframe or submap, shape (N, 3), m."""
NO_POINTS: Points = np.zeros((0, 3), dtype=np.float32)
"""Those of one that saw nothing, or of which they are not asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of a 2-D laser or 3-D LiDAR, already in the body frame."""

    stamp_s: float
    """Sensor time of the sweep."""
    points_in_body: FloatArray
    """Finite returns, shape (N, 3), m; a 2-D laser's lie in one plane."""
    sensor_in_body: FloatArray
    """Position of the sensor, shape (3,), m: where the rays start."""
    point_times: FloatArray | None = None
    """Capture time of each point as a share of the sweep in [0, 1], shape (N,); None: at once."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryReading:
    """What the wheels (or any dead reckoning) say of the motion."""

    stamp_s: float
    """Sensor time."""
    odom_from_body: Pose
    """Pose in the odometry's own drifting frame, shape (4, 4)."""


Reading = Scan | OdometryReading
"""Anything that a robot sends."""


class TrackingFailure(StrEnum):
    """Why a scan could not be tied to the scans before it; a new session has none before it."""

    TOO_FEW_POINTS = "too_few_points"
    TOO_FEW_CORRESPONDENCES = "too_few_correspondences"
    NOT_CONVERGED = "not_converged"
    CORRECTION_TOO_LARGE = "correction_too_large"
    GAP_IN_TIME = "gap_in_time"
    NEW_SESSION = "new_session"


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """How a scan fitted into the local map."""

    inlier_share: float
    """Share of the returns that lie on what the map holds, in [0, 1]."""
    known_share: float
    """Share of the returns where the map holds anything, in [0, 1]; the rest is new space."""
    prior_weight: float
    """Share of the predicted motion's information that was believed, in (0, 1]; below 1 the
    prediction contradicts the scan."""
    correction_m: float
    """How far the scan moved the prediction."""
    degenerate: FloatArray
    """Directions that the scan says next to nothing about, filled by the prediction: unit tangent
    vectors, shape (K, 6)."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A scan that is kept: the unit that areas are made of."""

    index: int
    """Position in the sequence of keyframes, from 0."""
    stamp_s: float
    """Sensor time."""
    points_in_body: Points
    """Returns, shape (N, 3), m; a LiDAR's are downsampled."""
    sensor_in_body: FloatArray
    """Position of the sensor, shape (3,), m."""
    previous_from_body: GaussianPose
    """Motion since the keyframe before; identity for the first."""
    own_error: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))
    """Covariance of what is wrong with this keyframe alone, shape (6, 6): part of the motion to it
    and of the motion from it, where it cancels. It does not add up along the path."""
    failure: TrackingFailure | None = None
    """Set when the motion was guessed (odometry or constant velocity), not registered."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracking:
    """What the odometry says of one scan."""

    stamp_s: float
    """Sensor time of the scan."""
    keyframe_index: int
    """Keyframe that the pose is relative to."""
    keyframe_from_body: GaussianPose
    """Pose of the scan relative to that keyframe; identity when the scan is that keyframe."""
    keyframe: Keyframe | None
    """The keyframe that this scan became, if it became one."""
    failure: TrackingFailure | None = None
    """Why the scan could not be registered, if so."""
    registration: Registration | None = None
    """How it was, or failed to be; None if that was not tried."""


@dataclass(frozen=True, slots=True)
class Event:
    """One decision with the numbers that caused it."""

    kind: EventKind
    """What happened."""
    stamp_s: float
    """Sensor time of the keyframe that caused it."""
    message: str
    """One sentence for a person."""
    numbers: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """The numbers behind it."""


@dataclass(frozen=True, slots=True)
class HypothesisSummary:
    """One topology that the robot may have travelled."""

    hypothesis: int
    """Identifier, unique in a run."""
    probability: float
    """Posterior mass, Eq. (14)."""
    current_area: int
    """Area that the robot is in."""
    topological_path: tuple[int, ...]
    """Areas in the order that they were entered, from the first one."""
    areas: int
    """Number of areas."""
    loop_closures: int
    """Number of times that a known area was entered again."""
    arcs: int
    """Number of pairs of areas that the robot has gone between directly."""


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """All topologies that the robot may have travelled."""

    stamp_s: float
    """Sensor time of the last keyframe in them."""
    revision: int
    """Map revision."""
    hypotheses: tuple[HypothesisSummary, ...]
    """The most probable first; probabilities sum to one."""


@dataclass(frozen=True, slots=True)
class Posterior:
    """The belief over topologies."""

    stamp_s: float
    """Sensor time of the last keyframe in it."""
    revision: int
    """Map revision: grows with every change."""
    hypotheses: tuple[HypothesisSummary, ...]
    """All hypotheses, the most probable first; probabilities sum to one."""
    current_area: Mapping[int, float]
    """Marginal probability of the robot's current area."""
    effective_sample_size: float
    """1 / sum of squared weights, in [1, number of hypotheses]."""


@dataclass(frozen=True, slots=True)
class Localization:
    """How sure it is where in the map the robot is."""

    stamp_s: float
    """Sensor time of the last keyframe in the map."""
    probability: float
    """Posterior mass of its current area where that has a place in the map, in [0, 1]; 0 after an
    awakening until something ties it."""
    entropy_nat: float
    """Entropy of the marginal over the current area; 0 if there is no doubt."""
    evidence_stamp_s: float | None
    """Sensor time when the robot last was where it had been before, in the most probable
    hypothesis: from then on the motion alone says where it is. None if it never was."""


@dataclass(frozen=True, slots=True)
class Belief:
    """What was believed of where the robot is and has been, at one moment."""

    stamp_s: float
    """Sensor time."""
    current_area: Mapping[int, float]
    """Marginal probability of the robot's current area."""
    effective_sample_size: float
    """1 / sum of squared weights, in [1, number of hypotheses]."""
    hypotheses: Mapping[int, float] = field(default_factory=dict)
    """Posterior mass of each topology, Eq. (14), by the identifier of its hypothesis."""


@dataclass(frozen=True, slots=True)
class History:
    """What was believed over time: where that changed, just before and just after."""

    revision: int
    """Map revision of the last of them; zero before the first keyframe."""
    beliefs: tuple[Belief, ...]
    """In time order."""


@dataclass(frozen=True, slots=True, eq=False)
class HmtPose:
    """Where the robot is: an area and a pose inside it, and the same in the reference frame."""

    stamp_s: float
    """Sensor time."""
    area: int
    """Current area of the most probable hypothesis."""
    area_from_body: GaussianPose
    """Pose inside that area."""
    reference_area: int
    """Area whose frame `reference_from_body` is expressed in."""
    reference_from_body: GaussianPose
    """Globally consistent pose."""
    hypothesis: int
    """Hypothesis that the answer belongs to."""
    probability: float
    """Posterior mass of the current area over all hypotheses."""
    localization: Localization
    """How sure it is that the robot is there."""
    revision: int
    """Map revision."""


class DropReason(StrEnum):
    """Why a hypothesis is no longer followed."""

    NEGLIGIBLE = "negligible"
    """Its posterior mass is less than what is worth anything."""
    RESAMPLED = "resampled"
    """There were more than the budget, and the draw left it out."""
    UNLIKELY = "unlikely"
    """It was unlikely for many areas in a row."""
    SAME_MAP = "same_map"
    """It was the same map as another one, which has its mass."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedArea:
    """One area of a global map."""

    area: int
    """Identifier."""
    reference_from_area: GaussianPose
    """Pose and covariance of the area's frame in the map's reference frame."""
    keyframes: int
    """Number of keyframes in it, all visits."""
    visits: int
    """How many times the robot has been there."""
    points_in_area: Points
    """Submap: the points of all visits, shape (N, 3), m; none if nobody asked for them, or who did
    has them in this version."""
    version: int = 0
    """Of the submap, below 2^48: changes exactly when its points do, and is the same again when
    they are; 0 when nobody asked for them."""


@dataclass(frozen=True, slots=True, eq=False)
class Arc:
    """The relative pose of two adjacent areas, fused over all traversals, Eq. (10)."""

    area_a: int
    """The area that the arc leaves, the smaller identifier."""
    area_b: int
    """The area that it leads to."""
    a_from_b: GaussianPose
    """Relative pose."""
    traversals: int
    """How many independent traversals it is made of."""


@dataclass(frozen=True, slots=True, eq=False)
class GlobalMap:
    """All areas of one hypothesis in one frame."""

    method: MapMethod
    """How the poses were found."""
    reference_area: int
    """Area whose frame all poses are in."""
    hypothesis: int
    """Hypothesis that this is the map of."""
    probability: float
    """Its posterior mass."""
    revision: int
    """Map revision."""
    areas: tuple[PlacedArea, ...]
    """In the order of their identifiers."""
    arcs: tuple[Arc, ...]
    """In the order of their identifiers."""


@dataclass(frozen=True, slots=True, eq=False)
class AreaVisit:
    """One stay of the robot in an area."""

    visit: int
    """Identifier, in order of time."""
    area_from_visit: Pose
    """Pose of its frame, that of its first keyframe, in the area's, shape (4, 4)."""
    last_stamp_s: float
    """Sensor time of its last keyframe."""
    keyframes: int
    """Number of its keyframes."""
    is_forgotten: bool
    """Whether of what it has seen nothing is kept, because it was known."""


@dataclass(frozen=True, slots=True, eq=False)
class AreaDetails:
    """One area of one hypothesis, with everything that is known of it."""

    reference_area: int
    """Area whose frame its pose is in."""
    hypothesis: int
    """Hypothesis that it is an area of."""
    probability: float
    """Its posterior mass."""
    revision: int
    """Map revision."""
    area: PlacedArea
    """The area, in the consistent map."""
    visits: tuple[AreaVisit, ...]
    """In time order; the first one founded the area, and has its frame."""
    arcs: tuple[Arc, ...]
    """To its neighbours, in the order of their identifiers."""


@dataclass(frozen=True, slots=True)
class AreaDifference:
    """How far the shortest-path pose of one area is from its consistent pose."""

    area: int
    """Identifier."""
    translation_m: float
    """Distance between the two positions."""
    rotation_rad: float
    """Angle between the two attitudes."""
    sigma_consistent_m: float
    """Largest standard deviation of the consistent position."""
    sigma_shortest_path_m: float
    """Largest standard deviation of the composed position."""


@dataclass(frozen=True, slots=True)
class ArcResidual:
    """How badly the two area poses of a global map contradict the arc between them."""

    area_a: int
    """One end."""
    area_b: int
    """The other end."""
    consistent_m: float
    """Translational residual in the consistent map."""
    shortest_path_m: float
    """Translational residual in the shortest-path map; zero on arcs of the tree."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The shortest-path map against the consistent one (section IV-C, Fig. 7)."""

    reference_area: int
    """Area whose frame both maps are in."""
    hypothesis: int
    """Hypothesis that both are maps of."""
    revision: int
    """Map revision."""
    areas: tuple[AreaDifference, ...]
    """In the order of their identifiers."""
    arcs: tuple[ArcResidual, ...]
    """In the order of their identifiers."""


@dataclass(frozen=True, slots=True)
class HypothesisEffect:
    """What a statement, or that it is taken back, did to one hypothesis."""

    hypothesis: int
    """Identifier."""
    parent: int
    """The hypothesis that it comes from; itself if it was there before."""
    is_right: bool
    """Whether the statement is right in it."""
    before: float
    """Probability of the parent before."""
    after: float
    """Probability since; 0 if it was dropped."""
    apart_m: float
    """How far from where the statement says the parent had one area in the other."""
    apart_rad: float
    """The same of its heading."""
    distance: float | None
    """The same over what both know of it, as a Mahalanobis distance; None: it knew nothing."""


@dataclass(frozen=True, slots=True)
class StatementEffect:
    """What a statement about two areas, or that it is taken back, did to the belief."""

    statement: int
    """Identifier of the statement: what takes it back."""
    area_a: int
    """One of the areas."""
    area_b: int
    """The other one."""
    revision: int
    """Map revision since."""
    hypotheses: tuple[HypothesisEffect, ...]
    """All that there are since, and those that it has cost their place, the most probable first."""


@dataclass(frozen=True, slots=True, eq=False)
class StampedPose:
    """One pose of the trajectory."""

    stamp_s: float
    """Sensor time of the scan."""
    reference_from_body: Pose
    """Globally consistent pose of the robot's centre, shape (4, 4)."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Where the robot was, says one hypothesis."""

    reference_area: int
    """Area whose frame the poses are in."""
    hypothesis: int
    """Hypothesis that says so."""
    probability: float
    """Its posterior mass."""
    revision: int
    """Map revision."""
    is_smoothed: bool
    """Whether all poses were estimated together; else each keyframe is where its visit is."""
    poses: tuple[StampedPose, ...]
    """One per scan, in the order that they came."""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """What readers may know of the map between two changes of it: immutable, complete, small."""

    posterior: Posterior
    """Belief over topologies."""
    localization: Localization
    """How sure it is where the robot is."""
    keyframe_index: int
    """Keyframe that the poses below are at, as the odometry of this session numbers them; negative
    before its first, when they are those of the end of the session before."""
    area_from_keyframe: GaussianPose
    """Pose of that keyframe inside the current area of the best hypothesis."""
    reference_from_keyframe: GaussianPose
    """Its globally consistent pose."""
    reference_area: int
    """Area whose frame that pose is in."""
    areas: int
    """Number of areas of the best hypothesis."""
    arcs: int
    """Number of arcs of the best hypothesis."""
    keyframes: int
    """Number of keyframes in the map."""
