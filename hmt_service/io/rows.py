"""Text files that hold the same number of numbers on every line.

References: own.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hmt_service.core.geometry import FloatArray
from hmt_service.errors import InvalidInput, NotFound


def read_rows(path: Path, *, columns: int) -> Iterator[tuple[str, FloatArray]]:
    """Yield the place (`file:line`) and the numbers, shape (columns,), of every line.

    Empty lines and comments (`#`) are left out.

    Raises:
        NotFound: If the file cannot be opened.
        InvalidInput: If a line does not hold exactly `columns` finite numbers.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise NotFound(f"cannot read {path}: {error.strerror}") from error
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith(b"#"):
            continue
        place = f"{path}:{number}"
        try:
            row = np.array(words, dtype=np.float64)
        except ValueError as error:
            raise InvalidInput(f"{place}: {error}") from error
        if row.size != columns or not np.isfinite(row).all():
            finite = int(np.isfinite(row).sum())
            raise InvalidInput(f"{place}: {finite} finite numbers of {row.size}, not {columns}")
        yield place, row
