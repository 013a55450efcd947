"""What `hmt doctor` looks at: whether this machine can run a daemon, and reach one.

Every check returns what it found and, where that is no good, what to do next; none raises.

References: own.
"""

from __future__ import annotations

import importlib
import math
import os
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from importlib import metadata
from pathlib import Path
from typing import Any

import zenoh
from packaging.requirements import Requirement

from hmt_service import __version__
from hmt_service.client.blocking import HmtClient
from hmt_service.client.local import free_endpoint
from hmt_service.errors import AccessDenied, HmtError, Unavailable
from hmt_service.service.session import Endpoints, Mode, client_endpoints, open_session

PACKAGE = "hmt-service"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables that bound the threads of the libraries below us."""
_KERNELS = ("hmt_service.core.local_map", "hmt_service.core.transients")
_ENOUGH_BYTES = 1e9
_LEAST_MEMORY_BYTES = 4e8
"""Measured: the three processes of a daemon take 0.4 GB before the first scan."""
_MEASURED_S = 0.2
_MOST_JUMP_S = 0.02
_MOST_OFFSET_S = 0.5
_RESOLUTION_S = 1e-3
_ROUND_TRIP_S = 5.0
# Older than this program: a machine without a battery that nobody has told the time.
_FIRST_DAY_S = 1_735_689_600.0


class Verdict(StrEnum):
    """How it is."""

    OK = "ok"
    WARN = "warn"
    """It works, maybe not as well as it could."""
    FAIL = "fail"
    """Something that is needed does not work."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the diagnosis."""

    check: str
    """What was looked at."""
    verdict: Verdict
    """How it is."""
    found: str
    """What was found, with the numbers."""
    next_step: str = ""
    """What to do about it; empty where nothing is to be done."""


def diagnose(
    connect: str | None, site: str, robot: str, zenoh_config: Path | None
) -> Iterator[Finding]:
    """Yield one finding after the other.

    Args:
        connect: Endpoint of the daemon; None for the one that `zenoh_config` names, or the usual.
        site: Where the robot works.
        robot: Which one it is.
        zenoh_config: File of Zenoh settings: certificates or a password.
    """
    yield python_version(metadata.metadata(PACKAGE)["Requires-Python"])
    yield from library_versions(metadata.requires(PACKAGE) or ())
    yield cores()
    yield threads(os.environ)
    yield memory()
    yield disk(Path(tempfile.gettempdir()))
    yield kernel_cache()
    yield clock()
    yield zenoh_round_trip()
    yield from daemon(connect, site, robot, zenoh_config)


def python_version(required: str) -> Finding:
    """Return whether this Python is one that the package declares."""
    version = platform.python_version()
    found = f"{version} on {platform.system()} {platform.machine()}, hmt {__version__}"
    if Requirement(f"python{required}").specifier.contains(version, prereleases=True):
        return Finding("python", Verdict.OK, found)
    return Finding("python", Verdict.FAIL, f"{found}: needs {required}", "install such a Python")


def library_versions(requirements: Iterable[str]) -> Iterator[Finding]:
    """Yield a finding per library that is missing or too old, and one of all others.

    Args:
        requirements: What the package declares, as in its metadata; extras are left out.
    """
    sound = []
    for requirement in map(Requirement, requirements):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        repair = f"pip install '{requirement.name}{requirement.specifier}'"
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            found = f"{requirement.name} is not installed: needs {requirement.specifier}"
            yield Finding("library", Verdict.FAIL, found, repair)
            continue
        if requirement.specifier.contains(version, prereleases=True):
            sound.append(f"{requirement.name} {version}")
        else:
            found = f"{requirement.name} {version}: needs {requirement.specifier}"
            yield Finding("library", Verdict.FAIL, found, repair)
    yield Finding("libraries", Verdict.OK, ", ".join(sound))


def cores() -> Finding:
    """Return how many cores there are for this process."""
    count = _cores()
    if count >= 2:
        return Finding("cores", Verdict.OK, f"{count}")
    advice = "two let odometry and topology work side by side; one maps at half the rate"
    return Finding("cores", Verdict.WARN, f"{count}", advice)


