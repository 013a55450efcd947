"""RTL: where the robot is now, from the latest map and the odometry since then.

References:
    Blanco et al. 2008, section IV (real-time localization), Eq. (15) (composition).
"""

from __future__ import annotations

import threading

import numpy as np

from hmt_service.core.geometry import GaussianPose, certain
from hmt_service.core.types import HmtPose, Keyframe, Snapshot, Tracking


class Localizer:
    """Composes the snapshot's pose, the keyframes after it, and the latest scan's pose.

    Scans and snapshots may come from different threads; `pose` never waits for either.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._keyframes: dict[int, GaussianPose] = {}
        self._snapshot: Snapshot | None = None
        self._tracking: Tracking | None = None
        self._chain = certain(np.eye(4))
        self._pose: HmtPose | None = None

    def forget(self) -> None:
        """Begin anew: what the next tracking is relative to has nothing to do with those before."""
        with self._lock:
            self._keyframes.clear()
            self._snapshot, self._tracking, self._pose = None, None, None
            self._chain = certain(np.eye(4))

    def track(self, tracking: Tracking) -> None:
        """Take what the odometry says of the latest scan."""
        with self._lock:
            self._tracking = tracking
            if tracking.keyframe is not None:
                self._append(tracking.keyframe)
            self._update()

    def update(self, snapshot: Snapshot) -> None:
        """Take the latest map."""
        with self._lock:
            self._snapshot = snapshot
            self._keyframes = {
                index: motion
                for index, motion in self._keyframes.items()
                if index > snapshot.keyframe_index
            }
            self._chain = certain(np.eye(4))
            for index in sorted(self._keyframes):
                self._chain = self._chain @ self._keyframes[index]
            self._update()

    @property
    def pose(self) -> HmtPose | None:
        """Where the robot was at the latest scan; None before the first keyframe is in the map."""
        return self._pose

    def _append(self, keyframe: Keyframe) -> None:
        self._keyframes[keyframe.index] = keyframe.previous_from_body
        self._chain = self._chain @ keyframe.previous_from_body

    def _update(self) -> None:
        snapshot, tracking = self._snapshot, self._tracking
        # Before its first keyframe is in the map nothing is known of where a session began.
        if snapshot is None or tracking is None or snapshot.keyframe_index < 0:
            return
        keyframe_from_body = self._chain @ tracking.keyframe_from_body
        posterior = snapshot.posterior
        best = posterior.hypotheses[0]
        self._pose = HmtPose(
            stamp_s=tracking.stamp_s,
            area=best.current_area,
            area_from_body=snapshot.area_from_keyframe @ keyframe_from_body,
            reference_area=snapshot.reference_area,
            reference_from_body=snapshot.reference_from_keyframe @ keyframe_from_body,
            hypothesis=best.hypothesis,
            probability=posterior.current_area[best.current_area],
            localization=snapshot.localization,
            revision=posterior.revision,
        )
