"""Readings on the wire: which messages may be sent as what, and why a sample is refused.

References:
    own.
"""

from __future__ import annotations

from enum import StrEnum

from hmt_service.core.config import SensorConfig
from hmt_service.core.types import Reading
from hmt_service.io import foxglove
from hmt_service.io.decoding import Decoded, Defect
from hmt_service.service.codec import PREFIX, Wire, wire
from hmt_service.service.keys import Input


class Refusal(StrEnum):
    """Why a sample was not taken, whatever it holds."""

    TOO_LARGE = "too_large"
    QUEUE_FULL = "queue_full"
    STOPPING = "stopping"
    UNKNOWN_KEY = "unknown_key"
    WRONG_ENCODING = "wrong_encoding"


_SCHEMAS = {Input.SCAN: foxglove.SCAN_SCHEMAS, Input.ODOMETRY: foxglove.ODOMETRY_SCHEMAS}


def decode_reading(
    name: Input, payload: bytes, encoding: str, sensor: SensorConfig
) -> Decoded | Defect | Refusal:
    """Return the reading in a sample, or why it is refused.

    Args:
        name: What the sample was sent as.
        payload: Its bytes.
        encoding: How it says that they are encoded.
        sensor: What the sensor can see; returns outside of its range count as none.
    """
    schema = encoding.removeprefix(PREFIX)
    if not encoding.startswith(PREFIX) or schema not in _SCHEMAS[name]:
        return Refusal.WRONG_ENCODING
    return foxglove.decode(
        schema, payload, min_range_m=sensor.min_range_m, max_range_m=sensor.max_range_m
    )


def encode_reading(reading: Reading) -> Wire:
    """Return a reading as it is sent; what comes back is what `foxglove.encode` promises.

    Raises:
        InvalidInput: If the stamp is not finite.
    """
    return wire(foxglove.encode(reading))