def threads(environment: Mapping[str, str]) -> Finding:
    """Return whether the variables that bound threads say something sensible."""
    said = {name: environment[name] for name in THREADS if environment.get(name)}
    wrong = [name for name, text in said.items() if not text.isdigit() or int(text) < 1]
    many = [name for name, text in said.items() if name not in wrong and int(text) > _cores()]
    found = ", ".join(f"{name}={text}" for name, text in said.items()) or "none set"
    if wrong:
        return Finding("threads", Verdict.FAIL, found, f"unset {' '.join(wrong)}: not a number")
    if many:
        advice = f"unset {' '.join(many)}: more threads than the {_cores()} cores only wait"
        return Finding("threads", Verdict.WARN, found, advice)
    return Finding("threads", Verdict.OK, found)


def memory() -> Finding:
    """Return how much memory is available."""
    free = _available_bytes()
    if free is None:
        return Finding("memory", Verdict.OK, "this system does not say how much is free")
    found = f"{free / 1e9:.1f} GB available"
    if free >= _ENOUGH_BYTES:
        return Finding("memory", Verdict.OK, found)
    verdict = Verdict.WARN if free >= _LEAST_MEMORY_BYTES else Verdict.FAIL
    return Finding("memory", verdict, found, "end other programs, or use --memory-budget 64MB")


def disk(folder: Path) -> Finding:
    """Return whether temporary files, where --memory-budget puts submaps, have room on a disk."""
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"hmt")
    except OSError as error:
        found = f"{folder} cannot be written: {error.strerror}"
        return Finding("temporary files", Verdict.FAIL, found, "set TMPDIR to a folder of a disk")
    free = shutil.disk_usage(folder).free
    found = f"{folder}, {free / 1e9:.1f} GB free"
    if _file_system(folder) == "tmpfs":
        advice = "that is memory: set TMPDIR to a folder of a disk before using --memory-budget"
        return Finding("temporary files", Verdict.WARN, f"{found}, tmpfs", advice)
    if free < _ENOUGH_BYTES:
        advice = "make room, or set TMPDIR to a folder of another disk"
        return Finding("temporary files", Verdict.WARN, found, advice)
    return Finding("temporary files", Verdict.OK, found)


def kernel_cache() -> Finding:
    """Return whether compiled code is there, or will stay once it is compiled."""
    compile_now = "python -c 'from hmt_service.core import kernels; kernels.compile_all()'"
    try:
        folders = {_cache_of(name) for name in _KERNELS}
    # Numba refuses to import what it has nowhere to keep.
    except RuntimeError as error:
        advice = "set NUMBA_CACHE_DIR to a folder that may be written"
        return Finding("compiled code", Verdict.FAIL, f"{error}", advice)
    names = ", ".join(map(str, sorted(folders)))
    if not all(any(folder.glob("*.nbi")) for folder in folders):
        advice = f"compile it now, else the first map waits about 20 s: {compile_now}"
        return Finding("compiled code", Verdict.WARN, f"not yet in {names}", advice)
    if not all(os.access(folder, os.W_OK) for folder in folders):
        found = f"in {names}, which cannot be written"
        advice = "set NUMBA_CACHE_DIR to a folder that may be written, for the next update"
        return Finding("compiled code", Verdict.WARN, found, advice)
    return Finding("compiled code", Verdict.OK, f"in {names}")


def clock() -> Finding:
    """Return whether clocks are fine, steady, and roughly right."""
    before = time.time(), time.monotonic()
    time.sleep(_MEASURED_S)
    jump_s = (time.time() - before[0]) - (time.monotonic() - before[1])
    resolution_s = time.get_clock_info("monotonic").resolution
    today = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    found = f"{today}, resolution {resolution_s:g} s, wall against monotonic {1e3 * jump_s:+.3f} ms"
    if before[0] < _FIRST_DAY_S:
        return Finding("clock", Verdict.WARN, found, "set the date: run chrony or ntpd")
    if abs(jump_s) > _MOST_JUMP_S:
        advice = "the wall clock is being set: stamp readings when it has settled"
        return Finding("clock", Verdict.WARN, found, advice)
    if resolution_s > _RESOLUTION_S:
        return Finding("clock", Verdict.WARN, found, "stamp readings by the sensor's own clock")
    return Finding("clock", Verdict.OK, found)


