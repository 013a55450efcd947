"""Which module writes which format.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from hmt_service.errors import InvalidInput
from hmt_service.io.exporters.clouds import export_pcd, export_ply
from hmt_service.io.exporters.formats import Format
from hmt_service.io.exporters.g2o import export_g2o
from hmt_service.io.exporters.mcap import export_mcap
from hmt_service.io.exporters.rerun import export_rerun
from hmt_service.io.exporters.ros_map import export_ros_map
from hmt_service.io.exporters.trajectories import export_kitti, export_tum
from hmt_service.io.map_file import read_map
from hmt_service.io.placed_map import PlacedMap

_EXPORTERS: Mapping[Format, Callable[[PlacedMap, Path], None]] = {
    Format.TUM: export_tum,
    Format.KITTI: export_kitti,
    Format.G2O: export_g2o,
    Format.PLY: export_ply,
    Format.PCD: export_pcd,
    Format.ROS_MAP: export_ros_map,
    Format.MCAP: export_mcap,
    Format.RRD: export_rerun,
}
_WITHOUT_POINTS = frozenset({Format.TUM, Format.KITTI, Format.G2O})


def export_map(
    source: Path,
    target: Path,
    form: Format,
    *,
    hypothesis: int | None = None,
    reference_area: int | None = None,
) -> PlacedMap:
    """Write a map file in the format of another program.

    Args:
        source: Map file; never changed.
        target: File to write; it appears as a whole, or not at all.
        form: The format.
        hypothesis: Identifier; None for the most probable one.
        reference_area: Area whose frame everything is in; None for the first one.

    Returns:
        What was written.

    Raises:
        NotFound: If there is no such file, folder, hypothesis or area.
        InvalidInput: If the map is damaged or the format cannot hold it, or both files are one.
        Unavailable: If the map is empty or the file system refuses.
    """
    if target.exists() and source.exists() and target.samefile(source):
        raise InvalidInput(f"{target} is the map itself, which would be lost")
    stored = read_map(source, with_points=form not in _WITHOUT_POINTS)
    placed = PlacedMap.of(stored, hypothesis=hypothesis, reference_area=reference_area)
    _EXPORTERS[form](placed, target)
    return placed
