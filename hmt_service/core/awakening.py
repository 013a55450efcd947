"""Awakening: a robot that may be anywhere, in the map or outside.

A new session begins like a visit to an area after a motion of which nothing is known. That motion
is an arc, so that the graph stays one; but what it joins are two parts that have no place beside
each other until an alignment ties them. A robot that is carried away while it runs wakes up where
it is put down.

References:
    Blanco et al. 2008, section II (the awakening problem is one of topological inference).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hmt_service.core.geometry import (
    ANY_HEADING_RAD,
    FloatArray,
    GaussianPose,
    confined,
    identity,
    isotropic_covariance,
)
from hmt_service.core.types import Keyframe, TrackingFailure

if TYPE_CHECKING:
    from hmt_service.core.graph import Factor
    from hmt_service.core.submap import Visit


# Farther than any robot has gone: what is known no better is not known at all.
_ANYWHERE_M = 1e4
_NOWHERE_M = 0.1 * _ANYWHERE_M
# Robots stand upright, also on ramps.
_LEVEL_RAD = 0.1


def awakened(keyframe: Keyframe, *, is_planar: bool) -> Keyframe:
    """Return the first keyframe of a new session: the robot may have been carried anywhere.

    Args:
        keyframe: As an odometry gives it that knows nothing of a session before.
        is_planar: Whether poses are planar.
    """
    return replace(
        keyframe,
        failure=TrackingFailure.NEW_SESSION,
        previous_from_body=anywhere(is_planar=is_planar),
    )


def anywhere(*, is_planar: bool) -> GaussianPose:
    """Return a relative pose of which nothing is known.

    Args:
        is_planar: Whether poses are planar.
    """
    covariance = isotropic_covariance(sigma_rad=ANY_HEADING_RAD, sigma_m=_ANYWHERE_M)
    return GaussianPose(identity(), confined(covariance, is_planar=is_planar))


def put_down(arc: Factor, *, is_planar: bool) -> Factor:
    """Return the arc of a motion after which the robot was carried: it says nothing."""
    return replace(arc, a_from_b=anywhere(is_planar=is_planar))


def is_anywhere(pose: GaussianPose) -> bool:
    """Return whether nothing is known of a relative pose."""
    return pose.sigma_m > _NOWHERE_M


def anywhere_in(target: Visit, visit: Visit, presence_m: float) -> GaussianPose:
    """Return where a visit is if it is in an area, and no more is known: `area_from_visit`.

    Args:
        target: The visit that founded the area.
        visit: The visit.
        presence_m: How far from where it has been there a robot is still in the area.
    """
    sigma_m = target.radius_m + visit.radius_m + presence_m
    return _in_any_heading(target.centre, visit, sigma_m)


def beside_keyframes(target: Visit, visit: Visit, presence_m: float) -> tuple[GaussianPose, ...]:
    """Return the same as what it consists of: a place beside each keyframe of the area.

    Areas are cut as they come: only so two places that were passed alike are alike.
    """
    return tuple(
        _in_any_heading(pose.mean[:3, 3], visit, presence_m) for pose in target.visit_from_keyframe
    )


def _in_any_heading(position: FloatArray, visit: Visit, sigma_m: float) -> GaussianPose:
    """Return the pose of a visit whose middle is about at a position, shape (3,), m."""
    covariance = isotropic_covariance(sigma_rad=ANY_HEADING_RAD, sigma_m=sigma_m)
    covariance[:2, :2] = _LEVEL_RAD**2 * np.eye(2)
    middle_over_position = identity()
    middle_over_position[:3, 3] = position - visit.centre
    return GaussianPose(
        middle_over_position, confined(covariance, is_planar=visit.config.sensor.is_planar)
    )
