"""Simulated drives as the benchmarks take them.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from hmt_service.core.types import Reading, StampedPose
from hmt_service.sim.simulation import Instant


def readings_of(instants: Iterable[Instant], truth: list[StampedPose]) -> Iterator[Reading]:
    """Yield what the robot sends, and note where it is.

    Args:
        instants: The drive.
        truth: Gets the true pose of every instant.
    """
    for instant in instants:
        truth.append(instant.truth)
        yield from instant.readings
