"""Values as JSON, in the words of the wire.

References: own.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from hmt_service.core.geometry import GaussianPose, quaternion_of


def to_json(value: object) -> str:
    """Return a value of the core or the service as one JSON object; arrays become lists."""
    return json.dumps(_plain(value), allow_nan=False)


def _plain(value: object) -> Any:
    if isinstance(value, GaussianPose):
        numbers = [*value.mean[:3, 3].tolist(), *quaternion_of(value.mean).tolist()]
        names = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
        return {
            **dict(zip(names, numbers, strict=True)),
            "covariance": value.covariance.ravel().tolist(),
        }
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value
