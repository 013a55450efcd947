"""Metric level: ties each scan to the keyframes before it and picks the next keyframe.

References:
    Vizzo et al., KISS-ICP, RA-L 2023 (registration against a short local map).
    Blanco et al. 2008, section V ("metric SLAM" process).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    ANY_HEADING_RAD,
    FloatArray,
    GaussianPose,
    Pose,
    apart,
    certain,
    confined,
    exp,
    identity,
    inverse,
    isotropic_covariance,
    log,
    project_planar,
)
from hmt_service.core.local_map import Fit, LocalMap, SeenPoints, Sweep, compile_kernels
from hmt_service.core.surfels import thin
from hmt_service.core.types import (
    Keyframe,
    OdometryReading,
    Reading,
    Registration,
    Scan,
    Tracking,
    TrackingFailure,
)
from hmt_service.core.wheels import WheelCalibration, sigmas_of
from hmt_service.errors import InvalidInput

# Of a position that nothing but speed bounds.
_LOST_M = 100.0
# Two stamps of one moment may differ by this much.
_STAMP_SLACK_S = 1.0
# Sizes of cells, over those of the local map: of what a keyframe keeps of a LiDAR's points, and of
# what is registered of these.
_KEPT_CELLS, _REGISTERED_CELLS = 0.5, 1.5
# New space makes a keyframe after this share of the usual motion: never while standing still.
_LEAST_MOTION_SHARE = 0.2
# Squared standard deviations by which a scan may move a pose where it says next to nothing.
_DRAWN2 = 4.0
# Of so many intervals between scans, the median is what a sweep takes.
_INTERVALS = 15
# What settings and keyframes tell.
_REBUILT = frozenset({"_sensor", "_config", "_motion", "_covariance", "_window", "_map"})


class Odometry:
    """Registers scans against a window of recent keyframes.

    Poses are kept relative to the latest keyframe, so that no number grows with the path; the
    window knows nothing of areas, and never holds a place seen a loop ago.
    """

    def __init__(self, config: Config) -> None:
        """Start without a map.

        Args:
            config: Settings of all stages.
        """
        self._sensor = config.sensor
        self._config = config
        self._motion = config.motion
        self._covariance = config.covariance
        self._window: deque[tuple[Pose, SeenPoints]] = deque(
            maxlen=config.odometry.window_keyframes
        )
        self._map: LocalMap | None = None
        self._keyframes = 0
        self._keyframe_from_body = certain(identity())
        self._keyframe_error = np.zeros((6, 6))
        self._drawn, self._allowed = np.zeros(6), np.zeros((6, 6))
        self._doubt = np.zeros(6)
        self._last_motion = identity()
        self._last_sweep_motion: FloatArray | None = None
        self._last_stamp_s: float | None = None
        self._odometry: OdometryReading | None = None
        self._odometry_at_scan: OdometryReading | None = None
        self._odometry_at_keyframe: OdometryReading | None = None
        self._wheels = WheelCalibration(config.motion)
        self._motion_since_odometry = identity()
        self._last_elapsed_s = 0.0
        self._intervals_s: deque[float] = deque(maxlen=_INTERVALS)
        self._registered_s = 0.0
        self._failures = 0
        compile_kernels(is_planar=config.sensor.is_planar)

    @classmethod
    def resumed(
        cls, config: Config, memory: Mapping[str, Any], window: Sequence[Keyframe]
    ) -> Odometry:
        """Return an odometry that goes on where another one was.

        Args:
            config: Settings of all stages, as before.
            memory: What the other one remembered.
            window: Its latest keyframes, at least as many as a window has, or all.
        """
        odometry = cls(config)
        for keyframe in window:
            points = keyframe.points_in_body.astype(np.float64)
            seen = SeenPoints.of_keyframe(points, keyframe.sensor_in_body, config)
            is_lost = keyframe.failure is not None
            odometry._move_window(keyframe.previous_from_body.mean, seen, is_lost=is_lost)
        vars(odometry).update(memory)
        return odometry

    @property
    def memory(self) -> Mapping[str, Any]:
        """What is remembered beside the window; true until the next reading."""
        return {name: value for name, value in vars(self).items() if name not in _REBUILT}

    def process(self, reading: Reading) -> Tracking | None:
        """Take one reading in time order.

        Args:
            reading: A scan, or odometry to be used with the next scan.

        Returns:
            What became of the scan; None for odometry.

        Raises:
            InvalidInput: If the points of a scan are not of shape (N, 3), or their times not (N,).
        """
        if isinstance(reading, OdometryReading):
            if self._has_jumped(reading):
                # Its frame has moved, not the robot: nothing before compares with what follows.
                self._odometry_at_scan = self._odometry_at_keyframe = None
            self._odometry = reading
            return None
        return self._track(reading)

    def _has_jumped(self, reading: OdometryReading) -> bool:
        before = self._odometry
        if before is None:
            return False
        moved_m = np.linalg.norm(reading.odom_from_body[:3, 3] - before.odom_from_body[:3, 3])
        allowed_s = max(reading.stamp_s - before.stamp_s, 0.0) + _STAMP_SLACK_S
        return bool(moved_m > self._motion.max_speed_m_s * allowed_s)

    def _track(self, scan: Scan) -> Tracking:
        if self._map is None or self._last_stamp_s is None:
            return self._begin(scan)
        elapsed_s = scan.stamp_s - self._last_stamp_s
        motion = self._predict(elapsed_s)
        sweep, sweep_share = self._sweep_of(scan, elapsed_s)
        expected = GaussianPose(
            exp(sweep_share * log(motion.mean)), sweep_share * motion.covariance
        )
        predicted = self._keyframe_from_body @ motion
        posed, fit, failure = self._register(sweep, predicted, expected, elapsed_s=elapsed_s)
        sweep_motion = log(expected.mean) if fit is None else fit.motion
        uneven = self._error_of(sweep, sweep_motion, log(expected.mean))
        registration = None if fit is None else _registration(fit, predicted.mean)
        self._remember_motion(posed.mean, elapsed_s, sweep_motion)
        self._failures = 0 if failure is None else self._failures + 1
        told, error = self._told(posed, fit if failure is None else None, uneven)
        is_keyframe = self._is_keyframe(posed.mean, len(sweep.points), registration, failure)
        if is_keyframe and fit is not None and failure is None:
            self._learn(posed.mean, fit.own_covariance + 2.0 * error)
        if is_keyframe:
            if failure is not None and not self._is_bridged:
                told = self._lost(told.mean, scan.stamp_s - self._registered_s)
            return self._add_keyframe(
                scan, sweep.at_end(sweep_motion), told, error, registration, failure
            )
        self._keyframe_from_body = posed
        self._remember(scan, failure)
        index = self._keyframes - 1
        return Tracking(scan.stamp_s, index, told, None, failure, registration)

    def _begin(self, scan: Scan) -> Tracking:
        sweep, _ = self._sweep_of(scan, np.inf)
        here = certain(identity())
        if len(sweep.points) < self._config.odometry.min_points:
            return Tracking(scan.stamp_s, 0, here, None, TrackingFailure.TOO_FEW_POINTS)
        return self._add_keyframe(scan, sweep.points, here, np.zeros((6, 6)), None, None)

    # ------------------------------------------------------------------ what is expected

    @property
    def _has_new_odometry(self) -> bool:
        """Whether odometry has come since the scan before."""
        return self._odometry is not self._odometry_at_scan

    @property
    def _is_bridged(self) -> bool:
        """Whether odometry leads from the scan before to this one."""
        return self._odometry_at_scan is not None and self._has_new_odometry

    def _predict(self, elapsed_s: float) -> GaussianPose:
        """Return the motion since the last scan: by the wheels, or as it was before."""
        now, before, noise = self._odometry, self._odometry_at_scan, self._motion
        if now is not None and before is not None and now is not before:
            told = inverse(before.odom_from_body) @ now.odom_from_body
            measured = self._wheels.corrected(told)
            # Scans that came without odometry have been tracked through part of it already.
            motion = inverse(self._motion_since_odometry) @ measured
            xi = log(measured)
            sigma_rad, sigma_m = sigmas_of(
                noise,
                float(np.linalg.norm(xi[:3])),
                float(np.linalg.norm(xi[3:])),
                floor_rad=noise.sigma_floor_rad,
                floor_m=noise.sigma_floor_m,
            )
        elif self._last_elapsed_s > 0.0:
            motion = exp(elapsed_s / self._last_elapsed_s * log(self._last_motion))
            # Speed has changed since the interval before, for as long as this one takes.
            sigma_rad = min(
                noise.sigma_floor_rad + noise.angular_acceleration_rad_s2 * elapsed_s**2,
                ANY_HEADING_RAD,
            )
            sigma_m = noise.sigma_floor_m + noise.acceleration_m_s2 * elapsed_s**2
        else:
            motion = identity()
            # Two scans of one moment are no reason to know where the second was taken.
            sigma_rad = ANY_HEADING_RAD
            sigma_m = max(noise.sigma_floor_m, noise.max_speed_m_s * elapsed_s)
        if self._sensor.is_planar:
            motion = project_planar(motion)
        covariance = isotropic_covariance(sigma_rad=sigma_rad, sigma_m=sigma_m)
        return self._confined(GaussianPose(motion, covariance))

    def _sweep_of(self, scan: Scan, elapsed_s: float) -> tuple[Sweep, float]:
        """Return what is kept of a scan, and the share of the time since the last that it took."""
        # What is compiled does not look at shapes.
        points = np.ascontiguousarray(scan.points_in_body, dtype=np.float64)
        times = scan.point_times
        if points.shape[1:] != (3,) or (times is not None and times.shape != points.shape[:1]):
            shapes = points.shape, None if times is None else times.shape
            raise InvalidInput(f"scan at {scan.stamp_s} s with points and times of shape {shapes}")
        is_timed = times is not None and 0.0 < elapsed_s < np.inf
        share = 1.0
        if is_timed:
            # Scans may be missing between two: a sweep takes what is usual from one to the next.
            self._intervals_s.append(elapsed_s)
            share = min(float(np.median(self._intervals_s)) / elapsed_s, 1.0)
        lags = np.zeros(len(points)) if times is None or not is_timed else 1.0 - times
        if not self._sensor.is_planar and len(points):
            kept = thin(points, _KEPT_CELLS * self._config.odometry.voxel_size_m)
            points, lags = points[kept], lags[kept]
        return Sweep(points, lags, scan.sensor_in_body - points), share

    # ------------------------------------------------------------------ what the scan says

    def _register(
        self, sweep: Sweep, predicted: GaussianPose, motion: GaussianPose, *, elapsed_s: float
    ) -> tuple[GaussianPose, Fit | None, TrackingFailure | None]:
        """Return the pose in the last keyframe after the scan has been seen, and how it fits."""
        config = self._config.odometry
        if elapsed_s > config.max_gap_s and not self._is_bridged:
            return predicted, None, TrackingFailure.GAP_IN_TIME
        if self._map is None or len(sweep.points) < config.min_points:
            return predicted, None, TrackingFailure.TOO_FEW_POINTS
        if not self._sensor.is_planar:
            sweep = sweep.thinned(_REGISTERED_CELLS * config.voxel_size_m, config.max_points)
        fit = self._map.register(sweep, predicted, motion)
        failure = self._failure_of(fit, predicted)
        if failure is not None:
            return predicted, fit, failure
        floor = isotropic_covariance(
            sigma_rad=self._covariance.floor_rad, sigma_m=self._covariance.floor_m
        )
        pose = self._undrawn(fit, predicted.mean, motion)
        return self._confined(GaussianPose(pose, fit.covariance + floor)), fit, None

    def _undrawn(self, fit: Fit, predicted: Pose, motion: GaussianPose) -> Pose:
        """Return where a scan fits, without what draws it along directions that it does not know.

        Clutter and noise there are better than nothing, and draw a pose to either side. The ends of
        what a laser of short range sees of a blank wall come along with the robot, and say scan
        after scan that it stands still: what adds up to more than the prediction allows is not
        believed, but casts doubt on the prediction.
        """
        if not len(fit.degenerate):
            self._drawn, self._allowed = np.zeros(6), np.zeros((6, 6))
            return fit.pose
        correction = log(inverse(predicted) @ fit.pose)
        along = np.linalg.pinv(fit.degenerate) @ fit.degenerate
        self._drawn = self._drawn + along @ correction
        self._allowed = self._allowed + motion.covariance
        drawn = fit.degenerate @ self._drawn
        allowed = fit.degenerate @ self._allowed @ fit.degenerate.T
        if drawn @ np.linalg.solve(allowed, drawn) <= _DRAWN2:
            return fit.pose
        # What is not believed is not there for the next scan either: it says the same again.
        self._doubt = along @ correction
        undrawn: Pose = predicted @ exp(correction - along @ correction)
        return undrawn

    def _failure_of(self, fit: Fit, predicted: GaussianPose) -> TrackingFailure | None:
        config = self._config.odometry
        if not fit.is_converged:
            return TrackingFailure.NOT_CONVERGED
        if fit.inlier_share < config.min_inlier_share:
            return TrackingFailure.TOO_FEW_CORRESPONDENCES
        moved_m, moved_rad = apart(predicted.mean, fit.pose)
        if moved_m > config.max_correction_m or moved_rad > config.max_correction_rad:
            return TrackingFailure.CORRECTION_TOO_LARGE
        return None

    def _told(
        self, posed: GaussianPose, fit: Fit | None, uneven: FloatArray
    ) -> tuple[GaussianPose, FloatArray]:
        """Return the pose with all that is wrong with it, and what is wrong with this scan alone.

        What is wrong with the keyframe alone is part of the first, as `Keyframe.own_error` says.

        Args:
            posed: The pose in the last keyframe as it was registered, or predicted.
            fit: The registration; None if there is none.
            uneven: Covariance of the scan's pose because of the motion during its sweep.
        """
        noise = np.zeros((6, 6))
        if fit is not None:
            # Half, because the keyframe has as much: most of a step's error is that of its ends.
            noise = 0.5 * (1.0 - self._covariance.drift_share) * fit.scan_share
        # The first keyframe of a window had nothing to be registered in: its noise is here.
        ends = 1.0 if len(self._window) == 1 else 2.0
        drift = GaussianPose(posed.mean, posed.covariance - ends * noise)
        told = GaussianPose(identity(), self._keyframe_error) @ drift
        error = uneven + noise
        doubt = np.outer(self._doubt, self._doubt)
        return self._confined(GaussianPose(told.mean, told.covariance + error + doubt)), error

    def _error_of(self, sweep: Sweep, motion: FloatArray, predicted: FloatArray) -> FloatArray:
        """Return the covariance of a pose because the motion during its sweep was not uniform.

        Turns begin and end within one sweep; speed changes from sweep to sweep. Where the motion is
        not the one that was predicted, it may have changed at any time of the sweep.
        """
        if sweep.is_instant or self._last_sweep_motion is None:
            return np.zeros((6, 6))
        change = np.maximum(np.abs(motion - self._last_sweep_motion), np.abs(motion - predicted))
        return np.diag((self._covariance.uneven_motion_share * change) ** 2)

    def _confined(self, pose: GaussianPose) -> GaussianPose:
        """Return the pose as uncertain as the robot can be: in the plane if it is planar."""
        is_planar = self._sensor.is_planar
        return GaussianPose(pose.mean, confined(pose.covariance, is_planar=is_planar))

    def _lost(self, mean: Pose, elapsed_s: float) -> GaussianPose:
        """Return a pose that is bounded by the robot's speed only."""
        sigma_m = min(self._motion.max_speed_m_s * elapsed_s, _LOST_M)
        covariance = isotropic_covariance(sigma_rad=ANY_HEADING_RAD, sigma_m=sigma_m)
        return self._confined(GaussianPose(mean, covariance))

    def _learn(self, keyframe_from_body: Pose, covariance: FloatArray) -> None:
        """Compare the step since the last keyframe with what the wheels say of it."""
        before, now = self._odometry_at_keyframe, self._odometry
        if before is not None and now is not None and self._has_new_odometry:
            told = inverse(before.odom_from_body) @ now.odom_from_body
            self._wheels.learn(told, keyframe_from_body, covariance)

    # ------------------------------------------------------------------ what is kept

    def _is_keyframe(
        self,
        keyframe_from_body: Pose,
        points: int,
        registration: Registration | None,
        failure: TrackingFailure | None,
    ) -> bool:
        """Return whether the scan is kept: after motion, of new space, or to start anew."""
        config = self._config.odometry
        if points < config.min_points:
            return False
        if failure is not None:
            # One bad scan is no reason to give the window up.
            is_hopeless = failure is TrackingFailure.GAP_IN_TIME
            return is_hopeless or self._failures >= config.max_failures
        moved = log(keyframe_from_body)
        motion = max(
            np.linalg.norm(moved[3:]) / config.keyframe_distance_m,
            np.linalg.norm(moved[:3]) / config.keyframe_angle_rad,
        )
        is_new = (
            registration is not None and 1.0 - registration.known_share >= config.keyframe_new_share
        )
        return bool(motion >= (_LEAST_MOTION_SHARE if is_new else 1.0))

    def _add_keyframe(
        self,
        scan: Scan,
        points: FloatArray,
        previous_from_body: GaussianPose,
        error: FloatArray,
        registration: Registration | None,
        failure: TrackingFailure | None,
    ) -> Tracking:
        keyframe = Keyframe(
            index=self._keyframes,
            stamp_s=scan.stamp_s,
            points_in_body=points.astype(np.float32),
            sensor_in_body=scan.sensor_in_body,
            previous_from_body=previous_from_body,
            own_error=error,
            failure=failure,
        )
        seen = SeenPoints.of_keyframe(points, scan.sensor_in_body, self._config)
        self._move_window(previous_from_body.mean, seen, is_lost=failure is not None)
        self._keyframes += 1
        self._keyframe_from_body = certain(identity())
        self._keyframe_error = error
        self._doubt = np.zeros(6)
        self._odometry_at_keyframe = self._odometry
        self._failures = 0
        self._remember(scan, None)
        here = certain(identity())
        return Tracking(scan.stamp_s, keyframe.index, here, keyframe, failure, registration)

    def _move_window(self, previous_from_body: Pose, seen: SeenPoints, *, is_lost: bool) -> None:
        """Express the window in the new keyframe's frame; a lost scan starts a new one."""
        body_from_previous = inverse(previous_from_body)
        kept = [] if is_lost else [(body_from_previous @ pose, each) for pose, each in self._window]
        self._window.clear()
        self._window.extend([*kept, (identity(), seen)])
        self._map = LocalMap.of(
            SeenPoints.together(*zip(*self._window, strict=True)),
            self._config,
            sigma_m=self._covariance.sigma_m,
        )

    def _remember_motion(self, posed: Pose, elapsed_s: float, sweep_motion: FloatArray) -> None:
        motion = inverse(self._keyframe_from_body.mean) @ posed
        if elapsed_s > 0.0:
            # Two scans of one moment say nothing of the speed.
            self._last_motion, self._last_elapsed_s = motion, elapsed_s
        self._last_sweep_motion = sweep_motion
        self._motion_since_odometry = (
            identity() if self._has_new_odometry else self._motion_since_odometry @ motion
        )

    def _remember(self, scan: Scan, failure: TrackingFailure | None) -> None:
        self._last_stamp_s = scan.stamp_s
        if failure is None:
            self._registered_s = scan.stamp_s
        self._odometry_at_scan = self._odometry


def _registration(fit: Fit, predicted: Pose) -> Registration:
    correction = inverse(predicted) @ fit.pose
    return Registration(
        inlier_share=fit.inlier_share,
        known_share=fit.known_share,
        prior_weight=fit.prior_weight,
        correction_m=float(np.linalg.norm(correction[:3, 3])),
        degenerate=fit.degenerate,
    )
