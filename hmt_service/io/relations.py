"""Ground-truth relations between poses, and the error of a trajectory over them.

References:
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27, 2009,
    section 3: the error of one relation is `inverse(true relation) @ estimated relation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.io.rows import read_rows

_COLUMNS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Relations:
    """True relative poses of the robot's centre at pairs of times."""

    stamps_s: FloatArray
    """Times of the first and second pose, shape (N, 2)."""
    first_from_second: FloatArray
    """Pose of the second in the frame of the first, shape (N, 4, 4)."""


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Mean and (population) standard deviation of the errors of some relations."""

    pairs: int
    """Number of relations."""
    translation_mean_m: float
    """Mean length of the translational error."""
    translation_std_m: float
    """Its standard deviation."""
    rotation_mean_deg: float
    """Mean absolute angle of the rotational error."""
    rotation_std_deg: float
    """Its standard deviation."""
    squared_translation_mean_m2: float
    """Mean of the squared translational error."""
    squared_translation_std_m2: float
    """Its standard deviation."""
    squared_rotation_mean_deg2: float
    """Mean of the squared rotational error."""
    squared_rotation_std_deg2: float
    """Its standard deviation."""


@dataclass(frozen=True, slots=True)
class RelationErrors:
    """How far a trajectory is from the relations."""

    matched: int
    """Relations with a pose of the trajectory at both times."""
    unmatched: int
    """Relations without."""
    loop_gap_s: float
    """Pairs farther apart in time count as loop closures."""
    all_pairs: ErrorStatistics
    """Over every matched relation."""
    loop_closures: ErrorStatistics | None
    """Over the matched relations that are loop closures; None when there are none."""


def read_relations(path: Path) -> Relations:
    """Read a file of lines `t1 t2 x y z roll pitch yaw` (s, m, rad).

    Raises:
        NotFound: If the file cannot be opened.
        InvalidInput: If a line does not hold eight finite numbers, or the file holds no line.
    """
    rows = [row for _, row in read_rows(path, columns=_COLUMNS)]
    if not rows:
        raise InvalidInput(f"{path} holds no relation")
    table = np.array(rows)
    first_from_second = np.tile(np.eye(4), (len(table), 1, 1))
    # Fixed axes, roll first: yaw @ pitch @ roll.
    first_from_second[:, :3, :3] = Rotation.from_euler("xyz", table[:, 5:8]).as_matrix()
    first_from_second[:, :3, 3] = table[:, 2:5]
    return Relations(table[:, :2], first_from_second)


def evaluate(
    trajectory: Sequence[StampedPose],
    relations: Relations,
    *,
    tolerance_s: float = 0.005,
    loop_gap_s: float = 60.0,
) -> RelationErrors:
    """Return the errors of a trajectory over ground-truth relations.

    Args:
        trajectory: Poses of the robot's centre, in any order.
        relations: The truth.
        tolerance_s: Largest difference between the stamp of a relation and of the nearest pose.
        loop_gap_s: Relations between times farther apart are loop closures.

    Raises:
        InvalidInput: If no relation has a pose at both of its times.
    """
    if not trajectory:
        raise InvalidInput(f"no pose to compare with {len(relations.stamps_s)} relations")
    ordered = sorted(trajectory, key=lambda pose: pose.stamp_s)
    stamps_s = np.array([pose.stamp_s for pose in ordered])
    world_from_body = np.stack([pose.reference_from_body for pose in ordered])

    nearest = _nearest(stamps_s, relations.stamps_s)
    is_matched = (np.abs(stamps_s[nearest] - relations.stamps_s) <= tolerance_s).all(axis=1)
    if not is_matched.any():
        raise InvalidInput(
            f"none of {is_matched.size} relations from {relations.stamps_s.min():.3f} s to "
            f"{relations.stamps_s.max():.3f} s has two of {stamps_s.size} poses from "
            f"{stamps_s[0]:.3f} s to {stamps_s[-1]:.3f} s within {tolerance_s} s"
        )
    first, second = nearest[is_matched].T
    estimated = np.linalg.inv(world_from_body[first]) @ world_from_body[second]
    error = np.linalg.inv(relations.first_from_second[is_matched]) @ estimated
    translation_m = np.linalg.norm(error[:, :3, 3], axis=1)
    rotation_deg = np.degrees(Rotation.from_matrix(error[:, :3, :3]).magnitude())

    gap_s = np.abs(np.diff(relations.stamps_s[is_matched], axis=1))[:, 0]
    is_loop = gap_s > loop_gap_s
    return RelationErrors(
        matched=int(is_matched.sum()),
        unmatched=int((~is_matched).sum()),
        loop_gap_s=loop_gap_s,
        all_pairs=_statistics(translation_m, rotation_deg),
        loop_closures=(
            _statistics(translation_m[is_loop], rotation_deg[is_loop]) if is_loop.any() else None
        ),
    )


def _nearest(ascending: FloatArray, values: FloatArray) -> npt.NDArray[np.intp]:
    """Return the index of the nearest element of an ascending array for every value."""
    borders = 0.5 * (ascending[:-1] + ascending[1:])
    return np.asarray(np.searchsorted(borders, values))


def _statistics(translation_m: FloatArray, rotation_deg: FloatArray) -> ErrorStatistics:
    return ErrorStatistics(
        pairs=translation_m.size,
        translation_mean_m=float(translation_m.mean()),
        translation_std_m=float(translation_m.std()),
        rotation_mean_deg=float(rotation_deg.mean()),
        rotation_std_deg=float(rotation_deg.std()),
        squared_translation_mean_m2=float((translation_m**2).mean()),
        squared_translation_std_m2=float((translation_m**2).std()),
        squared_rotation_mean_deg2=float((rotation_deg**2).mean()),
        squared_rotation_std_deg2=float((rotation_deg**2).std()),
    )
