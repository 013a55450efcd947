"""What is wrong with a recorded log, each with its numbers and the next step.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from hmt_service.core.config import Preset, load_config
from hmt_service.core.geometry import FloatArray
from hmt_service.core.plausibility import Fit
from hmt_service.io.decoding import Defect
from hmt_service.io.log_statistics import OdometryStatistics, ScanStatistics, Timing
from hmt_service.io.logs import Log
from hmt_service.io.malformed import Malformed
from hmt_service.io.streams import Says, Stream, Use

_LONG_GAP_S = 1.0
"""Without odometry, nothing is known of the motion in a longer one."""
_MOST_EMPTY_SHARE = 0.05
_MOST_FROZEN_SHARE = 0.5
_MOST_CONSTANT_SHARE = 0.05
_MOST_AT_MAX_SHARE = 0.02
_FARTHEST_MEDIAN_M = 150.0
_NEAREST_MEDIAN_M = 0.05
_MM = 1e-3
_CLOCKS_APART_S = 0.5
_COVERED_S = 1.0
_MOST_UNCOVERED_SHARE = 0.1
_STEP_SLACK_S = 1.0
"""The odometry allows stamps to be so wrong before it calls a step a jump."""
_NO_MOTION_M = 0.01
_LEAST_GROUND_SHARE = 0.25
_GROUND_RATIO = 4.0
_RAW_PACKETS = ("Packet", "VelodyneScan", "CustomMsg", "MultiEchoLaserScan")
_TRANSFORMS = "tf2_msgs/msg/TFMessage"


class Severity(StrEnum):
    """How bad it is."""

    ERROR = "error"
    """No map can be made."""
    WARNING = "warning"
    """The map may be worse for it, or be of less than the log could give."""
    NOTE = "note"
    """Worth knowing."""


class Trouble(StrEnum):
    """What may be wrong."""

    NOTHING_USABLE = "nothing_usable"
    MALFORMED = "malformed"
    STAMPS_BACKWARDS = "stamps_backwards"
    STAMPS_REPEATED = "stamps_repeated"
    GAPS = "gaps"
    SCANS_EMPTY = "scans_empty"
    SCANS_CONSTANT = "scans_constant"
    SCANS_FROZEN = "scans_frozen"
    NO_RETURN_AS_RANGE = "no_return_as_range"
    WRONG_UNIT = "wrong_unit"
    UPSIDE_DOWN = "upside_down"
    NO_POINT_TIMES = "no_point_times"
    NO_ODOMETRY = "no_odometry"
    ODOMETRY_STILL = "odometry_still"
    ODOMETRY_JUMPS = "odometry_jumps"
    CLOCKS_APART = "clocks_apart"
    NO_PRESET_FITS = "no_preset_fits"
    ASSUMED = "assumed"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is wrong with a log, or worth knowing."""

    severity: Severity
    """How bad it is."""
    trouble: Trouble
    """What it is."""
    message: str
    """What was seen, with its numbers."""
    advice: str
    """The next step."""


@dataclass(frozen=True, slots=True, eq=False)
class Facts:
    """What is known of a log that has usable scans."""

    log: Log
    """The log, opened."""
    streams: tuple[Stream, ...]
    """All that is in it."""
    malformed: tuple[Malformed, ...]
    """What should be a reading and is not."""
    scans: ScanStatistics
    """What its scans are like."""
    scan_stamps_s: Sequence[float]
    """Their stamps, in the order of the log."""
    odometry: OdometryStatistics | None
    """What its odometry is like."""
    odometry_stamps_s: Sequence[float]
    """Its stamps, in the order of the log."""
    fit: Fit | None
    """The preset for it; None if it sees nothing."""


def findings_of(facts: Facts) -> tuple[Finding, ...]:
    """Return what is wrong with a log, the worst first."""
    found = [
        *_malformed(facts),
        *_scans(facts),
        *_ranges(facts),
        *_upside_down(facts),
        *_stamps(facts),
        *_odometry(facts),
        *_clocks(facts),
        *(Finding(Severity.NOTE, Trouble.ASSUMED, *note) for note in facts.log.notes),
    ]
    return tuple(sorted(found, key=lambda finding: [*Severity].index(finding.severity)))


