"""How many hypotheses live, and what memory one more takes, counted by the allocator.

`take_census` runs this module as a program, in which all memory comes from the C library and what
is freed is free at once. It maps the readings twice, which gives the same map: to find out when the
most hypotheses live, and to be there when all but the best are dropped. What that frees is what no
other shares: Python objects, arrays and gtsam's trees alike.

References:
    mallinfo(3) of the GNU C library, the only one that this works with.
"""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.chain import read_readings
from benchmarks.processes import run_child
from hmt_service.core.config import Config
from hmt_service.core.engine import Engine
from hmt_service.core.odometry import Odometry

_ROOT = Path(__file__).parents[1]
# Neither Python's own pools nor blocks that the C library holds back for the next request.
_ENVIRONMENT = {"PYTHONMALLOC": "malloc", "GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}


@dataclass(frozen=True, slots=True, eq=False)
class Census:
    """The hypotheses of one log."""

    alive: npt.NDArray[np.int64]
    """How many live after each scan, shape (scans,)."""
    bytes_per_extra: float | None
    """Memory of each but the best, the last time that the most live; None if two never do."""


class _MallocInfo(ctypes.Structure):
    """`struct mallinfo2`."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    ]


def take_census(readings: Path, config: Config, folder: Path, *, timeout_s: float) -> Census:
    """Map the readings of a file in a process of its own, and count its hypotheses.

    Args:
        readings: File that `chain.write_readings` has written.
        config: Settings of all stages.
        folder: Where the process may leave its result.
        timeout_s: Longest that it may take.

    Raises:
        ChildFailed: If it fails or takes longer.
    """
    result = folder / "census.npz"
    arguments = [str(readings.resolve()), str(result.resolve()), config.model_dump_json()]
    run_child(
        [sys.executable, "-m", __name__, *arguments],
        timeout_s=timeout_s,
        folder=_ROOT,
        environment=_ENVIRONMENT,
    )
    with np.load(result) as arrays:
        extra = float(arrays["bytes_per_extra"])
        return Census(arrays["alive"], None if np.isnan(extra) else extra)


def _mapped(readings: Path, config: Config) -> Iterator[Engine]:
    """Yield the same engine after each scan."""
    odometry, engine = Odometry(config), Engine(config)
    for reading in read_readings(readings):
        tracking = odometry.process(reading)
        if tracking is not None:
            engine.process(tracking)
            yield engine


def _bytes_per_extra(engine: Engine) -> float:
    """Drop all hypotheses but the best, and return what that frees for each of them."""
    particles = engine._particles
    extra = len(particles.hypotheses) - 1
    gc.collect()
    before = _bytes_in_use()
    particles.replace([particles.best])
    gc.collect()
    return (before - _bytes_in_use()) / extra


def _bytes_in_use() -> int:
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = _MallocInfo
    info = mallinfo2()
    return int(info.uordblks + info.hblkhd)


def _main(readings: str, result: str, config: str) -> None:
    path, settings = Path(readings), Config.model_validate_json(config)
    alive = np.array([len(engine._particles.hypotheses) for engine in _mapped(path, settings)])
    # Copies are made on the first write: hypotheses that have just branched share nearly all.
    last = int(np.flatnonzero(alive == alive.max())[-1])
    has_extra = alive[last] > 1
    engine = next(islice(_mapped(path, settings), last, None)) if has_extra else None
    freed = float("nan") if engine is None else _bytes_per_extra(engine)
    np.savez(result, alive=alive, bytes_per_extra=freed)


if __name__ == "__main__":
    _main(*sys.argv[1:])
