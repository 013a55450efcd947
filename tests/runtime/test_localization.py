from __future__ import annotations

import numpy as np
import pytest

from hmt_service.core.geometry import GaussianPose, Pose, planar_pose
from hmt_service.core.types import (
    HmtPose,
    HypothesisSummary,
    Keyframe,
    Localization,
    Posterior,
    Snapshot,
    Tracking,
)
from hmt_service.runtime.localization import Localizer

VARIANCE = 0.01


def gaussian(pose: Pose) -> GaussianPose:
    return GaussianPose(pose, VARIANCE * np.eye(6))


def tracking(keyframe: int, motion: Pose, *, becomes_keyframe: bool = False) -> Tracking:
    """Return a scan at `motion` from a keyframe, or a keyframe at `motion` from its predecessor."""
    if not becomes_keyframe:
        return Tracking(keyframe + 0.5, keyframe, gaussian(motion), None)
    points = np.zeros((0, 3), dtype=np.float32)
    kept = Keyframe(keyframe, float(keyframe), points, np.zeros(3), gaussian(motion))
    still = GaussianPose(np.eye(4), np.zeros((6, 6)))
    return Tracking(float(keyframe), keyframe, still, kept)


def snapshot(keyframe: int, area_from_keyframe: Pose, *, area: int = 7) -> Snapshot:
    summaries = (
        HypothesisSummary(3, 0.6, area, (0, area), 8, 0, 7),
        HypothesisSummary(4, 0.3, area, (0, 1, area), 9, 0, 8),
        HypothesisSummary(5, 0.1, 0, (0, 1, 0), 8, 1, 7),
    )
    posterior = Posterior(float(keyframe), 11, summaries, {area: 0.9, 0: 0.1}, 2.0)
    reference_from_keyframe = planar_pose(100.0, 0.0, 0.0) @ area_from_keyframe
    return Snapshot(
        posterior,
        Localization(float(keyframe), 0.9, 0.3, None),
        keyframe,
        gaussian(area_from_keyframe),
        gaussian(reference_from_keyframe),
        0,
        8,
        7,
        keyframe + 1,
    )


def located(localizer: Localizer) -> HmtPose:
    pose = localizer.pose
    assert pose is not None
    return pose


def test_there_is_no_pose_before_both_map_and_odometry() -> None:
    localizer = Localizer()
    assert localizer.pose is None
    localizer.track(tracking(0, planar_pose(0.1, 0.0, 0.0)))
    assert localizer.pose is None
    localizer.update(snapshot(0, planar_pose(1.0, 0.0, 0.0)))
    assert located(localizer).area == 7


def test_the_pose_is_composed_over_keyframes_that_the_map_does_not_have_yet() -> None:
    localizer = Localizer()
    motions = [planar_pose(1.0, 0.0, np.pi / 2), planar_pose(2.0, 0.0, 0.0)]
    localizer.track(tracking(0, np.eye(4), becomes_keyframe=True))
    localizer.update(snapshot(0, planar_pose(5.0, 5.0, 0.0)))
    for index, motion in enumerate(motions, start=1):
        localizer.track(tracking(index, motion, becomes_keyframe=True))
    localizer.track(tracking(2, planar_pose(0.25, 0.0, 0.0)))
    pose = located(localizer)
    # 1 m along x, a turn to the left, then 2.25 m along y.
    expected = planar_pose(6.0, 7.25, np.pi / 2)
    np.testing.assert_allclose(pose.area_from_body.mean, expected, atol=1e-12)
    np.testing.assert_allclose(
        pose.reference_from_body.mean, planar_pose(106.0, 7.25, np.pi / 2), atol=1e-12
    )
    # Four independent steps with the same rotational variance: it adds up.
    assert pose.area_from_body.covariance[2, 2] == pytest.approx(4 * VARIANCE)
    assert (pose.stamp_s, pose.revision, pose.hypothesis) == (2.5, 11, 3)
    assert pose.probability == 0.9


def test_a_map_that_goes_on_says_nothing_of_where_the_session_began() -> None:
    localizer = Localizer()
    localizer.update(snapshot(-1, planar_pose(5.0, 5.0, 0.0)))
    localizer.track(tracking(0, np.eye(4), becomes_keyframe=True))
    assert localizer.pose is None
    localizer.update(snapshot(0, planar_pose(1.0, 0.0, 0.0)))
    assert located(localizer).localization.probability == 0.9


def test_a_newer_map_replaces_the_steps_that_it_contains() -> None:
    localizer = Localizer()
    for index in range(4):
        localizer.track(tracking(index, planar_pose(1.0, 0.0, 0.0), becomes_keyframe=True))
    localizer.update(snapshot(0, np.eye(4)))
    assert located(localizer).area_from_body.mean[0, 3] == pytest.approx(3.0)
    # The map has moved keyframe 2; only the step from 2 to 3 is the odometry's.
    localizer.update(snapshot(2, planar_pose(50.0, 0.0, 0.0), area=1))
    pose = located(localizer)
    assert pose.area == 1
    assert pose.area_from_body.mean[0, 3] == pytest.approx(51.0)
    assert pose.area_from_body.covariance[2, 2] == pytest.approx(2 * VARIANCE)
