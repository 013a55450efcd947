"""Where the topics of ROS 2 are on Zenoh, for who sends them without knowing of us.

| sender | key |
|---|---|
| rmw_zenoh | `{domain}/{topic}/{type}/{hash of its definition}` |
| zenoh-bridge-ros2dds | `{namespace of the bridge}/{topic}` |

Topics are without the slash that they begin with. Both send CDR; only the first one's key says of
what, so whoever names a topic says it.

References:
    ros2/rmw_zenoh, docs/design.md; eclipse-zenoh/zenoh-plugin-ros2dds, README.md; ROS 2 design,
    topic and service names; REP 2016 (hashes).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from hmt_service.core.geometry import Pose
from hmt_service.errors import InvalidInput
from hmt_service.io.ros_messages import SCAN_TYPES, RosType, type_hash
from hmt_service.service.keys import Input

CDR_PREFIX = "application/cdr;"
"""Begins the encoding of a message of ROS 2; its type follows."""
_HASH_PREFIX = "RIHS01_"
_TOPIC = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MAX_DOMAIN = 232


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Ros2Input:
    """What to take from ROS 2."""

    topics: Mapping[RosType, str] = field(default_factory=dict)
    """Fully qualified name of the topic of each type, with or without the slash before it."""
    domain: int = 0
    """`ROS_DOMAIN_ID` of the robot."""
    body_from_sensor: Pose | None = None
    """Pose of the sensor on the body, shape (4, 4); None for scans in the body's own frame."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            InvalidInput: If a topic is none of ROS 2 or named twice, the domain is none, or there
                is a pose but no scan that it could be of.
        """
        for topic in self.topics.values():
            if not _TOPIC.fullmatch(topic):
                raise InvalidInput(f"{topic!r} is no name of a ROS 2 topic, such as /scan")
        counts = Counter(topic.removeprefix("/") for topic in self.topics.values())
        for topic, count in counts.items():
            if count > 1:
                raise InvalidInput(f"topic {topic} has {count} types")
        if not 0 <= self.domain <= _MAX_DOMAIN:
            raise InvalidInput(f"ROS domain {self.domain} is not in 0..{_MAX_DOMAIN}")
        if self.body_from_sensor is not None and not self.topics.keys() & SCAN_TYPES:
            raise InvalidInput("there is a pose of the sensor, but no topic of scans of ROS 2")

    def keys(self) -> dict[str, RosType]:
        """Return the key expressions to subscribe to, and what comes under each."""
        keys = {}
        for kind, name in self.topics.items():
            topic = name.removeprefix("/")
            keys[topic] = kind
            # Any hash: some senders have none to say.
            keys[f"{self.domain}/{topic}/{_dds_name(kind)}/*"] = kind
        return keys


def input_of(kind: RosType) -> Input:
    """Return what a message counts as."""
    return Input.SCAN if kind in SCAN_TYPES else Input.ODOMETRY


def encoding_under(key: str, kind: RosType) -> str:
    """Return the encoding of a sample that came under a key of `Ros2Input.keys`.

    A sender who defines the message otherwise says so in the key: its hash is part of the encoding
    then, which nobody decodes.
    """
    digest = key.rpartition("/")[2]
    is_other = digest.startswith(_HASH_PREFIX) and digest != type_hash(kind)
    return f"{CDR_PREFIX}{kind}{f'/{digest}' if is_other else ''}"


def _dds_name(kind: RosType) -> str:
    package, middle, name = kind.split("/")
    return f"{package}::{middle}::dds_::{name}_"