def zenoh_round_trip() -> Finding:
    """Return whether two sessions on this machine reach each other: one put, and one query."""
    endpoint, key, text = free_endpoint(), "hmt/@doctor/echo", "how are you"
    heard = threading.Event()

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(key, text)

    try:
        with (
            open_session(Endpoints(mode=Mode.PEER, listen=[endpoint])) as here,
            open_session(client_endpoints(endpoint)) as there,
        ):
            here.declare_queryable(key, answer)
            here.declare_subscriber(key, lambda _: heard.set())
            begin_s = time.monotonic()
            replies = list(there.get(key, timeout=_ROUND_TRIP_S))
            took_s = time.monotonic() - begin_s
            there.put(key, text)
            is_heard = heard.wait(_ROUND_TRIP_S)
    except (zenoh.ZError, HmtError) as error:
        advice = "see that the loopback interface is up and no firewall stands before it"
        return Finding("zenoh", Verdict.FAIL, " ".join(str(error).split()), advice)
    said = f"query on {endpoint} answered in {1e3 * took_s:.1f} ms"
    if is_heard and any(reply.ok for reply in replies):
        return Finding("zenoh", Verdict.OK, f"{said}, put received")
    lost = f"{len(replies)} replies, put {'received' if is_heard else 'lost'} on {endpoint}"
    return Finding("zenoh", Verdict.FAIL, lost, "see that no firewall stands before loopback")


def daemon(
    connect: str | None, site: str, robot: str, zenoh_config: Path | None
) -> Iterator[Finding]:
    """Yield whether a daemon answers, and how its clock differs from ours.

    That nobody does is a failure only if somebody was named.
    """
    try:
        with HmtClient(
            connect, site=site, robot=robot, timeout_s=_ROUND_TRIP_S, zenoh_config=zenoh_config
        ) as client:
            client.status()  # the first question pays for the connection
            asked_s = time.time()
            status = client.status()
            answered_s = time.time()
    except HmtError as error:
        is_named = connect is not None or zenoh_config is not None
        verdict = Verdict.FAIL if is_named or not isinstance(error, Unavailable) else Verdict.WARN
        step = "start one with `hmt serve`, or say with --connect, --site and --robot where it is"
        if isinstance(error, AccessDenied):
            step = "name a --zenoh-config with credentials that may ask"
        yield Finding("daemon", verdict, " ".join(str(error).split()), step)
        return
    found = f"{status.state}, hmt {status.version}, {status.keyframes} keyframes in its map"
    if status.version == __version__:
        yield Finding("daemon", Verdict.OK, found)
    else:
        step = f"install the same version on both sides: here it is {__version__}"
        yield Finding("daemon", Verdict.WARN, found, step)
    yield clock_offset(status.clock_s, asked_s, answered_s)


def clock_offset(clock_s: float, asked_s: float, answered_s: float) -> Finding:
    """Return how far the clock of a daemon is from ours, known to half of the round trip.

    Args:
        clock_s: Its wall clock when it answered; 0 if it does not tell.
        asked_s: Ours when it was asked.
        answered_s: Ours when its answer was here.
    """
    if not clock_s:
        return Finding("daemon's clock", Verdict.OK, "this daemon does not tell it")
    offset_s = clock_s - (asked_s + answered_s) / 2.0
    half_s = (answered_s - asked_s) / 2.0
    found = f"{1e3 * offset_s:+.1f} ms from ours, known to {1e3 * half_s:.1f} ms"
    if abs(offset_s) - half_s <= _MOST_OFFSET_S:
        return Finding("daemon's clock", Verdict.OK, found)
    step = "synchronise both machines (chrony), or stamp scans and odometry by one clock"
    return Finding("daemon's clock", Verdict.WARN, found, step)


def _cores() -> int:
    # Fewer than the machine has, where a container or taskset says so.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _available_bytes() -> float | None:
    with suppress(OSError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return float(line.split()[1]) * 1024.0
    return None


def _file_system(folder: Path) -> str:
    """Return the type of the file system that a folder is on; empty where nothing says it."""
    with suppress(OSError):
        mounts = [line.split()[1:3] for line in Path("/proc/mounts").read_text().splitlines()]
        place = folder.resolve()
        above = [(len(where), kind) for where, kind in mounts if place.is_relative_to(where)]
        return max(above, default=(math.nan, ""))[1]
    return ""


def _cache_of(module: str) -> Path:
    """Return the folder where numba keeps what it compiles of a module.

    Raises:
        RuntimeError: If there is none that may be written.
    """
    held: dict[str, Any] = vars(importlib.import_module(module))
    return Path(next(value.stats.cache_path for value in held.values() if hasattr(value, "stats")))
