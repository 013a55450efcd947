"""What a run has saved, as values: its summary, its map, what was decided and what was believed.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ValidationError

from hmt_service.core.stored import StoredMap
from hmt_service.core.types import Belief, Event
from hmt_service.errors import InvalidInput, NotFound
from hmt_service.io.audit_files import read_beliefs, read_events
from hmt_service.io.map_file import read_map

TRAJECTORY, MAP, SUMMARY = "trajectory.tum", "map.hmt", "summary.json"
EVENTS, BELIEFS = "events.jsonl", "posterior.jsonl"
"""Names of the files."""


class SavedHypothesis(BaseModel, frozen=True):
    """One topology at the end of a run."""

    hypothesis: int
    """Identifier."""
    probability: float
    """Posterior mass."""
    areas: int
    """Number of areas."""
    loop_closures: int
    """Number of times that a known area was entered again."""


class Summary(BaseModel, frozen=True):
    """What `summary.json` holds."""

    version: str
    """Version of the program."""
    config_hash: str
    """Of the settings."""
    seed: int
    """Seed of the run."""
    scans: int
    """Number of scans."""
    keyframes: int
    """Number of scans that were kept."""
    areas: int
    """Number of areas of the most probable topology."""
    arcs: int
    """Number of its arcs."""
    revision: int
    """Map revision."""
    posterior: tuple[SavedHypothesis, ...]
    """The most probable first, at least one."""
    tracked: Mapping[str, int]
    """Scans that were registered or were not, by the reason."""
    warnings: tuple[str, ...]
    """What casts doubt on the whole map."""
    busy_s: Mapping[str, float]
    """Time that each process has worked, s of the wall clock."""
    peak_memory_mb: float
    """Most memory that the process has had."""
    submaps_mb: Mapping[str, float] | None = None
    """Where how much of the submaps was at the end; None without a budget."""


@dataclass(frozen=True, slots=True, eq=False)
class SavedRun:
    """The files of one run."""

    name: str
    """Of the folder."""
    summary: Summary
    """The run in numbers."""
    stored: StoredMap
    """The map."""
    events: tuple[Event, ...]
    """What was decided, the oldest first."""
    beliefs: tuple[Belief, ...]
    """What was believed, in time order."""


def read_run(directory: Path, *, map_file: Path | None = None) -> SavedRun:
    """Read what `hmt run` or a daemon has saved.

    Args:
        directory: The folder.
        map_file: The map, if it is elsewhere.

    Raises:
        NotFound: If there is no such folder, or a file is missing.
        InvalidInput: If a file is not what it should be, or the map is of another run.
        Unavailable: If the map cannot be read now.
    """
    if not directory.is_dir():
        raise NotFound(f"folder {directory} of a run does not exist")
    summary = _read_summary(directory / SUMMARY)
    stored = read_map(map_file or directory / MAP)
    if stored.config_hash != summary.config_hash:
        raise InvalidInput(
            f"the map has the settings {stored.config_hash}, the run {summary.config_hash}: "
            "it is of another run"
        )
    events, beliefs = read_events(directory / EVENTS), read_beliefs(directory / BELIEFS)
    return SavedRun(directory.resolve().name, summary, stored, events, beliefs)


def _read_summary(path: Path) -> Summary:
    try:
        summary = Summary.model_validate_json(path.read_bytes())
    except OSError as error:
        raise NotFound(f"{path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        what = error.errors()[0]
        place = ".".join(map(str, what["loc"]))
        raise InvalidInput(f"{path.name}: {place or 'file'}: {what['msg']}") from error
    if not summary.posterior:
        raise InvalidInput(f"{path.name}: posterior: no hypothesis")
    return summary
