"""Files that hold one scan each: PCD, PLY, and the raw floats of the KITTI benchmark.

References:
    Geiger et al., Are we ready for autonomous driving?, CVPR 2012 (layout of `velodyne/*.bin`);
    https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hmt_service.core.geometry import FloatArray
from hmt_service.errors import InvalidLog, Unavailable
from hmt_service.io.decoding import TIME_FIELDS

Cloud = tuple[FloatArray, npt.NDArray[Any] | None]
"""Points as they are in a file, shape (N, 3), and the capture time of each, shape (N,), or None."""
_FLOATS_PER_POINT = 4  # x, y, z, reflectance


def read_scan_file(path: Path) -> Cloud:
    """Return the points of a file, in the format that its name says, one of `SUFFIXES`.

    Raises:
        InvalidLog: If it cannot be read, or not to its end.
        Unavailable: If the library that reads it does not load.
    """
    try:
        return _READERS[path.suffix.lower()](path)
    except OSError as error:
        raise InvalidLog(f"cannot be read: {error.strerror or error}") from error


def _bin(path: Path) -> Cloud:
    content = path.read_bytes()
    size = _FLOATS_PER_POINT * 4
    if len(content) % size:
        raise InvalidLog(
            f"{len(content)} bytes are no multiple of {size}: x, y, z, reflectance, 32-bit floats"
        )
    rows = np.frombuffer(content, dtype="<f4").reshape(-1, _FLOATS_PER_POINT)
    return _as_floats([rows[:, axis] for axis in range(3)]), None


def _ply(path: Path) -> Cloud:
    from plyfile import PlyData, PlyParseError

    try:
        rows = PlyData.read(path)["vertex"].data
    # A file without vertices, and one of a negative number of them.
    except (PlyParseError, KeyError, ValueError) as error:
        raise InvalidLog(f"is no whole PLY file: {error}") from error
    names = [name for name in rows.dtype.names or () if rows.dtype[name].kind in "iuf"]
    if not {"x", "y", "z"} <= set(names):
        raise InvalidLog(f"has no x, y and z, but {', '.join(names) or 'nothing'}")
    times = next((np.array(rows[name]) for name in TIME_FIELDS if name in names), None)
    return _as_floats([rows[axis] for axis in "xyz"]), times


def _pcd(path: Path) -> Cloud:
    _check_lines(path)
    # When it is first needed: it takes 2 s to load.
    try:
        import open3d as o3d
    except (ImportError, OSError) as error:
        raise Unavailable(f"PCD files need Open3D, which does not load: {error}") from error
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            cloud = o3d.t.io.read_point_cloud(str(path), format="pcd").point
        except RuntimeError as error:
            raise InvalidLog(f"is no whole PCD file: {error}") from error
    if "positions" not in cloud:
        raise InvalidLog("is no whole PCD file with x, y and z")
    points = cloud["positions"].numpy()
    times = next((cloud[name].numpy().reshape(-1) for name in TIME_FIELDS if name in cloud), None)
    return _as_floats([points[:, axis] for axis in range(3)]), times


def _check_lines(path: Path) -> None:
    """Check that a PCD file of text holds all points that it announces.

    Open3D leaves what is missing as it was in memory.

    Raises:
        InvalidLog: If it does not.
    """
    numbers, points = 0, 0
    with path.open("rb") as file:
        for line in file:
            name, *words = line.split() or [b""]
            if name == b"FIELDS":
                numbers = len(words)
            elif name == b"COUNT" and all(word.isdigit() for word in words):
                numbers = sum(map(int, words))
            elif name == b"POINTS" and words and words[0].isdigit():
                points = int(words[0])
            elif name == b"DATA":
                break
        else:
            raise InvalidLog("is no PCD file: no line begins with DATA")
        if words != [b"ascii"]:
            return
        whole = sum(len(line.split()) >= numbers for line in file)
    if whole < points:
        raise InvalidLog(f"ends early: {whole} of {points} points")


def _as_floats(axes: list[npt.NDArray[Any]]) -> FloatArray:
    # Huge numbers, and NaN that signal.
    with np.errstate(over="ignore", invalid="ignore"):
        return np.stack([axis.astype(np.float64) for axis in axes], axis=1)


_READERS: dict[str, Callable[[Path], Cloud]] = {".bin": _bin, ".pcd": _pcd, ".ply": _ply}
SUFFIXES = frozenset(_READERS)
"""Ends of the names of files that hold a scan."""
