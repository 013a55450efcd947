"""The submaps of all areas as one point cloud: binary PLY or PCD of float32.

Written here: both are a head of text before the numbers as they are in memory, and Open3D, which
writes them too, takes seconds to load and needs libraries that a robot's computer may not have.

References:
    http://paulbourke.net/dataformats/ply;
    https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

from pathlib import Path

from hmt_service import __version__
from hmt_service.io.placed_map import PlacedMap
from hmt_service.io.whole_files import whole_files

_PLY = """ply
format binary_little_endian 1.0
comment hmt-service {version}, frame of area {area}, m
element vertex {count}
property float x
property float y
property float z
end_header
"""
_PCD = """# .PCD v0.7 - hmt-service {version}, frame of area {area}, m
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH {count}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {count}
DATA binary
"""


def export_ply(placed: PlacedMap, path: Path) -> None:
    """Write all points as PLY."""
    _write(placed, path, _PLY)


def export_pcd(placed: PlacedMap, path: Path) -> None:
    """Write all points as PCD."""
    _write(placed, path, _PCD)


def _write(placed: PlacedMap, path: Path, head: str) -> None:
    points = placed.points()
    text = head.format(version=__version__, area=placed.reference_area, count=len(points))
    with whole_files(path) as (part,):
        part.write_bytes(text.encode() + points.astype("<f4").tobytes())
