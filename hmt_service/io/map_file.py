"""The map file `*.hmt`: a whole map in one SQLite database that any SQLite tool can open.

At rest it is one file. While a daemon writes it (`map_store`), and after its sudden death, what was
written last is in a log beside it (`-wal`), which belongs to it.

References:
    own; https://www.sqlite.org/wal.html.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import zstandard

from hmt_service.core.config import Config
from hmt_service.core.stored import StoredMap
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.map_rows import (
    READABLE,
    SCHEMA,
    SCHEMA_VERSION,
    content_digest,
    digest_in,
    read_rows,
    write_rows,
)

# Magic string, whether there may be a log, `PRAGMA user_version` and `PRAGMA application_id`.
_HEAD = struct.Struct(">18sB41xI4xI")
_WITH_LOG = 2
_APPLICATION_ID = int.from_bytes(b"hmtm")
_LOG, _LOG_INDEX, _UNDO = "-wal", "-shm", "-journal"
# Nobody waits longer for another program that is about to open or close the same file.
_BUSY_S = 5.0
_NOT_NOW = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY}


def write_map(path: Path, stored: StoredMap) -> str:
    """Write a map so that `path` holds either the old file or the whole new one, at any moment.

    The same map gives the same bytes. Points are rounded to `POINT_RESOLUTION_M`.

    Args:
        path: Map file; replaced if it exists.
        stored: The map.

    Returns:
        The digest of the content.

    Raises:
        NotFound: If the folder does not exist.
        InvalidInput: If a point is not finite or too far away to be stored.
        Unavailable: If the file system refuses, or another program writes the file.
    """
    if not path.parent.is_dir():
        raise NotFound(f"folder {path.parent} of the map file {path.name} does not exist")
    partial = path.with_name(f"{path.name}.partial")
    try:
        partial.unlink(missing_ok=True)
        # Nobody else sees the partial file: it needs no journal, replacing `path` is the commit.
        with closing(sqlite3.connect(partial, isolation_level=None)) as database:
            database.execute("PRAGMA journal_mode = OFF")
            database.executescript(f"BEGIN; {SCHEMA}")
            digest = write_rows(database, stored)
            database.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
            database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
            database.execute("COMMIT")
        _settle(path)
        partial.replace(path)
        _sync_folder(path.parent)
    except (sqlite3.DatabaseError, OSError) as error:
        raise Unavailable(
            f"map of {len(stored.keyframes)} keyframes not written to {path}: {error}"
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return digest


def read_map(path: Path, *, with_points: bool = True) -> StoredMap:
    """Read a map file.

    Args:
        path: Map file.
        with_points: Whether keyframes come with what they saw, which is most of the file. Only then
            the whole content is compared with its digest.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
        Unavailable: If it cannot be read now.
    """
    with opened(path) as database:
        if with_points:
            require_sound(database, path)
        return read_rows(database, with_points=with_points)


def require_sound(database: sqlite3.Connection, path: Path) -> None:
    """Compare the content of a map file with its digest.

    Raises:
        InvalidInput: If it is damaged.
    """
    known, found = digest_in(database), content_digest(database)
    if known is not None and known != found:
        raise InvalidInput(f"{path} is damaged: it has digest {found[:12]}…, not {known}")


def read_config(path: Path) -> Config:
    """Read the settings that a map was built with.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
        Unavailable: If it cannot be read now.
    """
    # Visits and hypotheses too: what is damaged is found out before anything begins.
    return read_map(path, with_points=False).config


@contextmanager
def opened(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a map file for reading; what cannot be read meanwhile is told of the file.

    Everything is read as it was at one moment, whoever writes meanwhile.

    Raises:
        NotFound: If there is no such file.
        InvalidInput: If it is no map file, is damaged or was written by another version.
        Unavailable: If it cannot be read now.
    """
    if not path.is_file():
        raise NotFound(f"map file {path} does not exist")
    path = path.resolve()
    has_log = _check_head(path)
    mode = "ro"
    if beside(path, _UNDO).exists():
        # Somebody was killed between the two kinds of map file: opening it to write takes it back.
        mode = "rw"
    elif has_log and not beside(path, _LOG).exists():
        # Nobody writes it: it need not, and on read-only media cannot, get a new log.
        mode = "ro&immutable=1"
    try:
        uri = f"{path.as_uri()}?mode={mode}"
        with closing(
            sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY_S)
        ) as database:
            database.execute("BEGIN")
            yield database
    # Damaged pages may hold any value of any type.
    except (sqlite3.DatabaseError, zstandard.ZstdError, KeyError, TypeError, ValueError) as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _NOT_NOW:
            raise Unavailable(f"{path} cannot be read now: {error}") from error
        size = path.stat().st_size
        raise InvalidInput(f"{path} ({size} bytes) is no map file or damaged: {error}") from error


def beside(path: Path, ending: str) -> Path:
    """Return what SQLite calls a file that belongs to a database."""
    return path.with_name(path.name + ending)


def _settle(path: Path) -> None:
    """Take in the log of a file that is to be replaced: it must not be read into the new one.

    Fails while another program has the file open.
    """
    if not beside(path, _LOG).exists():
        return
    if path.exists():
        uri = f"{path.resolve().as_uri()}?mode=rw"
        with closing(sqlite3.connect(uri, uri=True, isolation_level=None)) as database:
            database.execute("PRAGMA journal_mode = DELETE")
    for ending in (_LOG, _LOG_INDEX):
        beside(path, ending).unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Have the names of the files in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_head(path: Path) -> bool:
    """Look at the head of the file only: it is there when the rest is damaged.

    Returns:
        Whether it may have a log.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD.size)
    if len(head) < _HEAD.size or not head.startswith(b"SQLite format 3\0"):
        raise InvalidInput(f"{path} ({path.stat().st_size} bytes) is no map file or damaged")
    _, kind, version, application = _HEAD.unpack(head)
    if application != _APPLICATION_ID:
        raise InvalidInput(
            f"{path} is an SQLite file of another application "
            f"(id {application:#x}, a map file has {_APPLICATION_ID:#x})"
        )
    if not READABLE[0] <= version <= READABLE[1]:
        raise InvalidInput(
            f"{path} has schema version {version}, this program reads versions "
            f"{READABLE[0]} to {READABLE[1]}"
        )
    return bool(kind == _WITH_LOG)
