"""The map file that a daemon goes on with: every update is one transaction.

SQLite writes it to the log beside the file, and from there into the file now and then. What is
committed is on the disk; whoever dies meanwhile, the next one to open the file finds the state of
the last commit.

References:
    own; https://www.sqlite.org/wal.html.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from hmt_service.core.stored import StoredMap
from hmt_service.errors import Unavailable
from hmt_service.io.map_file import opened, require_sound, write_map
from hmt_service.io.map_rows import SCHEMA_VERSION, digest_in, read_rows, write_rows

# Somebody who reads a file at rest is waited for so long before the first update.
_BUSY_S = 1.0
_State = tuple[tuple[int, int], int]


class MapStore:
    """Owner of one map file, open from the first update on.

    Nobody else may write the file meanwhile. That is not locked but noticed: a transaction begins
    with the question whether the content is still what this store has read or written last.
    """

    def __init__(self, path: Path) -> None:
        """Prepare; nothing is opened.

        Args:
            path: Map file; made when there is something to put into it.
        """
        self._path = path.resolve()
        self._database: sqlite3.Connection | None = None
        # Of a file that cannot be brought up to date, or is not there: what it looks like.
        self._digest: str | None = None
        self._state: _State | None = None

    @contextmanager
    def reading(self) -> Iterator[StoredMap | None]:
        """Read the map in the file, None if there is no file; its keyframes one after the other.

        They can be asked for until the block ends.

        Raises:
            InvalidInput: If it is no map file, is damaged or was written by another version.
            Unavailable: If it cannot be read now.
        """
        self._state = _state_of(self._path)
        if self._state is None:
            yield None
            return
        with opened(self._path) as database:
            require_sound(database, self._path)
            (version,) = database.execute("PRAGMA user_version").fetchone()
            self._digest = digest_in(database) if version == SCHEMA_VERSION else None
            yield read_rows(database, is_lazy=True)

    def update(self, stored: StoredMap) -> None:
        """Bring the file up to a later state of the map that was read from it or written last.

        It holds the state before or all of this one, at any moment.

        Args:
            stored: The map; only what is new of its keyframes and scans is asked for.

        Raises:
            NotFound: If there is no file yet, and no folder for it.
            InvalidInput: If a point is not finite or too far away to be stored.
            Unavailable: If the file system refuses, or another program has written the file.
        """
        try:
            state = _state_of(self._path)
            if self._digest is None or state is None:
                self._make(stored, state)
            else:
                self._commit(stored, state)
        except (sqlite3.DatabaseError, OSError) as error:
            raise Unavailable(
                f"map of {len(stored.keyframes)} keyframes not written to {self._path}: {error}"
            ) from error

    def close(self) -> None:
        """Leave one file; its log stays while somebody reads it, or where the disk is full."""
        if self._database is None:
            return
        with suppress(sqlite3.OperationalError):
            self._database.execute("PRAGMA journal_mode = DELETE")
        self._database.close()
        self._database = None

    def _make(self, stored: StoredMap, state: _State | None) -> None:
        """Write the whole file: a new one, that of an older version, or one that was removed."""
        if state is not None and state != self._state:
            raise self._taken()
        self.close()
        self._digest = write_map(self._path, stored)

    def _commit(self, stored: StoredMap, state: _State) -> None:
        database = self._opened(state)
        database.execute("BEGIN IMMEDIATE")
        try:
            if digest_in(database) != self._digest:
                raise self._taken()
            digest = write_rows(database, stored)
            database.execute("COMMIT")
        finally:
            if database.in_transaction:
                database.execute("ROLLBACK")
        self._digest = digest

    def _opened(self, state: _State) -> sqlite3.Connection:
        if self._database is None:
            uri = f"{self._path.as_uri()}?mode=rw"
            database = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY_S)
            try:
                database.execute("PRAGMA journal_mode = WAL")
                database.execute("PRAGMA synchronous = FULL")
            except sqlite3.DatabaseError:
                database.close()
                raise
            self._database, self._state = database, state
        elif self._state is None or state[0] != self._state[0]:
            # What would be written now goes to a file that has no name any more.
            raise self._taken()
        return self._database

    def _taken(self) -> Unavailable:
        return Unavailable(f"another program has written {self._path}: this map is not in it")


def bring_to_rest(path: Path) -> None:
    """Put what is in the log beside a map file into it, and leave the one file.

    Raises:
        sqlite3.Error: If somebody uses it, or the file system refuses.
    """
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=rw", uri=True)) as database:
        database.execute("PRAGMA journal_mode = DELETE")


def _state_of(path: Path) -> _State | None:
    """Return which file has this name and when it was written; None: there is none."""
    with suppress(FileNotFoundError):
        status = path.stat()
        return (status.st_dev, status.st_ino), status.st_mtime_ns
    return None
