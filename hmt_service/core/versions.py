"""Versions of submaps: who has the points of an area need not be sent them again.

A version is made of the points alone, so that it is the same in another hypothesis, in another
session with the map, and when a change of the map is undone.

References:
    own; BLAKE2 (RFC 7693).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from hmt_service.core.types import Points

NOTHING_KNOWN: Mapping[int, int] = MappingProxyType({})
"""Versions of the submaps, by area, that somebody has who has none."""
# Programs that hold numbers in double precision must be able to say what they have.
_VERSION_BYTES = 6


def version_of(points: Points) -> int:
    """Return the version of a submap, in [1, 2^48).

    Args:
        points: Its points, shape (N, 3), m.
    """
    digest = hashlib.blake2b(points.tobytes(), digest_size=_VERSION_BYTES).digest()
    return max(1, int.from_bytes(digest, "little"))


def recipe_of(parts: Iterable[bytes]) -> bytes:
    """Return a digest of what a submap is put together from."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        digest.update(part)
    return digest.digest()
