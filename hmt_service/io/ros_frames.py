"""Where a sensor sits on its robot, as ROS tells in `tf_static`.

References:
    ROS tf2_msgs/TFMessage; REP 105 (frames form a tree).
"""

from __future__ import annotations

from rosbags.serde import SerdeError

from hmt_service.core.geometry import Pose, identity, inverse
from hmt_service.io.decoding import MAX_SENSOR_OFFSET_M, DefectError, checked_pose
from hmt_service.io.ros_messages import TRANSFORMS, Serialization, frame_name, message_of


class StaticFrames:
    """Frames that never move against each other."""

    def __init__(self) -> None:
        """Begin with none."""
        self._parents: dict[str, tuple[str, Pose]] = {}

    def learn(self, payload: bytes, serialization: Serialization) -> None:
        """Take what a message of `TRANSFORMS` says; what cannot be used of it is left out."""
        try:
            message = message_of(TRANSFORMS, payload, serialization)
        except SerdeError:
            return
        for stamped in message.transforms:
            p, q = stamped.transform.translation, stamped.transform.rotation
            try:
                parent_from_child = checked_pose(
                    (q.x, q.y, q.z, q.w), (p.x, p.y, p.z), farthest_m=MAX_SENSOR_OFFSET_M
                )
            except DefectError:
                continue
            child, parent = frame_name(stamped.child_frame_id), frame_name(stamped.header.frame_id)
            self._parents[child] = parent, parent_from_child

    def pose(self, body: str, sensor: str) -> Pose | None:
        """Return `body_from_sensor`, shape (4, 4); None where nothing joins the two."""
        from_body, from_sensor = self._ancestors(body), self._ancestors(sensor)
        for frame, frame_from_body in from_body.items():
            if frame in from_sensor:
                return inverse(frame_from_body) @ from_sensor[frame]
        return None

    def _ancestors(self, frame: str) -> dict[str, Pose]:
        """Return the pose of a frame in itself and in all frames that it hangs on."""
        poses = {frame: identity()}
        at = frame
        while at in self._parents and self._parents[at][0] not in poses:
            parent, parent_from_at = self._parents[at]
            poses[parent] = parent_from_at @ poses[at]
            at = parent
        return poses
