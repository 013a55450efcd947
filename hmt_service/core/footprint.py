"""How much memory values take.

References:
    own.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass

import numpy as np

from hmt_service.core.config import Config

# What the allocator adds to an object, about.
_OVERHEAD_BYTES = 16


def footprint_bytes(value: object) -> int:
    """Return the memory of a value and all that it consists of, the settings excepted."""
    seen, waiting, total = set[int](), [value], 0
    while waiting:
        part = waiting.pop()
        if id(part) not in seen and not isinstance(part, Config):
            seen.add(id(part))
            total += sys.getsizeof(part) + _OVERHEAD_BYTES
            waiting.extend(_parts(part))
    return total


def _parts(value: object) -> Iterator[object]:
    if isinstance(value, np.ndarray):
        # The numbers of a view are those of another array.
        if value.base is not None:
            yield value.base
    elif isinstance(value, tuple | list):
        yield from value
    elif isinstance(value, dict):
        yield from value.values()
    elif hasattr(value, "__dict__"):
        yield vars(value)
    elif is_dataclass(value):
        yield from (getattr(value, field.name) for field in fields(value))
