"""A robot that follows a route: from waypoints to stamped true poses.

References:
    Coulter, Implementation of the Pure Pursuit Path Tracking Algorithm, CMU-RI-TR-92-01, 1992.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice

import numpy as np
from pydantic import Field

from hmt_service.core.geometry import FloatArray, exp, log
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.sim.declared import Declared, checked

STEP_S = 0.02
"""Time between two poses of a drive."""
_CARROT_STEP_M = 0.02
_GOAL_M = 0.1
_TURN_GAIN_HZ = 3.0
_WHEELBASE_M = 0.5
_BLOCK = 512
_STEP_DECIMALS = 9


@checked
class PathFollower(Declared):
    """A robot on the ground that chases a point moving ahead of it along the route."""

    speed_m_s: float = Field(default=0.6, gt=0.0)
    """Fastest motion seen from above; the robot slows down while it turns towards the point."""
    turn_rad_s: float = Field(default=0.9, gt=0.0)
    """Fastest turn."""
    look_ahead_m: float = Field(default=0.4, gt=_GOAL_M)
    """Distance of the point: corners are cut by less than half of it."""
    caution: float = Field(default=1.0, ge=1.0)
    """Power of the cosine of the angle to the point that the robot slows down by: a fast robot that
    turns slowly needs more, or it overshoots the corners."""

    def drive(self, route_m: FloatArray) -> Iterator[StampedPose]:
        """Return the poses from the first waypoint to the last, `STEP_S` apart, as they come.

        The robot steers in x and y. The ground below it rises along the route as the route does
        and not across; the robot stands on two points of it, one wheelbase apart, without roll.

        Args:
            route_m: Waypoints on the ground, shape (W, 3), W >= 2, m; consecutive ones differ in
                x or y.

        Raises:
            InvalidInput: If there are not two waypoints, one is above or at the one before, or a
                number is not finite.
        """
        route_m = np.asarray(route_m, dtype=np.float64)
        if route_m.ndim != 2 or route_m.shape[1] != 3 or len(route_m) < 2:
            raise InvalidInput(f"route of shape {route_m.shape}: not two waypoints (x, y, z)")
        lengths = np.linalg.norm(np.diff(route_m[:, :2], axis=0), axis=1)
        if not np.all(np.isfinite(route_m)) or not lengths.min() > 0.0:
            raise InvalidInput(
                f"route of {len(route_m)} waypoints and legs of {lengths.min():g} m and more"
            )
        return self._poses(route_m, np.concatenate([[0.0], np.cumsum(lengths)]))

    def _poses(self, route_m: FloatArray, travelled: FloatArray) -> Iterator[StampedPose]:
        ground = _Ground(route_m, travelled)
        steps = self._pursue(route_m, travelled)
        number = 0
        while block := list(islice(steps, _BLOCK)):
            for pose in ground.poses(np.array(block)):
                yield StampedPose(number * STEP_S, pose)
                number += 1

    def _pursue(
        self, route_m: FloatArray, travelled: FloatArray
    ) -> Iterator[tuple[float, float, float, float]]:
        """Yield x (m), y (m), yaw (rad) and the place along the route (m) at each step."""
        carrots = _points_along(route_m, travelled)
        x, y = route_m[0, :2].tolist()
        yaw = math.atan2(*(route_m[1] - route_m[0])[1::-1])
        carrot_x, carrot_y, carrot_at = next(carrots)
        at = 0.0
        while True:
            distance = math.dist((x, y), (carrot_x, carrot_y))
            while distance < self.look_ahead_m and (ahead := next(carrots, None)):
                carrot_x, carrot_y, carrot_at = ahead
                distance = math.dist((x, y), (carrot_x, carrot_y))
            # Where the route turns back, the point jumps; what the robot stands on does not.
            at = min(carrot_at - distance, at + 2.0 * self.speed_m_s * STEP_S)
            yield x, y, yaw, at
            if distance < _GOAL_M:
                return
            error = math.remainder(math.atan2(carrot_y - y, carrot_x - x) - yaw, math.tau)
            turn = max(-self.turn_rad_s, min(self.turn_rad_s, _TURN_GAIN_HZ * error))
            speed = self.speed_m_s * max(0.0, math.cos(error)) ** self.caution
            x += speed * math.cos(yaw) * STEP_S
            y += speed * math.sin(yaw) * STEP_S
            yaw += turn * STEP_S


def steps_of(stamps_s: FloatArray) -> FloatArray:
    """Return stamps in steps of a drive; rounded, so that the stamp of a pose is a whole number."""
    return np.round(stamps_s / STEP_S, _STEP_DECIMALS)


class Motion:
    """A stretch of a drive, which can be asked for the pose at any time in it."""

    def __init__(self, first_step: int, poses: FloatArray) -> None:
        """Take some of the poses of a drive.

        Args:
            first_step: Number of the first of them, from 0.
            poses: Poses `STEP_S` apart, shape (N, 4, 4), N >= 1.
        """
        self._first_step = first_step
        self._poses = poses
        steps = log(np.linalg.inv(poses[:-1]) @ poses[1:])
        self._steps = np.concatenate([steps, np.zeros((1, 6))])

    def at(self, stamps_s: FloatArray) -> FloatArray:
        """Return the poses at these times, shape (...) -> (..., 4, 4).

        Before the first pose and after the last one the robot stands still.
        """
        at = (steps_of(stamps_s) - self._first_step).clip(0.0, len(self._poses) - 1.0)
        before = at.astype(np.intp)
        return self._poses[before] @ exp((at - before)[..., None] * self._steps[before])


class _Ground:
    """The ground under a route."""

    def __init__(self, route_m: FloatArray, travelled: FloatArray) -> None:
        """Take the waypoints, shape (W, 3), and how far along the route they are, shape (W,), m."""
        self._travelled = travelled
        legs = np.diff(route_m, axis=0)
        # Summed up along the route, so that the mean gradient of a stretch is a difference.
        climbs = legs[:, :2] * (legs[:, 2] / np.diff(travelled))[:, None]
        self._gradient_sums = np.concatenate([np.zeros((1, 2)), np.cumsum(climbs, axis=0)])
        self._route_m = route_m

    def poses(self, steps: FloatArray) -> FloatArray:
        """Return the poses of a robot on the ground, shape (N, 4, 4).

        Args:
            steps: x (m), y (m), yaw (rad) and place along the route (m), shape (N, 4).
        """
        positions, yaws = steps[:, :2], steps[:, 2]
        at = np.clip(steps[:, 3], 0.0, self._travelled[-1])
        rear = np.maximum(at - 0.5 * _WHEELBASE_M, 0.0)
        front = np.minimum(at + 0.5 * _WHEELBASE_M, self._travelled[-1])
        gradients = self._along(self._gradient_sums, front) - self._along(self._gradient_sums, rear)
        gradients /= (front - rear)[:, None]
        below = self._along(self._route_m, at)
        beside = positions - below[:, :2]
        c, s = np.cos(yaws), np.sin(yaws)
        slopes = gradients[:, 0] * c + gradients[:, 1] * s
        pitch_c = 1.0 / np.sqrt(1.0 + slopes**2)
        pitch_s = slopes * pitch_c
        poses = np.zeros((len(steps), 4, 4))
        poses[:, :3, 0] = np.column_stack([c * pitch_c, s * pitch_c, pitch_s])
        poses[:, :3, 1] = np.column_stack([-s, c, np.zeros_like(c)])
        poses[:, :3, 2] = np.column_stack([-c * pitch_s, -s * pitch_s, pitch_c])
        poses[:, :2, 3] = positions
        poses[:, 2, 3] = below[:, 2] + np.sum(gradients * beside, axis=1)
        poses[:, 3, 3] = 1.0
        return poses

    def _along(self, values: FloatArray, at: FloatArray) -> FloatArray:
        """Return values of the waypoints, shape (W, D), in between, shape (N, D)."""
        return np.column_stack([np.interp(at, self._travelled, each) for each in values.T])


def _points_along(
    route_m: FloatArray, travelled: FloatArray
) -> Iterator[tuple[float, float, float]]:
    """Yield x, y and the place along the route every few centimetres, its end included."""
    count = math.ceil(travelled[-1] / _CARROT_STEP_M)
    for first in range(0, count, _BLOCK):
        at = np.arange(first, min(first + _BLOCK, count)) * _CARROT_STEP_M
        x, y = (np.interp(at, travelled, route_m[:, axis]).tolist() for axis in (0, 1))
        yield from zip(x, y, at.tolist(), strict=True)
    yield (*route_m[-1, :2].tolist(), float(travelled[-1]))
