"""Readings on the wire: which messages may be sent as what, and why a sample is refused.

References:
    own.
"""

from __future__ import annotations

from enum import StrEnum

from hmt_service.core.config import SensorConfig
from hmt_service.core.geometry import Pose
from hmt_service.core.types import Reading, Scan
from hmt_service.io import foxglove, ros_messages
from hmt_service.io.decoding import Decoded, Defect, names_of_body
from hmt_service.io.ros_messages import Frames, RosType, Serialization
from hmt_service.runtime.messages import Wire
from hmt_service.service.codec import PREFIX, wire
from hmt_service.service.keys import Input
from hmt_service.service.ros2 import CDR_PREFIX, input_of


class Refusal(StrEnum):
    """Why a sample was not taken, whatever it holds."""

    TOO_LARGE = "too_large"
    QUEUE_FULL = "queue_full"
    STOPPING = "stopping"
    UNKNOWN_KEY = "unknown_key"
    WRONG_ENCODING = "wrong_encoding"


_SCHEMAS = {Input.SCAN: foxglove.SCAN_SCHEMAS, Input.ODOMETRY: foxglove.ODOMETRY_SCHEMAS}
_ROS_TYPES = {f"{CDR_PREFIX}{kind}": kind for kind in RosType}


class ReadingDecoder:
    """Reads the samples of one robot; the first usable scan of ROS names the frame of all."""

    def __init__(self, sensor: SensorConfig, body_from_sensor: Pose | None = None) -> None:
        """Prepare.

        Args:
            sensor: What the sensor can see; returns outside of its range count as none.
            body_from_sensor: Where the sensor of ROS scans sits on the body, shape (4, 4); None: at
                its origin, and only odometry of the frame that the scans are in is taken.
        """
        self._sensor = sensor
        self._has_pose = body_from_sensor is not None
        self._frames = (
            Frames(body=()) if body_from_sensor is None else Frames(None, None, body_from_sensor)
        )

    def decode(self, name: Input, payload: bytes, encoding: str) -> Decoded | Defect | Refusal:
        """Return the reading in a sample, or why it is refused.

        Args:
            name: What the sample was sent as.
            payload: Its bytes.
            encoding: How it says that they are encoded.
        """
        kind = _ROS_TYPES.get(encoding)
        if kind is not None and input_of(kind) is name:
            return self._decode_ros(kind, payload)
        schema = encoding.removeprefix(PREFIX)
        if not encoding.startswith(PREFIX) or schema not in _SCHEMAS[name]:
            return Refusal.WRONG_ENCODING
        sensor = self._sensor
        return foxglove.decode(
            schema, payload, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m
        )

    def _decode_ros(self, kind: RosType, payload: bytes) -> Decoded | Defect:
        decoded = ros_messages.decode(
            kind,
            payload,
            Serialization.CDR,
            min_range_m=self._sensor.min_range_m,
            max_range_m=self._sensor.max_range_m,
            frames=self._frames,
        )
        if isinstance(decoded, Decoded) and isinstance(decoded.reading, Scan):
            self._learn(str(decoded.frame))
        return decoded

    def _learn(self, scan_frame: str) -> None:
        if self._frames.scan is None:
            bodies = None if self._has_pose else names_of_body(scan_frame)
            self._frames = Frames({scan_frame}, bodies, self._frames.body_from_sensor)


def name_of(reading: Reading) -> Input:
    """Return what a reading is sent as."""
    return Input.SCAN if isinstance(reading, Scan) else Input.ODOMETRY


def encode_reading(reading: Reading) -> Wire:
    """Return a reading as it is sent; what comes back is what `foxglove.encode` promises.

    Raises:
        InvalidInput: If the stamp is not finite.
    """
    return wire(foxglove.encode(reading))
