"""Files that appear as a whole or not at all.

References:
    own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hmt_service.errors import NotFound, Unavailable


@contextmanager
def whole_files(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Yield a path beside each one to write to; they get their names when the block has ended.

    After an error nothing is left, and what was there before is still there.

    Args:
        paths: Files to write or replace; the last one gets its name last.

    Raises:
        NotFound: If a folder does not exist.
        Unavailable: If the file system refuses.
    """
    for path in paths:
        if not path.parent.is_dir():
            raise NotFound(f"folder {path.parent} of {path.name} does not exist")
        if path.is_dir():
            raise Unavailable(f"{path} is a folder: no file can be written there")
    parts = tuple(path.with_name(f"{path.name}.part") for path in paths)
    try:
        yield parts
        for part, path in zip(parts, paths, strict=True):
            part.replace(path)
    except OSError as error:
        names = ", ".join(map(str, paths))
        raise Unavailable(f"{names} not written: {error.strerror}") from error
    finally:
        for part in parts:
            part.unlink(missing_ok=True)
