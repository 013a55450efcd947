"""The worst that an odometry does within seconds, by relations, and what the wheels say of it.

A step of half a metre within seconds ruins a map, and a mean over a log hides it. A true relation
may be wrong itself, so that the wheels are asked about the very one that is worst: where they agree
with us and not with it, it is.

References:
    Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 27, 2009.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.io.relations import Relations

SHORT_S = 5.0
"""Relations between times nearer than this count."""
_TOLERANCE_S = 0.005


@dataclass(frozen=True, slots=True)
class StepErrors:
    """Translational errors over the short relations of one log."""

    relations: int
    """How many are covered by the trajectory and the wheels."""
    p99_m: float
    """99 of 100 errors are at most this."""
    worst_m: float
    """The largest one."""
    worst_raw_m: float
    """Error of the wheels over that very relation."""
    worst_ours_vs_raw_m: float
    """How far the trajectory and the wheels are apart there."""
    worst_from_s: float
    """First stamp of that relation."""
    worst_to_s: float
    """Its second stamp."""


def step_errors(
    trajectory: Sequence[StampedPose], wheels: Sequence[StampedPose], relations: Relations
) -> StepErrors:
    """Return what the errors over the short relations are.

    Args:
        trajectory: Estimated poses in the order of time.
        wheels: Poses by dead reckoning in the order of time.
        relations: The truth; those without a pose of both within 5 ms of both times do not count.

    Raises:
        InvalidInput: If none counts.
    """
    is_short = np.abs(np.diff(relations.stamps_s, axis=1))[:, 0] < SHORT_S
    stamps_s, true = relations.stamps_s[is_short], relations.first_from_second[is_short]
    ours, has_ours = _relative(trajectory, stamps_s)
    raw, has_raw = _relative(wheels, stamps_s)
    is_covered = has_ours & has_raw
    if not is_covered.any():
        raise InvalidInput(
            f"none of {len(stamps_s)} relations of less than {SHORT_S:g} s is covered by "
            f"{len(trajectory)} poses and {len(wheels)} readings of the wheels"
        )
    stamps_s, true, ours, raw = (each[is_covered] for each in (stamps_s, true, ours, raw))
    errors_m = _apart_m(true, ours)
    worst = int(errors_m.argmax())
    return StepErrors(
        relations=len(errors_m),
        p99_m=float(np.percentile(errors_m, 99.0)),
        worst_m=float(errors_m[worst]),
        worst_raw_m=float(_apart_m(true, raw)[worst]),
        worst_ours_vs_raw_m=float(_apart_m(raw, ours)[worst]),
        worst_from_s=float(stamps_s[worst, 0]),
        worst_to_s=float(stamps_s[worst, 1]),
    )


def _relative(
    trajectory: Sequence[StampedPose], stamps_s: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return the motion between pairs of times, shape (N, 4, 4), and whether it is known, (N,)."""
    known_s = np.array([pose.stamp_s for pose in trajectory])
    poses = np.stack([pose.reference_from_body for pose in trajectory])
    nearest = np.searchsorted(0.5 * (known_s[:-1] + known_s[1:]), stamps_s)
    is_known = np.all(np.abs(known_s[nearest] - stamps_s) <= _TOLERANCE_S, axis=1)
    first, second = nearest.T
    return np.linalg.inv(poses[first]) @ poses[second], is_known


def _apart_m(true: FloatArray, estimated: FloatArray) -> FloatArray:
    """Return the lengths of the translational errors, shape (N,)."""
    return np.asarray(np.linalg.norm((np.linalg.inv(true) @ estimated)[:, :3, 3], axis=1))
