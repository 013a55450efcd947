"""A recorded drive with its truth, as a folder of files that are written while it happens.

`log.mcap` holds what the robot sent, `truth.tum` and `places.csv` one line per scan, `world.json`
everything that was declared. All of them appear at the end, or none.

References:
    own.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from hmt_service.core.types import Reading, StampedPose
from hmt_service.errors import InvalidInput, Unavailable
from hmt_service.io.mcap_writer import McapWriter
from hmt_service.io.trajectory import tum_line

LOG, TRUTH, PLACES, WORLD = "log.mcap", "truth.tum", "places.csv", "world.json"
"""Names of the files; the last one appears last."""
_NAMES = (LOG, TRUTH, PLACES, WORLD)


class Recording:
    """The files of one drive while they are written."""

    def __init__(self, files: Mapping[str, BinaryIO]) -> None:
        """Begin; use `recording`.

        Args:
            files: An empty file for each name.
        """
        self._files = files
        self._log = McapWriter(files[LOG])
        files[PLACES].write(b"stamp_s,place\n")

    def send(self, reading: Reading) -> None:
        """Append what the robot sends."""
        self._log.write(reading)

    def reveal(self, truth: StampedPose, place: int) -> None:
        """Append where the robot truly is at the stamp of a scan."""
        self._files[TRUTH].write(tum_line(truth).encode())
        self._files[PLACES].write(f"{truth.stamp_s:.6f},{place}\n".encode())

    def finish(self, declared: Mapping[str, object]) -> None:
        """Complete the files.

        Args:
            declared: What there is to say about the drive, in the types of JSON.
        """
        self._log.finish()
        self._files[WORLD].write(f"{json.dumps(declared, indent=2, allow_nan=False)}\n".encode())


@contextmanager
def recording(folder: Path) -> Iterator[Recording]:
    """Yield files to write a drive to; they get their names when the block ends without error.

    Args:
        folder: Made when it does not exist; files of an earlier drive are replaced.

    Raises:
        InvalidInput: If the folder holds such files of somebody else.
        Unavailable: If they cannot be written.
    """
    refuse_foreign(folder)
    parts = {name: folder / f"{name}.part" for name in _NAMES}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with ExitStack() as open_files:
                yield Recording(
                    {name: open_files.enter_context(p.open("wb")) for name, p in parts.items()}
                )
            for name, part in parts.items():
                part.replace(folder / name)
        finally:
            for part in parts.values():
                part.unlink(missing_ok=True)
    except OSError as error:
        raise Unavailable(f"cannot write to {folder}: {error.strerror}") from error


def refuse_foreign(folder: Path) -> None:
    """Check that no file which is not ours would be replaced.

    Raises:
        InvalidInput: If there is one.
    """
    there = [name for name in _NAMES if (folder / name).exists()]
    if there and WORLD not in there:
        raise InvalidInput(
            f"{folder} holds {', '.join(there)} but no {WORLD}: not written by this program, and "
            "not replaced"
        )
