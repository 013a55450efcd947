"""Settings of every stage and the presets per kind of sensor; none depends on a particular log.

References:
    own; the values marked "measured" come from the recorded logs named in the README.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hmt_service.core.choices import Preset as Preset
from hmt_service.errors import InvalidConfig


class Section(BaseModel):
    """Base of all sections: immutable, no unknown keys, field docstrings in the schema."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class SensorConfig(Section):
    """What the range sensor can see."""

    is_planar: bool = True
    """Whether the robot moves in a plane: poses are then kept planar exactly."""
    min_range_m: float = Field(default=0.1, ge=0.0)
    """Returns nearer than this are the robot itself."""
    max_range_m: float = Field(default=40.0, gt=0.0)
    """Returns farther than this are no returns."""
    min_median_range_m: float = Field(default=0.2, gt=0.0)
    """Least median range that is expected, each m³ of space counted once per keyframe."""
    max_median_range_m: float = Field(default=40.0, gt=0.0)
    """Largest median range that is expected."""
    flat_height_m: float = Field(default=0.3, ge=0.0)
    """A cloud is flat, as a planar sensor's should be and no other's, when 95 % of it is within
    this distance of one plane through the sensor."""


class OdometryConfig(Section):
    """Metric level: scan registration and keyframe selection."""

    voxel_size_m: float = Field(default=0.1, gt=0.0)
    """Edge of the cells of local maps and submaps; the finest surface is three wide."""
    max_points: int = Field(default=2000, ge=100)
    """Most points of a LiDAR scan that are registered, evenly chosen."""
    window_keyframes: int = Field(default=40, ge=1)
    """Number of latest keyframes in the local map."""
    keyframe_distance_m: float = Field(default=0.5, gt=0.0)
    """Motion that makes a keyframe."""
    keyframe_angle_rad: float = Field(default=0.35, gt=0.0)
    """Rotation that makes a keyframe."""
    keyframe_new_share: float = Field(default=0.3, gt=0.0, le=1.0)
    """Share of returns from unknown space that makes a keyframe after a fifth of that motion."""
    min_points: int = Field(default=20, ge=3)
    """A scan with fewer returns is not registered."""
    min_inlier_share: float = Field(default=0.3, ge=0.0, le=1.0)
    """A registration that explains less of the scan is refused."""
    max_correction_m: float = Field(default=1.0, gt=0.0)
    """A registration that moves the prediction farther is refused."""
    max_correction_rad: float = Field(default=0.8, gt=0.0)
    """A registration that turns the prediction farther is refused."""
    max_failures: int = Field(default=5, ge=1)
    """After so many scans in a row that were not registered, the robot is lost and starts anew."""
    max_gap_s: float = Field(default=5.0, gt=0.0)
    """Without odometry, a pause longer than this cannot be bridged."""


class MotionConfig(Section):
    """Noise of the motion prior: wheel odometry where there is any, constant velocity elsewhere."""

    sigma_translation_share: float = Field(default=0.1, gt=0.0)
    """Standard deviation of a translation, m per m travelled."""
    sigma_rotation_share: float = Field(default=0.1, gt=0.0)
    """Standard deviation of a rotation, rad per rad turned."""
    sigma_rotation_rad_per_m: float = Field(default=0.03, gt=0.0)
    """Standard deviation of the heading, rad per m travelled."""
    sigma_floor_m: float = Field(default=0.02, gt=0.0)
    """Least standard deviation of a translation."""
    sigma_floor_rad: float = Field(default=0.01, gt=0.0)
    """Least standard deviation of a rotation."""
    max_speed_m_s: float = Field(default=5.0, gt=0.0)
    """Odometry that moves faster has jumped; a robot out of sight cannot have gone farther."""
    acceleration_m_s2: float = Field(default=2.0, gt=0.0)
    """Standard deviation of how the speed changes, where constant velocity replaces odometry."""
    angular_acceleration_rad_s2: float = Field(default=2.0, gt=0.0)
    """Standard deviation of how the turn rate changes there."""


