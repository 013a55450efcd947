"""The map file of a daemon: read when it starts, written as the map grows.

References:
    own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hmt_service.core.config import Config

if TYPE_CHECKING:
    from hmt_service.core.engine import Engine


@dataclass(frozen=True, slots=True)
class KeptMap:
    """One map file that a map goes on in, session after session."""

    path: Path
    """The file; made when it does not exist."""
    is_frozen: bool = False
    """Whether it stays as it is: a session only finds its place in it."""

    def engine(self, config: Config, *, seed: int) -> Engine:
        """Return an engine that goes on with the map, or begins it.

        Args:
            config: Settings of a map that begins; a known map has its own.
            seed: Seed of all randomness.

        Raises:
            NotFound: If the map is frozen, and there is none.
            InvalidInput: If the file is no map file, is damaged or was written by another version.
        """
        from hmt_service.core.engine import Engine
        from hmt_service.io.map_file import read_map

        if not self.path.exists() and not self.is_frozen:
            return Engine(config, seed=seed)
        return Engine.restored(read_map(self.path), seed=seed, is_frozen=self.is_frozen)

    def write(self, engine: Engine) -> None:
        """Write the map, so that the file holds either the one before or all of this one.

        Raises:
            NotFound: If the folder does not exist.
            Unavailable: If the file system refuses.
        """
        from hmt_service.io.map_file import write_map

        # A link stays one.
        write_map(self.path.resolve(), engine.stored())
