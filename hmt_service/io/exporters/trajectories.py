"""The trajectory of all scans as TUM or KITTI file.

References:
    Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012 (TUM).
    Geiger et al., Are we ready for autonomous driving?, CVPR 2012 (KITTI: the upper three rows of
    the matrix, row by row; without stamps).
"""

from __future__ import annotations

from pathlib import Path

from hmt_service.io.placed_map import PlacedMap
from hmt_service.io.trajectory import write_tum
from hmt_service.io.whole_files import whole_files


def export_tum(placed: PlacedMap, path: Path) -> None:
    """Write lines `stamp x y z qx qy qz qw`."""
    with whole_files(path) as (part,):
        write_tum(part, placed.trajectory())


def export_kitti(placed: PlacedMap, path: Path) -> None:
    """Write lines of twelve numbers: `reference_from_body` of each scan."""
    rows = (pose.reference_from_body[:3].ravel() for pose in placed.trajectory())
    lines = (" ".join(f"{value:z.9f}" for value in row) for row in rows)
    with whole_files(path) as (part,):
        part.write_text("".join(f"{line}\n" for line in lines))
