"""Metric level: ties each scan to the keyframes before it and picks the next keyframe.

References:
    Vizzo et al., KISS-ICP, RA-L 2023 (registration against a local voxel map).
    Blanco et al. 2008, section V ("metric SLAM" process).
"""

from __future__ import annotations

from collections import deque

import numpy as np

from hmt_service.core.config import Config
from hmt_service.core.geometry import (
    PLANAR_AXES,
    FloatArray,
    GaussianPose,
    Pose,
    certain,
    exp,
    identity,
    inverse,
    isotropic_covariance,
    log,
    planar_covariance,
    project_planar,
    symmetric,
    transform_points,
)
from hmt_service.core.registration import RegistrationMap, covariance_of, deskew, voxel_downsample
from hmt_service.core.types import (
    Keyframe,
    OdometryReading,
    Reading,
    Scan,
    Tracking,
    TrackingFailure,
)

# chi-square 99.9 % for 3 and 6 degrees of freedom: beyond it, odometry and scan contradict.
_GATE = {3: 16.27, 6: 22.46}
# Of a heading that may be anything, and of a position that nothing but speed bounds.
_LOST_RAD = np.pi / np.sqrt(3.0)
_LOST_M = 100.0
# Two stamps of one moment may differ by this much.
_STAMP_SLACK_S = 1.0


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
        self._config = config.odometry
        self._motion = config.motion
        self._covariance = config.covariance
        self._axes = PLANAR_AXES if config.sensor.is_planar else np.arange(6)
        self._window: deque[tuple[Pose, FloatArray]] = deque(
            maxlen=config.odometry.window_keyframes
        )
        self._map: RegistrationMap | None = None
        self._keyframes = 0
        self._keyframe_from_body = certain(identity())
        self._last_motion = identity()
        self._last_stamp_s: float | None = None
        self._odometry: OdometryReading | None = None
        self._odometry_at_scan: OdometryReading | None = None
        self._motion_since_odometry = identity()
        self._last_elapsed_s = 0.0
        self._registered_s = 0.0
        self._failures = 0

    def process(self, reading: Reading) -> Tracking | None:
        """Take one reading in time order.

        Args:
            reading: A scan, or odometry to be used with the next scan.

        Returns:
            What became of the scan; None for odometry.
        """
        if isinstance(reading, OdometryReading):
            if self._has_jumped(reading):
                # Its frame has moved, not the robot: nothing before compares with what follows.
                self._odometry_at_scan = None
            self._odometry = reading
            return None
        return self._register(reading)

    def _has_jumped(self, reading: OdometryReading) -> bool:
        before = self._odometry
        if before is None:
            return False
        moved_m = np.linalg.norm(reading.odom_from_body[:3, 3] - before.odom_from_body[:3, 3])
        allowed_s = max(reading.stamp_s - before.stamp_s, 0.0) + _STAMP_SLACK_S
        return bool(moved_m > self._motion.max_speed_m_s * allowed_s)

    def _register(self, scan: Scan) -> Tracking:
        if self._map is None or self._last_stamp_s is None:
            return self._begin(scan)
        elapsed_s = scan.stamp_s - self._last_stamp_s
        predicted, motion = self._predict(elapsed_s)
        points = self._points_of(scan, motion)
        posed, failure = self._correct(scan, points, predicted)
        self._last_motion = inverse(self._keyframe_from_body.mean) @ posed.mean
        self._last_elapsed_s = elapsed_s
        self._motion_since_odometry = (
            identity()
            if self._has_new_odometry
            else self._motion_since_odometry @ self._last_motion
        )
        self._failures = 0 if failure is None else self._failures + 1
        if self._is_keyframe(posed.mean, points, failure):
            if failure is not None and not self._has_new_odometry:
                posed = self._lost(posed.mean, scan.stamp_s - self._registered_s)
            return self._add_keyframe(scan, points, posed, failure)
        self._keyframe_from_body = posed
        self._remember(scan, failure)
        return Tracking(scan.stamp_s, self._keyframes - 1, posed, None, failure)

    def _begin(self, scan: Scan) -> Tracking:
        points = self._points_of(scan)
        here = certain(identity())
        if len(points) < self._config.min_points:
            return Tracking(scan.stamp_s, 0, here, None, TrackingFailure.TOO_FEW_POINTS)
        return self._add_keyframe(scan, points, here, None)

    def _is_keyframe(
        self, keyframe_from_body: Pose, points: FloatArray, failure: TrackingFailure | None
    ) -> bool:
        """Return whether the scan is kept: after motion, or to start anew when lost."""
        config = self._config
        if len(points) < config.min_points:
            return False
        if failure is not None:
            # One bad scan is no reason to give the window up.
            is_hopeless = failure is TrackingFailure.GAP_IN_TIME
            return is_hopeless or self._failures >= config.max_failures
        moved = log(keyframe_from_body)
        return bool(
            np.linalg.norm(moved[3:]) >= config.keyframe_distance_m
            or np.linalg.norm(moved[:3]) >= config.keyframe_angle_rad
        )

    def _lost(self, mean: Pose, elapsed_s: float) -> GaussianPose:
        """Return a pose that is bounded by the robot's speed only."""
        sigma_m = min(self._motion.max_speed_m_s * elapsed_s, _LOST_M)
        covariance = isotropic_covariance(sigma_rad=_LOST_RAD, sigma_m=sigma_m)
        if self._sensor.is_planar:
            covariance = planar_covariance(covariance)
        return GaussianPose(mean, covariance)

    def _points_of(self, scan: Scan, motion: Pose | None = None) -> FloatArray:
        points = scan.points_in_body
        if scan.point_times is not None and motion is not None and len(points):
            points = deskew(points, scan.point_times, motion, self._sensor.max_range_m)
        if self._sensor.is_planar or not len(points):
            return points
        return voxel_downsample(points, 0.5 * self._config.voxel_size_m)

    @property
    def _has_new_odometry(self) -> bool:
        """Whether odometry has come since the scan before."""
        return self._odometry is not self._odometry_at_scan

    def _predict(self, elapsed_s: float) -> tuple[GaussianPose, Pose]:
        """Return the predicted pose in the last keyframe and the motion since the last scan."""
        now, before = self._odometry, self._odometry_at_scan
        if now is not None and before is not None and now is not before:
            measured = inverse(before.odom_from_body) @ now.odom_from_body
            # Scans that came without odometry have been tracked through part of it already.
            motion = inverse(self._motion_since_odometry) @ measured
            times, factor = 1.0, 1.0
        else:
            times = elapsed_s / self._last_elapsed_s if self._last_elapsed_s > 0.0 else 1.0
            motion = measured = exp(times * log(self._last_motion))
            factor = self._motion.constant_velocity_factor
        if self._sensor.is_planar:
            motion, measured = project_planar(motion), project_planar(measured)
        xi = log(measured)
        turned, travelled = float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))
        noise = self._motion
        scans = max(times, 1.0)
        sigma_rad = factor * (
            noise.sigma_floor_rad * scans
            + noise.sigma_rotation_share * turned
            + noise.sigma_rotation_rad_per_m * travelled
        )
        sigma_rad = min(sigma_rad, _LOST_RAD)
        sigma_m = factor * (noise.sigma_floor_m * scans + noise.sigma_translation_share * travelled)
        covariance = isotropic_covariance(sigma_rad=sigma_rad, sigma_m=sigma_m)
        if self._sensor.is_planar:
            covariance = planar_covariance(covariance)
        return self._keyframe_from_body @ GaussianPose(motion, covariance), motion

    def _correct(
        self, scan: Scan, points: FloatArray, predicted: GaussianPose
    ) -> tuple[GaussianPose, TrackingFailure | None]:
        """Return the pose in the last keyframe after the scan has been seen."""
        config = self._config
        if self._map is None or self._last_stamp_s is None:
            return predicted, None
        is_bridged = self._odometry_at_scan is not None and self._has_new_odometry
        if scan.stamp_s - self._last_stamp_s > config.max_gap_s and not is_bridged:
            return predicted, TrackingFailure.GAP_IN_TIME
        if len(points) < config.min_points:
            return predicted, TrackingFailure.TOO_FEW_POINTS
        source = (
            points
            if self._sensor.is_planar
            else voxel_downsample(points, 1.5 * self._config.voxel_size_m)
        )
        pose = self._map.register(
            source,
            predicted.mean,
            max_correspondence_m=config.max_correspondence_m,
            kernel_m=config.kernel_m,
        )
        if pose is None:
            return predicted, TrackingFailure.TOO_FEW_CORRESPONDENCES
        correction = log(inverse(predicted.mean) @ pose)
        if (
            np.linalg.norm(correction[3:]) > config.max_correction_m
            or np.linalg.norm(correction[:3]) > config.max_correction_rad
        ):
            return predicted, TrackingFailure.CORRECTION_TOO_LARGE
        match = self._map.match(source, pose, inlier_m=config.max_correspondence_m)
        if match.inlier_share < config.min_inlier_share:
            return predicted, TrackingFailure.TOO_FEW_CORRESPONDENCES
        registered = covariance_of(
            match.information, sigma_m=self._covariance.sigma_m, is_planar=self._sensor.is_planar
        )
        return self._fuse(GaussianPose(pose, registered), predicted), None

    def _fuse(self, registered: GaussianPose, predicted: GaussianPose) -> GaussianPose:
        """Return the product of registration and motion prior, which is widened to agree.

        The prior fills the directions that the scan does not see. Where it contradicts the scan
        beyond the gate (wheel slip), it is widened until it no longer does, so that it loses its
        say there and still bounds what nothing else does.
        """
        block = np.ix_(self._axes, self._axes)
        gap = log(inverse(registered.mean) @ predicted.mean)[self._axes]
        scan_covariance = registered.covariance[block] + self._floor()[block]
        prior_covariance = predicted.covariance[block]
        together = scan_covariance + prior_covariance
        excess = float(gap @ np.linalg.solve(together, gap)) / _GATE[len(self._axes)]
        if excess > 1.0:
            prior_covariance = prior_covariance * excess
            together = scan_covariance + prior_covariance
        gain = np.linalg.solve(together, scan_covariance).T
        step, covariance = np.zeros(6), np.zeros((6, 6))
        step[self._axes] = gain @ gap
        covariance[block] = symmetric(scan_covariance - gain @ scan_covariance)
        if self._sensor.is_planar:
            covariance = planar_covariance(covariance)
        return GaussianPose(registered.mean @ exp(step), covariance)

    def _floor(self) -> FloatArray:
        floor = self._covariance
        return isotropic_covariance(sigma_rad=floor.floor_rad, sigma_m=floor.floor_m)

    def _add_keyframe(
        self,
        scan: Scan,
        points: FloatArray,
        previous_from_body: GaussianPose,
        failure: TrackingFailure | None,
    ) -> Tracking:
        keyframe = Keyframe(
            index=self._keyframes,
            stamp_s=scan.stamp_s,
            points_in_body=points.astype(np.float32),
            sensor_in_body=scan.sensor_in_body,
            previous_from_body=previous_from_body,
            failure=failure,
        )
        self._move_window(previous_from_body.mean, points, is_lost=failure is not None)
        self._keyframes += 1
        self._keyframe_from_body = certain(identity())
        self._failures = 0
        self._remember(scan, None)
        here = certain(identity())
        return Tracking(scan.stamp_s, keyframe.index, here, keyframe, failure)

    def _move_window(self, previous_from_body: Pose, points: FloatArray, *, is_lost: bool) -> None:
        """Express the window in the new keyframe's frame; a lost scan starts a new one."""
        body_from_previous = inverse(previous_from_body)
        kept = (
            [] if is_lost else [(body_from_previous @ pose, cloud) for pose, cloud in self._window]
        )
        self._window.clear()
        self._window.extend([*kept, (identity(), points)])
        self._map = RegistrationMap(
            np.concatenate([transform_points(pose, cloud) for pose, cloud in self._window]),
            voxel_m=self._config.voxel_size_m,
            points_per_voxel=self._config.points_per_voxel,
            is_planar=self._sensor.is_planar,
        )

    def _remember(self, scan: Scan, failure: TrackingFailure | None) -> None:
        self._last_stamp_s = scan.stamp_s
        if failure is None:
            self._registered_s = scan.stamp_s
        self._odometry_at_scan = self._odometry
