from __future__ import annotations

import numpy as np
import pytest
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan

from hmt_service.core.config import SensorConfig
from hmt_service.core.geometry import planar_pose
from hmt_service.core.types import OdometryReading, Reading, Scan
from hmt_service.io.decoding import Decoded, Defect
from hmt_service.service.codec import encoding_of
from hmt_service.service.keys import Input
from hmt_service.service.readings import ReadingDecoder, Refusal, encode_reading
from tests.messages import laser_scan

SENSOR = SensorConfig(min_range_m=0.5, max_range_m=30.0)
LASER = encoding_of(LaserScan)


@pytest.mark.parametrize(
    ("name", "reading"),
    [
        (Input.SCAN, Scan(1.0, np.array([[1.0, 2.0, 3.0]]), np.zeros(3))),
        (Input.ODOMETRY, OdometryReading(2.0, planar_pose(1.0, 2.0, 3.0))),
    ],
)
def test_what_is_sent_is_what_arrives(name: Input, reading: Reading) -> None:
    message = encode_reading(reading)
    result = ReadingDecoder(SENSOR).decode(name, message.payload, message.encoding)
    assert isinstance(result, Decoded)
    assert type(result.reading) is type(reading)
    assert result.reading.stamp_s == reading.stamp_s


def test_the_sensor_says_what_is_a_return() -> None:
    payload = laser_scan([0.4, 1.0, 31.0, 30.0]).SerializeToString()
    result = ReadingDecoder(SENSOR).decode(Input.SCAN, payload, LASER)
    assert isinstance(result, Decoded)
    assert isinstance(result.reading, Scan)
    assert len(result.reading.points_in_body) == 2


@pytest.mark.parametrize(
    ("name", "encoding"),
    [
        (Input.ODOMETRY, LASER),
        (Input.SCAN, "zenoh/bytes"),
        (Input.SCAN, "application/protobuf"),
        (Input.SCAN, "application/protobuf;foxglove.Grid"),
        (Input.SCAN, "foxglove.LaserScan"),
    ],
)
def test_a_message_sent_as_something_else_is_refused(name: Input, encoding: str) -> None:
    payload = laser_scan([1.0]).SerializeToString()
    assert ReadingDecoder(SENSOR).decode(name, payload, encoding) is Refusal.WRONG_ENCODING


def test_a_defect_is_the_reason_of_a_refusal() -> None:
    message = laser_scan([1.0])
    message.frame_id = "laser"
    result = ReadingDecoder(SENSOR).decode(Input.SCAN, message.SerializeToString(), LASER)
    assert result is Defect.WRONG_FRAME
