"""Trajectories as TUM files: lines `stamp x y z qx qy qz qw`.

References:
    Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012 (the format).
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from hmt_service.core.geometry import FloatArray, pose_of, quaternion_of
from hmt_service.core.types import StampedPose
from hmt_service.errors import InvalidInput
from hmt_service.io.rows import read_rows

_COLUMNS = 8


def write_tum(path: Path, trajectory: Iterable[StampedPose]) -> None:
    """Write a trajectory; equal poses give equal bytes."""
    path.write_bytes("".join(map(tum_line, trajectory)).encode())


def read_tum(path: Path) -> tuple[StampedPose, ...]:
    """Read a trajectory in the order of the file; empty lines and comments (`#`) are left out.

    Raises:
        NotFound: If the file cannot be opened.
        InvalidInput: If a line does not hold a stamp, a position and a rotation.
    """
    return tuple(_pose(place, row) for place, row in read_rows(path, columns=_COLUMNS))


def tum_line(pose: StampedPose) -> str:
    """Return one line of such a file."""
    translation_m = pose.reference_from_body[:3, 3]
    values = np.concatenate([translation_m, quaternion_of(pose.reference_from_body)])
    # z: a zero has no sign.
    return f"{pose.stamp_s:.6f} {' '.join(f'{value:z.9f}' for value in values)}\n"


def _pose(place: str, row: FloatArray) -> StampedPose:
    try:
        return StampedPose(float(row[0]), pose_of(row[4:], row[1:4]))
    except InvalidInput as error:
        raise InvalidInput(f"{place}: {error}") from error
