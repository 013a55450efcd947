from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, asdict, replace
from typing import Any

import pytest

from hmt_service.errors import InvalidInput
from hmt_service.sim.sensors import Laser2d, Lidar3d, WheelOdometry
from hmt_service.sim.simulation import INDOOR_LASER, LIDAR, Robot
from hmt_service.sim.trajectories import PathFollower


@pytest.mark.parametrize(
    ("part", "values", "named"),
    [
        (Laser2d, {"beams": 0}, "beams = 0"),
        (Laser2d, {"beams": 1}, "beams = 1"),
        (Laser2d, {"field_of_view_rad": 0.0}, "field_of_view_rad = 0.0"),
        (Laser2d, {"field_of_view_rad": 6.3}, "field_of_view_rad = 6.3"),
        (Laser2d, {"range_sigma_m": -0.01}, "range_sigma_m = -0.01"),
        (Laser2d, {"max_range_m": float("inf")}, "max_range_m = inf"),
        (Laser2d, {"min_range_m": -1.0}, "min_range_m = -1.0"),
        (Laser2d, {"min_range_m": 3.0, "max_range_m": 3.0}, "3 m to 3 m"),
        (Laser2d, {"sensor_in_body": (0.0, 0.0, float("nan"))}, "sensor_in_body.2 = nan"),
        (Lidar3d, {"rows": 0}, "rows = 0"),
        (Lidar3d, {"rows": 257}, "rows = 257"),
        (Lidar3d, {"columns": 1}, "columns = 1"),
        (Lidar3d, {"vertical_fov_rad": 3.2}, "vertical_fov_rad = 3.2"),
        (Lidar3d, {"min_range_m": 9.0, "max_range_m": 2.0}, "9 m to 2 m"),
        (Lidar3d, {"beams": 361}, "beams = 361"),
        (WheelOdometry, {"scale": 0.0}, "scale = 0.0"),
        (WheelOdometry, {"drift_rad_per_m": float("nan")}, "drift_rad_per_m = nan"),
        (WheelOdometry, {"sigma_m_per_sqrt_m": -0.1}, "sigma_m_per_sqrt_m = -0.1"),
        (WheelOdometry, {"slips_per_m": -0.1}, "slips_per_m = -0.1"),
        (PathFollower, {"speed_m_s": 0.0}, "speed_m_s = 0.0"),
        (PathFollower, {"look_ahead_m": 0.1}, "look_ahead_m = 0.1"),
        (Robot, {"scan_period_s": 0.0}, "scan_period_s = 0.0"),
        (Robot, {"drop_share": 1.1}, "drop_share = 1.1"),
        (Robot, {"drop_share": -0.1}, "drop_share = -0.1"),
        (Robot, {"sensor": 3}, "sensor"),
    ],
)
def test_value_out_of_range_is_refused_by_name(
    part: Callable[..., object], values: dict[str, Any], named: str
) -> None:
    with pytest.raises(InvalidInput, match=named):
        part(**values)


def test_replaced_value_is_checked_too() -> None:
    with pytest.raises(InvalidInput, match="drop_share = 2"):
        replace(INDOOR_LASER, drop_share=2.0)


def test_limits_themselves_are_allowed() -> None:
    assert Laser2d(beams=2, field_of_view_rad=6.283185307179586, range_sigma_m=0.0).rays == 2
    assert Lidar3d(rows=256, columns=2048).rays == 256 * 2048
    assert replace(INDOOR_LASER, drop_share=1.0).drop_share == 1.0


def test_declared_values_cannot_be_changed() -> None:
    with pytest.raises(FrozenInstanceError):
        LIDAR.scan_period_s = 1.0  # type: ignore[misc]


def test_robot_is_a_plain_tree_of_numbers() -> None:
    declared = asdict(LIDAR)
    assert declared["sensor"]["rows"] == 16
    assert declared["odometry"]["scale"] == 1.01
    assert (
        Robot(
            PathFollower(**declared["follower"]),
            Lidar3d(**declared["sensor"]),
            WheelOdometry(**declared["odometry"]),
        )
        == LIDAR
    )