def nothing_usable(reason: str, streams: Sequence[Stream]) -> Finding:
    """Return what to say of a log without a usable scan."""
    raw = [stream for stream in streams if any(word in stream.kind for word in _RAW_PACKETS)]
    if any(stream.use in (Use.SCANS, Use.SCANS_AND_ODOMETRY) for stream in streams):
        advice = (
            "every message of scans is refused for the reason that is named: look at the driver"
        )
    elif raw:
        advice = (
            f"{raw[0].name} holds {raw[0].kind}, which is not read: record the PointCloud2 or "
            "LaserScan that its driver makes of it"
        )
    else:
        advice = "record the topic of the laser or LiDAR (LaserScan, PointCloud or PointCloud2)"
    return Finding(Severity.ERROR, Trouble.NOTHING_USABLE, reason, advice)


# ------------------------------------------------------------------ messages


def _malformed(facts: Facts) -> Iterator[Finding]:
    for each in facts.malformed:
        times = f", {each.count} times" if each.count > 1 else ""
        advice = _ADVICE.get(
            each.reason, "what is there is left out; if there is much of it, record again"
        )
        if each.reason == Defect.WRONG_FRAME and facts.odometry is None:
            advice = _frames_advice(facts)
        yield Finding(
            Severity.WARNING, Trouble.MALFORMED, f"{each.place}: {each.reason}{times}", advice
        )


def _frames_advice(facts: Facts) -> str:
    mounting = facts.log.mounting
    frames = f"scans are in '{mounting.scan_frame}', odometry is of '{mounting.body_frame}'"
    if mounting.says is Says.EVERY_SCAN:
        return f"{frames}: write scans in the frame of the body, with the pose of the sensor on it"
    return f"{frames}, and no tf_static joins them: say --sensor-pose X Y Z ROLL PITCH YAW"


_DRIVER = "look at the driver, or at what wrote the log"
_ADVICE: Mapping[str, str] = {
    Defect.NOT_PROTOBUF: "the messages are not what their schema says: record them again",
    Defect.NOT_ROS: "the messages are of another definition than ROS's own: record them again",
    Defect.WRONG_FRAME: "only scans of the first one's frame, and odometry of that body which does "
    "not jump (not in 'map'), are read: where there are several, record one",
    Defect.BAD_STAMP: "the driver sends no stamp, or none that is one: let it stamp what it sends",
    Defect.BAD_POSE: f"no rotation, or farther than any robot comes: {_DRIVER}",
    Defect.BAD_GEOMETRY: f"angles are in rad, points in 32 or 64-bit floats that fit: {_DRIVER}",
    Defect.EMPTY: "the sensor has sent nothing: is it switched on, and not covered?",
    Defect.NAN_RANGES: f"nothing but NaN; no return is +inf (REP 117): {_DRIVER}",
    Defect.NEGATIVE_RANGES: f"no return is +inf (REP 117), not negative: {_DRIVER}",
}


# ------------------------------------------------------------------ scans


def _scans(facts: Facts) -> Iterator[Finding]:
    scans = facts.scans
    if scans.empty > _MOST_EMPTY_SHARE * scans.scans:
        yield Finding(
            Severity.ERROR if scans.empty == scans.scans else Severity.WARNING,
            Trouble.SCANS_EMPTY,
            f"{scans.empty} of {scans.scans} scans have no return",
            "is the sensor covered, or does it write no return where there is one?",
        )
    if scans.constant > _MOST_CONSTANT_SHARE * scans.scans:
        yield Finding(
            Severity.ERROR if scans.constant > scans.scans // 2 else Severity.WARNING,
            Trouble.SCANS_CONSTANT,
            f"{scans.constant} of {scans.scans} scans have one range in all directions",
            f"a sensor that sees nothing should send +inf: {_DRIVER}",
        )
    elif scans.frozen > _MOST_FROZEN_SHARE * scans.scans:
        yield Finding(
            Severity.WARNING,
            Trouble.SCANS_FROZEN,
            f"{scans.frozen} of {scans.scans} scans repeat the one before, number by number",
            f"no sensor is so calm: {_DRIVER}",
        )
    if (
        facts.fit is not None
        and facts.fit.preset is not Preset.PLANAR
        and not scans.with_point_times
    ):
        yield Finding(
            Severity.NOTE,
            Trouble.NO_POINT_TIMES,
            "points have no times of their own: every sweep counts as taken at once",
            "fine where the motion is compensated already or slow; else record the driver's field "
            "of times (t, time, timestamp, offset_time)",
        )


