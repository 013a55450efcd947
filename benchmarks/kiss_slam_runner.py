"""KISS-SLAM in a process of its own: run by the Python of an environment that has it.

Our package is not there, so nothing here may import it. What is done with each scan and at the end
is what KISS-SLAM's own pipeline does, with its default settings, without its pictures and files.

References:
    Guadagnino et al., KISS-SLAM, IROS 2025; `kiss_slam.pipeline.SlamPipeline` 0.0.2.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import psutil

from benchmarks.handover import SweepRecord, read_records


def map_scans(readings: Path, result: Path) -> None:
    """Map the scans of a file that `handover` has written, and leave poses and costs in another.

    Args:
        readings: The scans; odometry between them is passed over: KISS-SLAM takes none.
        result: File to write.
    """
    # Only where this runs as a program.
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    slam, process, watch = KissSLAM(load_config(None)), psutil.Process(), _Watch()
    empty_bytes = process.memory_info().rss
    stamps_s: list[float] = []
    memory_bytes: list[int] = []
    for record in read_records(readings):
        if not isinstance(record, SweepRecord):
            continue
        times = np.zeros(0) if record.times is None else record.times
        with watch:
            slam.process_scan(record.points, times)
        stamps_s.append(record.stamp_s)
        memory_bytes.append(process.memory_info().rss)
    with watch:
        slam.generate_new_node()
        slam.local_map_graph.erase_last_local_map()
        poses, _ = slam.fine_grained_optimization()
    np.savez(
        result,
        busy_s=watch.busy_s,
        cpu_s=watch.cpu_s,
        empty_bytes=empty_bytes,
        memory_bytes=np.array(memory_bytes, dtype=np.float64),
        stamps_s=np.array(stamps_s),
        poses=np.array(poses),
        loop_closures=len(slam.closures),
    )


class _Watch:
    """Adds up the time inside its blocks."""

    def __init__(self) -> None:
        self.busy_s = self.cpu_s = 0.0

    def __enter__(self) -> None:
        self.busy_s -= time.perf_counter()
        self.cpu_s -= time.process_time()

    def __exit__(self, *_: object) -> None:
        self.busy_s += time.perf_counter()
        self.cpu_s += time.process_time()


if __name__ == "__main__":
    map_scans(Path(sys.argv[1]), Path(sys.argv[2]))
