"""The RPC table: what every call is for, which parameters it takes, and which message answers it.

The gateway refuses parameters that are not here, and the reference (docs/rpc.md) is made of it.

References:
    own; proto/hmt_service/service/v1/hmt.proto.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from hmt_service.service.keys import Call, Control, Topic
from hmt_service.service.questions import DEADLINE, PART_BYTES


@dataclass(frozen=True, slots=True)
class Rpc:
    """One call."""

    summary: str
    """What it is for, one sentence."""
    answer: str
    """Message of the package `hmt.v1` that answers it; `Error` may instead."""
    parameters: tuple[str, ...] = ()
    """Its parameters, of those in `PARAMETERS`, beside those of every call."""


GENERAL = (DEADLINE, PART_BYTES)
"""Parameters of every call."""
ARC = ("x", "y", "z", "qx", "qy", "qz", "qw", "sigma_m", "sigma_rad", "probability")
"""What somebody says of where one area is beside another."""
PARAMETERS: Mapping[str, str] = MappingProxyType(
    {
        DEADLINE: "s after which nobody waits for the answer any more, in (0, 600]; 8 without it",
        PART_BYTES: "size of the largest part that the answer may come in, 16384 to 1048576; "
        "without it the answer comes whole, and has 8 MB at most",
        "method": "`consistent` (without it) or `shortest_path`",
        "reference": "area whose frame the poses are in; the daemon chooses without it",
        "hypothesis": "which one; the most probable one without it",
        "points": "0: leave the submaps out",
        "known": "`AREA:VERSION,...`: submaps that the client has, and that are not sent again",
        "area": "which one",
        "from": "sensor time of the first scan, s; the first one without it",
        "to": "sensor time of the last scan, s; the last one without it",
        "map": "name of a map file in the folder of the daemon's",
        "statement": "identifier that `assert_arc` has answered",
        "area_a": "one area",
        "area_b": "another area",
        "x": "position of area_b in area_a, m",
        "y": "the same",
        "z": "the same",
        "qx": "attitude of area_b in area_a, a quaternion",
        "qy": "the same",
        "qz": "the same",
        "qw": "the same",
        "sigma_m": "standard deviation of the position along each axis, m, above 0",
        "sigma_rad": "standard deviation of the attitude about each axis, rad, above 0",
        "probability": "that it is right at all, in (0, 1)",
    }
)
"""What every parameter means."""
_FRAME = ("reference", "hypothesis")
RPCS: Mapping[Call | Control, Rpc] = MappingProxyType(
    {
        Call.STATUS: Rpc("The daemon's counters.", "Status"),
        Call.POSE: Rpc("Where the robot is.", "HmtPose"),
        Call.POSTERIOR: Rpc("The belief over topologies.", "Posterior"),
        Call.EVENTS: Rpc("The latest events, the oldest first.", "Events"),
        Call.HISTORY: Rpc("What was believed over time.", "History"),
        Call.HYPOTHESES: Rpc(
            "All topologies that the robot may have travelled, the most probable first.",
            "Hypotheses",
        ),
        Call.MAP: Rpc("A global map.", "GlobalMap", ("method", *_FRAME, "points", "known")),
        Call.AREAS: Rpc("The consistent map without points.", "GlobalMap", _FRAME),
        Call.AREA: Rpc(
            "One area with its visits, its submap and the arcs to its neighbours.",
            "AreaDetails",
            ("area", *_FRAME, "points", "known"),
        ),
        Call.TRAJECTORY: Rpc(
            "The globally consistent pose of every scan.",
            "Trajectory",
            ("from", "to", "hypothesis"),
        ),
        Call.COMPARE: Rpc(
            "How far the shortest-path map is from the consistent one.", "Comparison", _FRAME
        ),
        Control.FINISH: Rpc(
            "Wait until everything that was sent is in the map, smooth it, and save it.", "Ack"
        ),
        Control.SAVE: Rpc("Save the map as it is.", "Ack"),
        Control.RELOCALIZE: Rpc("The robot was carried: it may be anywhere in the map.", "Ack"),
        Control.LOAD: Rpc("Save the map, and go on with another one.", "Ack", ("map",)),
        Control.RESET: Rpc("Save the map under another name, and begin an empty one.", "Ack"),
        Control.ASSERT_ARC: Rpc(
            "Tell where one area is beside another.", "StatementEffect", ("area_a", "area_b", *ARC)
        ),
        Control.RETRACT_ARC: Rpc("Take back what was told.", "StatementEffect", ("statement",)),
        Control.SHUTDOWN: Rpc("Save the map, and end.", "Ack"),
    }
)
"""Every call."""
PUBLISHED: Mapping[Topic, str] = MappingProxyType(
    {Topic.POSE: "HmtPose", Topic.POSTERIOR: "Posterior", Topic.EVENT: "Event"}
)
"""Message of the package `hmt.v1` that each publication is."""