def _ranges(facts: Facts) -> Iterator[Finding]:
    scans, fit = facts.scans, facts.fit
    if scans.empty == scans.scans:
        return
    half = f"half of the returns of the median scan are nearer than {scans.range_p50_m:.4g} m"
    if scans.range_p50_m > _FARTHEST_MEDIAN_M:
        yield Finding(
            Severity.ERROR,
            Trouble.WRONG_UNIT,
            f"{half}, the farthest is at {scans.range_max_m:.4g} m",
            f"as mm it would be {scans.range_p50_m * _MM:.3g} m: write the log in m",
        )
    elif scans.range_p50_m < _NEAREST_MEDIAN_M or fit is None:
        yield Finding(
            Severity.ERROR,
            Trouble.WRONG_UNIT,
            f"{half}, the farthest is at {scans.range_max_m:.4g} m",
            "are they in km, or scaled? Write the log in m",
        )
    if fit is None:
        return
    if fit.has_doubt and scans.range_p50_m <= _FARTHEST_MEDIAN_M:
        yield Finding(
            Severity.WARNING,
            Trouble.NO_PRESET_FITS,
            str(fit),
            "map it, look at the map, and change sensor and odometry with --config",
        )
    is_inside = scans.range_max_m <= load_config(fit.preset).sensor.max_range_m
    if is_inside and scans.at_range_max_share > _MOST_AT_MAX_SHARE:
        yield Finding(
            Severity.WARNING,
            Trouble.NO_RETURN_AS_RANGE,
            f"{100.0 * scans.at_range_max_share:.0f} % of all returns are as far as the farthest, "
            f"{scans.range_max_m:.3f} m: that seems to be how the sensor says that there is none",
            "leave them out: --config with `sensor: {max_range_m: "
            f"{np.floor(10.0 * scans.range_max_m - 0.5) / 10.0:.1f}}}`",
        )


def _upside_down(facts: Facts) -> Iterator[Finding]:
    ground = facts.scans.ground
    # In buildings there are ceilings.
    if ground is None or facts.fit is None or facts.fit.preset is not Preset.OUTDOOR:
        return
    is_above = ground.above_share >= max(_LEAST_GROUND_SHARE, _GROUND_RATIO * ground.below_share)
    if is_above:
        yield Finding(
            Severity.WARNING,
            Trouble.UPSIDE_DOWN,
            f"what looks like the ground is {ground.above_m:.1f} m above the sensor, at "
            f"{100.0 * ground.above_share:.0f} % of the places around it "
            f"({100.0 * ground.below_share:.0f} % below)",
            "if it is mounted upside down, say --sensor-pose 0 0 0 180 0 0; if only z has the "
            "wrong sign, write the log again",
        )


# ------------------------------------------------------------------ stamps


def _stamps(facts: Facts) -> Iterator[Finding]:
    streams = [("scans", facts.scans.timing)]
    if facts.odometry is not None:
        streams.append(("odometry readings", facts.odometry.timing))
    for what, timing in streams:
        yield from _backwards(facts, what, timing)
    scans = facts.scans.timing
    if scans.repeated:
        yield Finding(
            Severity.WARNING,
            Trouble.STAMPS_REPEATED,
            f"{scans.repeated} scans have the stamp of the one before",
            "are two sensors on one topic, or is every scan written twice? Record one, once",
        )
    if scans.gaps:
        yield _gaps(facts, scans)


def _backwards(facts: Facts, what: str, timing: Timing) -> Iterator[Finding]:
    if not timing.backwards:
        return
    is_sorted = timing.most_backwards_s <= facts.log.reorder_s
    yield Finding(
        Severity.NOTE if is_sorted else Severity.WARNING,
        Trouble.STAMPS_BACKWARDS,
        f"{timing.backwards} {what} are stamped earlier than the one before, by up to "
        f"{timing.most_backwards_s:.3f} s",
        "they are put in order"
        if is_sorted
        else f"what is over {facts.log.reorder_s:g} s late is left out: has the clock been set, "
        "or are these several logs in one?",
    )