class CovarianceConfig(Section):
    """From a registration's information to an honest covariance."""

    sigma_m: float = Field(default=0.013, gt=0.0)
    """Standard deviation of the distance of one return from its surface; returns on one surface
    share as much again. Fitted to the errors in simulated worlds, ranges good to 0.02 m."""
    floor_m: float = Field(default=0.0005, gt=0.0)
    """Least standard deviation of a registered translation."""
    floor_rad: float = Field(default=0.0001, gt=0.0)
    """Least standard deviation of a registered rotation."""
    drift_share: float = Field(default=0.08, ge=0.0, le=1.0)
    """Share of the variance of a registration that stays in the local map and adds up along the
    path; the rest is the noise of one scan. Fitted in simulated worlds."""
    degenerate_m: float = Field(default=0.05, gt=0.0)
    """A direction that a scan alone knows less well than this is left to the motion prior."""
    uneven_motion_share: float = Field(default=0.2, ge=0.0)
    """Standard deviation of the pose of a sweep because its motion is not uniform: as a share of
    the change of motion since the sweep before, or from what was predicted. Fitted in simulated
    worlds."""
    sigma_submap_m: float = Field(default=0.04, gt=0.0)
    """Standard deviation of one residual between two submaps, which share surfaces only roughly;
    how far they are bent is known of each visit and comes on top."""
    floor_submap_m: float = Field(default=0.005, gt=0.0)
    """Least standard deviation of the translation between two submaps."""
    floor_submap_rad: float = Field(default=0.001, gt=0.0)
    """Least standard deviation of the rotation between two submaps."""


class AreaConfig(Section):
    """Area abstraction by normalized cut (section IV-A)."""

    cell_size_m: float = Field(default=0.4, gt=0.0)
    """Edge of the cells whose shared occupancy is the overlap of two keyframes."""
    max_cut: float = Field(default=0.35, gt=0.0, le=2.0)
    """Largest normalized cut accepted as a border between areas."""
    min_keyframes: int = Field(default=4, ge=2)
    """Fewest keyframes on either side of a border."""
    max_keyframes: int = Field(default=200, ge=4)
    """An area visit of so many keyframes is cut at its cheapest border, whatever that costs."""
    max_views: int = Field(default=2, ge=1)
    """Of so many visits to an area the scans are kept; of more, only if they show something new."""
    max_new_share: float = Field(default=0.1, ge=0.0, le=1.0)
    """A visit shows nothing new if no more than this share of what it saw is unknown."""


class AlignmentConfig(Section):
    """Search for the relative poses of two submaps, and their refinement."""

    raster_m: float = Field(default=0.2, gt=0.0)
    """Edge of a cell of the bird's-eye views that are correlated."""
    angle_step_rad: float = Field(default=0.05, gt=0.0)
    """Step of the rotations that are tried."""
    gate_sigma: float = Field(default=3.5, gt=0.0)
    """Size of the search region in standard deviations of the prior."""
    max_modes: int = Field(default=4, ge=1)
    """Most poses kept per pair of submaps."""
    min_overlap: float = Field(default=0.45, ge=0.0, le=1.0)
    """Least share of what a visit has seen that a known area must explain."""


