"""Results of finished units of work, kept in files so that a long run can be resumed.

References: own.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Result = dict[str, Any]
"""What a unit of work returns: anything that JSON can hold."""

_ROOT = Path(__file__).parents[1]
_SOURCES = ("hmt_service", "benchmarks")


@dataclass(frozen=True, slots=True)
class Cells:
    """A folder of results, each valid for one state of the code."""

    folder: Path
    """Where the files are."""
    fingerprint: str
    """State of the code; a result of another state is not used."""
    is_resumed: bool
    """Whether results from earlier runs may be used at all."""

    def read(self, key: str) -> Result | None:
        """Return the result of a unit of work that an earlier run has finished, if it may be used.

        Args:
            key: Name of the unit, parts separated by `/`.
        """
        if not self.is_resumed:
            return None
        try:
            cell = json.loads(self._path(key).read_text())
        except (OSError, ValueError):
            return None  # never written, or cut off while it was: to be computed
        is_current = isinstance(cell, dict) and cell.get("fingerprint") == self.fingerprint
        return cell.get("result") if is_current else None

    def write(self, key: str, result: Result) -> None:
        """Keep the result of a unit of work."""
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps({"fingerprint": self.fingerprint, "result": result}))
        part.replace(path)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.json"


def code_fingerprint() -> str:
    """Return sixteen hexadecimal digits that change when any line of the code does."""
    digest = hashlib.sha256()
    for source in _SOURCES:
        for path in sorted((_ROOT / source).rglob("*.py")):
            digest.update(path.relative_to(_ROOT).as_posix().encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
