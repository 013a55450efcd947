"""The formats that maps are written in; loads nothing, so that `hmt --help` may name them.

References:
    own.
"""

from __future__ import annotations

from enum import StrEnum


class Format(StrEnum):
    """What other programs read."""

    TUM = "tum"
    """Trajectory of all scans, with stamps."""
    KITTI = "kitti"
    """Trajectory of all scans, as matrices."""
    G2O = "g2o"
    """Pose graph: visits and what was measured between them."""
    PLY = "ply"
    """All submaps as one cloud."""
    PCD = "pcd"
    """All submaps as one cloud."""
    ROS_MAP = "ros-map"
    """Occupancy grid for map_server; planar maps only."""
    MCAP = "mcap"
    """Areas and trajectory, for Foxglove."""
    RRD = "rrd"
    """Areas, arcs, trajectory and topology, for Rerun."""
