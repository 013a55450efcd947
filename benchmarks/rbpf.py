"""Global metric mapping by a Rao-Blackwellized particle filter: MRPT's `rbpf-slam`, run as it is.

Every particle of it carries a grid map of the whole environment: the method that the paper compares
its own with in Table II. The program reads a binary log of its own, pairs of an action (odometry)
and observations (one scan). `carmen2rawlog` writes observations without actions, on which
`rbpf-slam` 2.5 dies, and loses their stamps; so the log is written here, from the readings that our
own chain gets, return for return.

References:
    Blanco et al. 2008, section VI and Table II.
    Grisetti et al., Improved techniques for grid mapping with Rao-Blackwellized particle filters,
    T-RO 2007 (scan matching as proposal).
    MRPT 2.5: `CSerializable` (format of the log), `share/mrpt/config_files/rbpf-slam` (settings).
"""

from __future__ import annotations

import math
import shutil
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.processes import ChildFailed, ChildRun, MemorySample, run_child
from hmt_service.core.geometry import FloatArray, Pose, identity, inverse, planar_pose, yaw_of
from hmt_service.core.types import OdometryReading, Reading, Scan, StampedPose
from hmt_service.errors import InvalidInput

_PROGRAM = "rbpf-slam"
_OUTPUT = "output"
_TICKS_PER_S = 10_000_000
_S_FROM_1601_TO_1970 = 11_644_473_600
# MRPT's default: Gaussian noise in m/m, m/rad, rad/m, rad/rad, m and rad.
_MOTION_MODEL = (0.01, 0.0573, 0.01745, 0.05, 0.01, 0.00349)
_RANGE_SIGMA_M = 0.01
_LEAST_STEP_RAD = 1e-4
_BLIND_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class Beams:
    """The directions that a planar laser looks in, seen from above, to the left of straight on."""

    first_rad: float
    """Direction of the first beam."""
    step_rad: float
    """From beam to beam."""
    count: int
    """How many."""

    @property
    def aperture_rad(self) -> float:
        """From the first beam to the last one."""
        return (self.count - 1) * self.step_rad

    def ranges(self, scan: Scan) -> FloatArray:
        """Return the range along each beam, shape (count,), m; 0 where there is no return."""
        rays = scan.points_in_body - scan.sensor_in_body
        beams = np.rint((_directions(scan) - self.first_rad) / self.step_rad).astype(int)
        ranges = np.full(self.count, math.inf)
        np.minimum.at(ranges, beams, np.hypot(rays[:, 0], rays[:, 1]))
        return np.where(np.isfinite(ranges), ranges, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class RbpfRun:
    """What `rbpf-slam` did with one log."""

    cpu_s: float
    """Processor time, without what the program takes to start."""
    empty_bytes: float
    """Resident memory with an empty map."""
    memory_bytes: FloatArray
    """Resident memory after each scan, shape (scans,)."""
    trajectory: tuple[StampedPose, ...]
    """Mean of the particles after each scan."""
    samples: tuple[MemorySample, ...]
    """The memory as seen from outside."""


_NO_BEAMS = Beams(-0.5 * math.pi, math.pi / 180, 181)
_BLIND = Scan(0.0, np.zeros((0, 3)), np.zeros(3))
_SETTINGS = """\
[MappingApplication]
rawlog_offset = 0
logOutput_dir = {output}
LOG_FREQUENCY = 0
SHOW_PROGRESS_IN_WINDOW = 0
RANDOM_SEED = 1
verbosity = LVL_WARN
verbosity_level = WARN

localizeLinDistance = 0.2
localizeAngDistance_deg = 10.0
insertionLinDistance = 2.0
insertionAngDistance_deg = 30.0

PF_algorithm = 2
adaptiveSampleSize = 0
resamplingMethod = 0
sampleSize = 10
BETA = 0.5
pfOptimalProposal_mapSelection = 3
pfAuxFilterOptimal_MaximumSearchSamples = 250

ICPGlobalAlign_MinQuality = 0.8
ICP_algorithm = 1
maxIterations = 60
thresholdDist = 1.0
thresholdAng_DEG = 5
ALFA = 0.5
smallestThresholdDist = 0.1
onlyClosestCorrespondences = 1

occupancyGrid_count = 1
gasGrid_count = 0
landmarksMap_count = 0
beaconMap_count = 0
pointsMap_count = 1
likelihoodMapSelection = 1

[MappingApplication_pointsMap_00_insertOpts]
minDistBetweenLaserPoints = 0.05
fuseWithExisting = 0
isPlanarMap = 1

[MappingApplication_pointsMap_00_likelihoodOpts]
max_corr_distance = 5.0
sigma_dist = 0.05

[MappingApplication_occupancyGrid_00_creationOpts]
resolution = 0.1

[MappingApplication_occupancyGrid_00_insertOpts]
mapAltitude = 0
useMapAltitude = 0
maxDistanceInsertion = 35
maxOccupancyUpdateCertainty = 0.6
considerInvalidRangesAsFreeSpace = 0
minLaserScanNoiseStd = 0.001
wideningBeamsWithDistance = 0
"""


def find_rbpf() -> Path | None:
    """Return the program, or None where it is not installed."""
    found = shutil.which(_PROGRAM)
    return None if found is None else Path(found)


def run_rbpf(
    program: Path, readings: Sequence[Reading], folder: Path, *, timeout_s: float
) -> RbpfRun:
    """Map a log.

    Args:
        program: What `find_rbpf` returns.
        readings: Planar scans and odometry, in the order of time.
        folder: Where to leave the log, the settings and what the program writes.
        timeout_s: Longest that it may take.

    Raises:
        InvalidInput: If there is no scan.
        ChildFailed: If the program fails, takes longer or does not report on every scan.
    """
    blind, log = folder / "blind", folder / "log"
    # With a scan that sees nothing, the map is empty and everything else is there.
    _, start = _execute(program, [_BLIND], blind, timeout_s=_BLIND_TIMEOUT_S)
    scans, child = _execute(program, readings, log, timeout_s=timeout_s)
    return RbpfRun(
        cpu_s=child.cpu_s - start.cpu_s,
        empty_bytes=float(read_memory(blind, 1)[0]),
        memory_bytes=read_memory(log, scans),
        trajectory=read_path(log, scans),
        samples=child.samples,
    )


def _execute(
    program: Path, readings: Sequence[Reading], folder: Path, *, timeout_s: float
) -> tuple[int, ChildRun]:
    """Run the program once, and return the number of scans that it was given."""
    folder.mkdir()
    log, settings = folder / "log.rawlog", folder / "rbpf-slam.ini"
    scans = write_rawlog(readings, log)
    settings.write_text(configuration(folder / _OUTPUT))
    return scans, run_child([program, settings, log], timeout_s=timeout_s)


def configuration(output: Path) -> str:
    """Return the settings of a run.

    They are those that MRPT ships for the Intel log (`gridmapping_RBPF_ICPbased_intel.ini`): 10
    particles, scans matched with the points of each particle, one every 0.2 m or 10 degrees. What
    differs: each particle also carries the grid map that the paper compares with, of cells of 0.1 m
    (0.12 m there) and with MRPT's settings for the paper's own log; a beam without return says
    nothing, as in our chain; the random seed is fixed; no window, and no pictures on the way.

    Args:
        output: Folder that the program makes.
    """
    return _SETTINGS.format(output=output)


def read_memory(folder: Path, scans: int) -> FloatArray:
    """Return the resident memory of the program after each scan, byte.

    Args:
        folder: Folder of the run.
        scans: How many scans the program was given.

    Raises:
        ChildFailed: If the program does not say so for every scan.
    """
    return _rows(folder, "log_MemoryUsage.txt", scans, columns=2)[:, 1]


def read_path(folder: Path, scans: int) -> tuple[StampedPose, ...]:
    """Return the mean of the particles after each scan; see `read_memory`."""
    rows = _rows(folder, "log_estimated_path.txt", scans, columns=8).tolist()
    return tuple(StampedPose(row[7], planar_pose(row[1], row[2], row[4])) for row in rows)


def _rows(folder: Path, name: str, rows: int, *, columns: int) -> FloatArray:
    try:
        table = np.loadtxt(folder / _OUTPUT / name, comments="%", ndmin=2)
    except (OSError, ValueError) as error:
        raise ChildFailed(f"{_PROGRAM} has not written {name}: {error}") from error
    if table.shape != (rows, columns):
        raise ChildFailed(f"{name} of {_PROGRAM} is {table.shape}, not {(rows, columns)}")
    return table


def beams_of(readings: Iterable[Reading]) -> Beams:
    """Return the beams of the laser that has taken some scans.

    They must be its own: in a finer grid, with every second beam empty, the program finds nothing
    to match.

    Args:
        readings: Planar scans, and anything else.
    """
    directions = [_directions(reading) for reading in readings if isinstance(reading, Scan)]
    steps = np.concatenate([np.diff(np.sort(each)) for each in directions])
    steps = steps[steps > _LEAST_STEP_RAD]
    if not len(steps):
        return _NO_BEAMS
    seen = np.concatenate(directions)
    first, step = float(seen.min()), float(steps.min())
    return Beams(first, step, round((float(seen.max()) - first) / step) + 1)


def _directions(scan: Scan) -> FloatArray:
    rays = scan.points_in_body - scan.sensor_in_body
    return np.asarray(np.arctan2(rays[:, 1], rays[:, 0]))


def write_rawlog(readings: Sequence[Reading], path: Path) -> int:
    """Write the scans, each with the odometry since the scan before it.

    Args:
        readings: Planar scans and odometry, in the order of time.
        path: File to write.

    Returns:
        Number of scans.

    Raises:
        InvalidInput: If there is no scan.
    """
    scans = [reading for reading in readings if isinstance(reading, Scan)]
    if not scans:
        raise InvalidInput(f"no scan to write to {path.name}")
    with path.open("wb") as file:
        file.writelines(_pairs(readings, beams_of(scans)))
    return len(scans)


def _pairs(readings: Iterable[Reading], beams: Beams) -> Iterator[bytes]:
    before: Pose | None = None
    now = identity()
    for reading in readings:
        if isinstance(reading, OdometryReading):
            now = reading.odom_from_body
            continue
        motion = identity() if before is None else inverse(before) @ now
        before = now
        yield _action(reading.stamp_s, motion) + _frame(reading, beams)


def _action(stamp_s: float, motion: Pose) -> bytes:
    movement = (
        struct.pack("<I", 0)  # from odometry
        + _object("CPose2D", 1, struct.pack("<3d", motion[0, 3], motion[1, 3], yaw_of(motion)))
        + struct.pack("<I6f", 0, *_MOTION_MODEL)  # the Gaussian model
        + struct.pack("<I6f", 0, *[0.0] * 6)  # the model of samples, not used
        + struct.pack("<?2f?2i", False, 0.0, 0.0, False, 0, 0)  # no velocities, no encoders
        + struct.pack("<Q", _ticks(stamp_s))
    )
    inner = _object("CActionRobotMovement2D", 6, movement)
    return _object("CActionCollection", 0, struct.pack("<I", 1) + inner)


def _frame(scan: Scan, beams: Beams) -> bytes:
    ranges = beams.ranges(scan)
    # Its scans are symmetric around straight on, which the pose of the sensor turns.
    body_from_sensor = planar_pose(0.0, 0.0, beams.first_rad + 0.5 * beams.aperture_rad)
    sensor = np.concatenate([scan.sensor_in_body, body_from_sensor[:3, :3].ravel()])
    observation = (
        struct.pack("<f?f", beams.aperture_rad, True, ranges.max() + 1.0)  # longest range
        + _object("CPose3D", 3, sensor.astype("<f8").tobytes())
        + struct.pack("<I", beams.count)
        + ranges.astype("<f4").tobytes()
        + (ranges > 0.0).tobytes()
        + struct.pack("<fQf", _RANGE_SIGMA_M, _ticks(scan.stamp_s), beams.step_rad)
        + struct.pack("<Id?", 0, 0.0, False)  # no label, no pitch, no intensities
    )
    inner = _object("CObservation2DRangeScan", 7, observation)
    return _object("CSensoryFrame", 2, struct.pack("<I", 1) + inner)


def _object(name: str, version: int, body: bytes) -> bytes:
    return bytes([0x80 | len(name)]) + name.encode() + bytes([version]) + body + b"\x88"


def _ticks(stamp_s: float) -> int:
    return round((stamp_s + _S_FROM_1601_TO_1970) * _TICKS_PER_S)