def _gaps(facts: Facts, scans: Timing) -> Finding:
    begins_s = scans.longest_gap_at_s or 0.0
    ends_s = np.array([begins_s, begins_s + scans.longest_gap_s])
    is_bridged = _uncovered(ends_s, np.array(facts.odometry_stamps_s)) == 0.0
    is_bad = scans.longest_gap_s > _LONG_GAP_S and not is_bridged
    return Finding(
        Severity.WARNING if is_bad else Severity.NOTE,
        Trouble.GAPS,
        f"{scans.gaps} gaps between scans, the longest of {scans.longest_gap_s:.1f} s after "
        f"{begins_s:.3f} s{', with odometry' if is_bridged else ''}",
        "odometry says what the robot did meanwhile"
        if is_bridged
        else "without odometry nobody knows what the robot did meanwhile: the map may fall apart "
        "there; record odometry, or look for what the recorder has lost",
    )


# ------------------------------------------------------------------ odometry


def _odometry(facts: Facts) -> Iterator[Finding]:
    odometry = facts.odometry
    if odometry is None:
        messages = facts.log.odometry
        has_transforms = any(
            s.kind == _TRANSFORMS and s.use is not Use.FRAMES for s in facts.streams
        )
        why = f"none of {messages} readings is usable" if messages else "there is none"
        step = "; odometry that is in tf alone is not read" if has_transforms else ""
        yield Finding(
            Severity.WARNING if messages else Severity.NOTE,
            Trouble.NO_ODOMETRY,
            f"no odometry ({why}): the motion is from the scans alone",
            "see above"
            if messages
            else f"if the robot has wheels, record nav_msgs/Odometry or its like{step}",
        )
        return
    if odometry.path_m < _NO_MOTION_M:
        yield Finding(
            Severity.WARNING,
            Trouble.ODOMETRY_STILL,
            f"the odometry stays within {odometry.path_m:.3f} m in {odometry.readings} readings",
            "is it of the right topic? A robot that stands still makes no map",
        )
    limit_m_s = load_config(facts.fit.preset if facts.fit else Preset.PLANAR).motion.max_speed_m_s
    if odometry.jump_m > limit_m_s * (odometry.jump_s + _STEP_SLACK_S):
        yield Finding(
            Severity.WARNING,
            Trouble.ODOMETRY_JUMPS,
            f"the odometry jumps {odometry.jump_m:.1f} m in {odometry.jump_s:.2f} s, after "
            f"{odometry.jump_at_s:.3f} s",
            "it is not used across a jump: was it reset, is it a corrected pose, or not in m?",
        )


def _clocks(facts: Facts) -> Iterator[Finding]:
    odometry, scans = facts.odometry, facts.scans
    if odometry is None:
        return
    if scans.late_s is not None and odometry.late_s is not None:
        apart_s = scans.late_s - odometry.late_s
        if abs(apart_s) > _CLOCKS_APART_S:
            yield Finding(
                Severity.WARNING,
                Trouble.CLOCKS_APART,
                f"scans are recorded {scans.late_s:.3f} s after their stamps, odometry "
                f"{odometry.late_s:.3f} s: their clocks differ by about {apart_s:.3f} s",
                "let one clock stamp both (NTP, PTP, or the computer that records)",
            )
            return
    uncovered = _uncovered(np.array(facts.scan_stamps_s), np.array(facts.odometry_stamps_s))
    if uncovered > _MOST_UNCOVERED_SHARE:
        s, o = scans.timing, odometry.timing
        yield Finding(
            Severity.WARNING,
            Trouble.CLOCKS_APART,
            f"{100.0 * uncovered:.0f} % of the scans have no odometry within {_COVERED_S:g} s: "
            f"scans from {s.first_s:.3f} to {s.last_s:.3f} s, odometry from {o.first_s:.3f} to "
            f"{o.last_s:.3f} s",
            "do both have one clock, and was the odometry recorded all the time?",
        )


def _uncovered(stamps_s: FloatArray, odometry_stamps_s: FloatArray) -> float:
    """Return the share of stamps that no odometry is near to."""
    known = np.concatenate([[-np.inf], np.sort(odometry_stamps_s), [np.inf]])
    after = np.searchsorted(known[1:-1], stamps_s) + 1
    nearest = np.minimum(known[after] - stamps_s, stamps_s - known[after - 1])
    return float(np.mean(nearest > _COVERED_S))
