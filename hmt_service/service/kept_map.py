"""The map file of a daemon: read when it starts, written as the map grows.

References:
    own.
"""

from __future__ import annotations

import re
import sqlite3
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from hmt_service.core.config import Config
from hmt_service.errors import InvalidInput, NotFound, Unavailable
from hmt_service.io.map_store import MapStore, bring_to_rest

if TYPE_CHECKING:
    from hmt_service.core.engine import Engine
    from hmt_service.core.visits import MemoryBudget

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,99}\.hmt")


class KeptMap:
    """One map file that a map goes on in, session after session."""

    def __init__(self, path: Path, *, is_frozen: bool = False) -> None:
        """Prepare; nothing is opened.

        Args:
            path: The file; made when it does not exist.
            is_frozen: Whether it stays as it is: a session only finds its place in it.
        """
        self.path = path
        self.is_frozen = is_frozen
        # Where the path is a link, the file that it leads to is written.
        self._store = MapStore(path)

    def beside(self, name: str) -> KeptMap:
        """Return another map in the same folder, which goes on in the same way.

        Args:
            name: Name of its file.

        Raises:
            InvalidInput: If it is not the name of a map file.
        """
        if not _NAME.fullmatch(name):
            raise InvalidInput(f"map={name[:80]!r} is not the name of a file, such as site.hmt")
        return KeptMap(self.path.parent / name, is_frozen=self.is_frozen)

    def require(self, config: Config) -> None:
        """Make sure that a map of some settings can be gone on with.

        Raises:
            NotFound: If there is no such file.
            InvalidInput: If it is no map file, is damaged, empty, has other settings or was written
                by another version.
            Unavailable: If it cannot be read now.
        """
        with MapStore(self.path).reading() as stored:
            if stored is None:
                raise NotFound(f"map file {self.path} does not exist")
            if not stored.visits or not stored.hypotheses:
                raise InvalidInput(f"map file {self.path} is empty")
            if stored.config != config:
                raise InvalidInput(
                    f"{self.path.name} was made with other settings: start a daemon with it"
                )

    def set_aside(self) -> tuple[str, ...]:
        """Give the file, which nobody writes any more, another name; return it if there is a file.

        Raises:
            Unavailable: If the file system refuses.
        """
        path = self.path.resolve()  # where the path is a link, the link stays
        if not path.exists():
            return ()
        names = (path.with_name(f"{path.stem}-{number}{path.suffix}") for number in count(1))
        aside = next(name for name in names if not name.exists())
        try:
            bring_to_rest(path)
            path.rename(aside)
        except (OSError, sqlite3.Error) as error:
            raise Unavailable(f"{path} is not set aside: {error}") from error
        return (str(aside),)

    def engine(
        self,
        config: Config,
        *,
        seed: int,
        budget: MemoryBudget | None = None,
        first_of_session: int | None = None,
    ) -> Engine:
        """Return an engine that goes on with the map, or begins it.

        Args:
            config: Settings of a map that begins; a known map has its own.
            seed: Seed of all randomness.
            budget: How much of the map may be in memory; None for all of it.
            first_of_session: As in `Engine.restored`.

        Raises:
            NotFound: If the map is frozen, and there is none.
            InvalidInput: If the file is no map file, is damaged or was written by another version.
            Unavailable: If it cannot be read now.
        """
        from hmt_service.core.engine import Engine

        with self._store.reading() as stored:
            if stored is not None:
                return Engine.restored(
                    stored,
                    seed=seed,
                    is_frozen=self.is_frozen,
                    budget=budget,
                    first_of_session=first_of_session,
                )
            if self.is_frozen:
                raise NotFound(f"map file {self.path} does not exist")
            return Engine(config, seed=seed, budget=budget)

    def write(self, engine: Engine) -> None:
        """Write what is new, so that the file holds either the map before or all of this one.

        Raises:
            NotFound: If the folder does not exist.
            Unavailable: If the file system refuses, or another program has written the file.
        """
        self._store.update(engine.stored())

    def close(self) -> None:
        """Leave one file, at rest."""
        self._store.close()