class TransitionConfig(Section):
    """Topological transition (section IV-A)."""

    presence_m: float = Field(default=1.5, gt=0.0)
    """The robot is inside a known area when it is this near to where it has been there."""
    margin_share: float = Field(default=0.25, ge=0.0)
    """Share of a submap's reach by which an area extends beyond where the robot has been."""
    max_candidates: int = Field(default=8, ge=1)
    """Most known areas that one entry is compared with: the nearest."""
    outside_share: float = Field(default=0.1, gt=0.0, lt=1.0)
    """Prior probability that a robot that wakes up is at a place that its map does not know; that
    a visit to a known place is not recognised as one; and that who is outside comes back in."""
    carried_share: float = Field(default=0.003, gt=0.0, lt=1.0)
    """Prior probability that a robot whose scans do not fit any more has been carried elsewhere: of
    some 20 losses of track in 5,000 scans of a `long` world none was, and few robots ever are."""
    max_carried_areas: int = Field(default=32, ge=1)
    """Most known areas that it may have been carried to: the nearest."""
    searched_mass: float = Field(default=0.01, gt=0.0, lt=1.0)
    """A hypothesis looks all over the map for where the robot is only if it is so probable that it
    is there, and nothing says where: that costs more than all else."""
    look_alike_share: float = Field(default=0.3, ge=0.0, lt=1.0)
    """Prior probability that a place that is new looks like one that is known: 9 of 40 do in a
    `long` world, 4 of 14 in a warehouse, all 7 in twin buildings, none of 12 in recorded
    laboratories (explained better by what is out of sight than by the background)."""
    prior_samples: int = Field(default=256, ge=16)
    """Samples for the prior mass outside all known areas."""


class RefinementConfig(Section):
    """Arcs to all that a finished visit overlaps."""

    max_neighbours: int = Field(default=5, ge=0)
    """Most visits that one visit is tied to."""
    max_gap_m: float = Field(default=2.0, ge=0.0)
    """Farthest that the nearest points of the two paths may be apart."""
    min_overlap: float = Field(default=0.2, ge=0.0, le=1.0)
    """Least share of a visit's submap that the other must explain where the graph has put it."""
    max_sigma_m: float = Field(default=0.5, gt=0.0)
    """Largest standard deviation of the relative position: beyond it, the topology is in doubt."""
    max_sigma_rad: float = Field(default=0.1, gt=0.0)
    """Largest standard deviation of the relative heading."""


class ObservationConfig(Section):
    """Likelihood of a scan given a submap, against the background density."""

    hit_sigma_m: float = Field(default=0.15, gt=0.0)
    """Standard deviation of a range around the expected one, submap error included."""
    angular_resolution_rad: float = Field(default=0.0175, gt=0.0)
    """Width of one cell of the grid that the submap is projected into."""
    hit_weight: float = Field(default=0.75, gt=0.0, lt=1.0)
    """Share of beams that end on what the submap holds; the rest follows the background density."""
    independent_beams: float = Field(default=8.0, gt=0.0)
    """How many independent readings the beams of one scan amount to: they are correlated."""


class ParticleConfig(Section):
    """The particle layer (Eq. 6, 12-14)."""

    budget: int = Field(default=15, ge=1)
    """Most hypotheses kept."""
    negligible_mass: float = Field(default=1e-6, gt=0.0, lt=1.0)
    """Hypotheses below this posterior mass are dropped."""
    unlikely_mass: float = Field(default=1e-3, gt=0.0, lt=1.0)
    """A hypothesis below this posterior mass is unlikely."""
    patience_areas: int = Field(default=8, ge=1)
    """One that stays unlikely for so many entries of areas in a row is dropped: nothing speaks for
    it, and it would be extended at the cost of the best."""


class Config(Section):
    """All settings of the mapping core."""

    sensor: SensorConfig = SensorConfig()
    """What the range sensor can see."""
    odometry: OdometryConfig = OdometryConfig()
    """Metric level."""
    motion: MotionConfig = MotionConfig()
    """Noise of the motion prior."""
    covariance: CovarianceConfig = CovarianceConfig()
    """Covariance of registrations."""
    areas: AreaConfig = AreaConfig()
    """Area abstraction."""
    alignment: AlignmentConfig = AlignmentConfig()
    """Submap alignment."""
    transition: TransitionConfig = TransitionConfig()
    """Topological transition."""
    refinement: RefinementConfig = RefinementConfig()
    """Refinement of finished visits."""
    observation: ObservationConfig = ObservationConfig()
    """Observation model."""
    particles: ParticleConfig = ParticleConfig()
    """Particle layer."""

    def hash(self) -> str:
        """Return twelve hexadecimal digits that change when any setting does."""
        return hash_of(self.model_dump_json())


