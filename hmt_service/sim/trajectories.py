"""A robot that follows a route: from waypoints to stamped true poses.

References:
    Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, 1992.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hmt_service.core.geometry import FloatArray, planar_pose
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput

_STEP_S = 0.02
_CARROT_STEP_M = 0.02
_GOAL_M = 0.1
_TURN_GAIN_HZ = 3.0


@dataclass(frozen=True, slots=True)
class PathFollower:
    """A planar robot that chases a point moving ahead of it along the route."""

    speed_m_s: float = 0.6
    """Fastest forward motion; the robot slows down while it turns towards the point."""
    turn_rad_s: float = 0.9
    """Fastest turn."""
    look_ahead_m: float = 0.4
    """Distance of the point: corners are cut by less than half of it."""
    period_s: float = 0.2
    """Time between two poses."""

    def drive(self, route_m: FloatArray) -> tuple[StampedPose, ...]:
        """Return the poses from the first waypoint to the last, in the frame of the route.

        Args:
            route_m: Waypoints, shape (W, 2), W >= 2, m; consecutive ones differ.

        Raises:
            InvalidInput: If there are not two waypoints, or one repeats the one before.
        """
        lengths = np.linalg.norm(np.diff(route_m, axis=0), axis=1)
        if not len(lengths) or not lengths.min() > 0.0:
            raise InvalidInput(f"route of {len(route_m)} waypoints and legs of {lengths} m")
        travelled = np.concatenate([[0.0], np.cumsum(lengths)])
        carrots = _points_along(route_m, travelled)
        x, y = route_m[0]
        yaw = math.atan2(*(route_m[1] - route_m[0])[::-1])
        steps_per_pose = round(self.period_s / _STEP_S)
        poses = []
        carrot = step = 0
        while True:
            if step % steps_per_pose == 0:
                stamp_s = step // steps_per_pose * self.period_s
                poses.append(StampedPose(stamp_s, planar_pose(x, y, yaw)))
            distance = math.dist((x, y), carrots[carrot])
            while distance < self.look_ahead_m and carrot < len(carrots) - 1:
                carrot += 1
                distance = math.dist((x, y), carrots[carrot])
            if distance < _GOAL_M:
                return tuple(poses)
            bearing = math.atan2(carrots[carrot][1] - y, carrots[carrot][0] - x)
            error = math.remainder(bearing - yaw, math.tau)
            turn = max(-self.turn_rad_s, min(self.turn_rad_s, _TURN_GAIN_HZ * error))
            speed = self.speed_m_s * max(0.0, math.cos(error))
            x += speed * math.cos(yaw) * _STEP_S
            y += speed * math.sin(yaw) * _STEP_S
            yaw += turn * _STEP_S
            step += 1


def _points_along(route_m: FloatArray, travelled: FloatArray) -> list[tuple[float, float]]:
    """Return points every few centimetres of the route, its end included."""
    at = np.append(np.arange(0.0, travelled[-1], _CARROT_STEP_M), travelled[-1])
    x, y = (np.interp(at, travelled, route_m[:, axis]).tolist() for axis in (0, 1))
    return list(zip(x, y, strict=True))
