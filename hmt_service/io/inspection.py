"""What a recorded log holds, what is wrong with it, and which preset is for it.

References: own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from hmt_service.core.config import Preset
from hmt_service.core.geometry import Pose
from hmt_service.core.plausibility import Fit, fitting_preset
from hmt_service.core.types import Scan
from hmt_service.errors import InvalidLog
from hmt_service.io.findings import Facts, Finding, Severity, findings_of, nothing_usable
from hmt_service.io.log_statistics import (
    OdometryCollector,
    OdometryStatistics,
    ScanCollector,
    ScanStatistics,
    Timing,
    timing_of,
)
from hmt_service.io.logs import Log, open_log
from hmt_service.io.malformed import Tally
from hmt_service.io.streams import Mounting, Stream, Use

SAMPLED_SCANS = 100
"""How many scans of a log, at most, tell which preset is for it."""
_LOOKED_AT = 200
_NEAREST_M, _FARTHEST_M = 0.01, 1e6
"""All that is finite is looked at; a range of zero is a way of saying that there is none."""


class Verdict(StrEnum):
    """Whether a log can be mapped."""

    USABLE = "usable"
    DOUBTFUL = "usable, with warnings"
    UNUSABLE = "unusable"


@dataclass(frozen=True, slots=True)
class StreamReport:
    """One stream of a log."""

    name: str
    """Topic, tag or file pattern."""
    kind: str
    """Type of its messages."""
    encoding: str
    """How they are serialised."""
    messages: int
    """How many there are."""
    use: Use
    """What it is read for."""
    why: str
    """Why for that, or for nothing; empty where nothing else could be."""
    recorded: Timing
    """When they were recorded."""


@dataclass(frozen=True, slots=True)
class Inspection:
    """Everything that `hmt inspect` says of a log."""

    log: str
    """The log."""
    form: str
    """Name of its format."""
    verdict: Verdict
    """Whether it can be mapped."""
    streams: tuple[StreamReport, ...]
    """All that is in it, by name."""
    mounting: Mounting | None
    """Frames, and who says where the sensor sits; None of an unusable log."""
    scans: ScanStatistics | None
    """What its scans are like; None of an unusable log."""
    odometry: OdometryStatistics | None
    """What its odometry is like; None if there is none."""
    preset: Preset | None
    """The preset that `hmt run` takes when none is given; None if nothing is seen."""
    fit: Fit | None
    """Why that one."""
    findings: tuple[Finding, ...]
    """What is wrong or worth knowing, the worst first."""


def choose_preset(log: Log) -> Fit | None:
    """Return the preset that fits a log, see `fitting_preset`: the same for the same log."""
    return fitting_preset(log.sample(SAMPLED_SCANS))


def inspect_log(
    path: Path,
    *,
    body_from_sensor: Pose | None = None,
    scan_rate_hz: float | None = None,
    on_open: Callable[[int], object] = lambda _: None,
    on_reading: Callable[[], object] = lambda: None,
) -> Inspection:
    """Read a whole log, and say what it is like.

    Args:
        path: The log.
        body_from_sensor: Pose of the sensor on the body, shape (4, 4); None for what the log says.
        scan_rate_hz: Scans per second of a folder of scans without stamps; None for 10.
        on_open: Called with about how many readings there are.
        on_reading: Called after each of them.

    Raises:
        InvalidLog: If the format is unknown, or the log cannot be opened.
        InvalidInput: If a pose or a rate is given, and the log has its own.
    """
    source = open_log(path, scan_rate_hz=scan_rate_hz)
    streams = source.streams()
    reports = tuple(map(_report, streams))
    try:
        log = source.read(
            min_range_m=_NEAREST_M, max_range_m=_FARTHEST_M, body_from_sensor=body_from_sensor
        )
    except InvalidLog as error:
        return Inspection(
            log=str(path),
            form=source.form,
            verdict=Verdict.UNUSABLE,
            streams=reports,
            mounting=None,
            scans=None,
            odometry=None,
            preset=None,
            fit=None,
            findings=(nothing_usable(str(error), streams),),
        )
    on_open(log.scans + log.odometry)
    facts = _facts(log, streams, on_reading)
    findings = findings_of(facts)
    return Inspection(
        log=str(path),
        form=source.form,
        verdict=_verdict(findings),
        streams=reports,
        mounting=log.mounting,
        scans=facts.scans,
        odometry=facts.odometry,
        preset=facts.fit.preset if facts.fit else None,
        fit=facts.fit,
        findings=findings,
    )


def _facts(log: Log, streams: tuple[Stream, ...], on_reading: Callable[[], object]) -> Facts:
    fit = choose_preset(log)
    is_planar = fit is None or fit.preset is Preset.PLANAR
    scans, odometry = ScanCollector(every=-(-log.scans // _LOOKED_AT)), OdometryCollector()
    tally = Tally()
    for arrival in log.arrivals(tally):
        if isinstance(arrival.reading, Scan):
            scans.take(arrival, arrival.reading)
        else:
            odometry.take(arrival, arrival.reading)
        on_reading()
    return Facts(
        log=log,
        streams=streams,
        malformed=tally.result(),
        scans=scans.result(is_planar=is_planar),
        scan_stamps_s=scans.stamps_s,
        odometry=odometry.result(),
        odometry_stamps_s=odometry.stamps_s,
        fit=fit,
    )


def _report(stream: Stream) -> StreamReport:
    recorded = timing_of(stream.times_s)
    return StreamReport(
        stream.name,
        stream.kind,
        stream.encoding,
        stream.messages,
        stream.use,
        stream.why,
        recorded,
    )


def _verdict(findings: tuple[Finding, ...]) -> Verdict:
    severities = {finding.severity for finding in findings}
    if Severity.ERROR in severities:
        return Verdict.UNUSABLE
    return Verdict.DOUBTFUL if Severity.WARNING in severities else Verdict.USABLE