def hash_of(config_json: str) -> str:
    """Return the hash of settings that `Config.model_dump_json` has written."""
    return hashlib.sha256(config_json.encode()).hexdigest()[:12]


# Of what so many planes say, more of the error is the map's own. Fitted in simulated worlds.
_SPATIAL_COVARIANCE = {"drift_share": 0.25}
_PRESETS: dict[Preset, dict[str, Any]] = {
    Preset.PLANAR: {},
    Preset.OUTDOOR: {
        "sensor": {
            "is_planar": False,
            "min_range_m": 1.0,
            "max_range_m": 100.0,
            # Measured at the verdicts: 16.2 m and more in the open, 13.1 m and less in buildings.
            "min_median_range_m": 13.0,
            "max_median_range_m": 100.0,
        },
        "odometry": {
            "voxel_size_m": 0.5,
            "keyframe_distance_m": 2.5,
            "window_keyframes": 15,
            "max_correction_m": 5.0,
        },
        "motion": {"max_speed_m_s": 50.0},
        "covariance": _SPATIAL_COVARIANCE,
        "areas": {"cell_size_m": 1.0},
        "alignment": {"raster_m": 0.5},
        "observation": {"hit_sigma_m": 0.4, "angular_resolution_rad": 0.035},
    },
    Preset.INDOOR: {
        "sensor": {
            "is_planar": False,
            "min_range_m": 0.3,
            "max_range_m": 60.0,
            "min_median_range_m": 0.5,
            "max_median_range_m": 16.0,
        },
        "odometry": {
            "voxel_size_m": 0.25,
            "keyframe_distance_m": 1.0,
            "window_keyframes": 15,
            "max_correction_m": 2.0,
        },
        "covariance": _SPATIAL_COVARIANCE,
        "areas": {"cell_size_m": 0.5},
        "alignment": {"raster_m": 0.25},
        "observation": {"hit_sigma_m": 0.2, "angular_resolution_rad": 0.035},
    },
}


def load_config(preset: Preset = Preset.PLANAR, text: str | None = None) -> Config:
    """Return a preset, changed by the settings of a YAML document.

    Args:
        preset: Kind of sensor.
        text: YAML document with any subset of the sections and keys, or None for the preset alone.

    Raises:
        InvalidConfig: If the document is no mapping, or a key is unknown or out of range.
    """
    try:
        changes = yaml.safe_load(text) if text else {}
    except yaml.YAMLError as error:
        raise InvalidConfig(f"configuration is not YAML: {error}") from error
    if changes is None:
        changes = {}
    if not isinstance(changes, dict):
        raise InvalidConfig(
            f"configuration is a {type(changes).__name__}, not a mapping of sections"
        )
    merged: dict[str, Any] = {name: dict(values) for name, values in _PRESETS[preset].items()}
    for name, values in changes.items():
        merged[name] = {**merged.get(name, {}), **values} if isinstance(values, dict) else values
    try:
        return Config.model_validate(merged)
    except ValidationError as error:
        reasons = "; ".join(_reason(dict(problem)) for problem in error.errors())
        raise InvalidConfig(f"configuration refused: {reasons}") from error


def _reason(problem: Mapping[str, Any]) -> str:
    """Return one line for one problem that pydantic has found."""
    where = ".".join(map(str, problem["loc"]))
    if problem["type"] != "extra_forbidden":
        return f"{where}: {problem['msg']}, not {problem['input']!r}"
    known: Mapping[str, Any] = Config().model_dump()
    for name in problem["loc"][:-1]:
        known = known[name]
    near = get_close_matches(str(problem["loc"][-1]), known, n=1)
    return f"there is no {where}" + (f"; did you mean {near[0]}?" if near else "")
