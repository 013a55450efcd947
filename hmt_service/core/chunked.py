"""Sequences that are too long to be in memory: a part of them is made when it is asked for.

References:
    own.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from typing import TypeVar, overload

T = TypeVar("T")


class Chunked(Sequence[T]):
    """A sequence of known length, made chunk by chunk; nothing of it is kept."""

    def __init__(self, sizes: Sequence[int], chunk: Callable[[int], Sequence[T]]) -> None:
        """Describe the sequence.

        Args:
            sizes: Number of items of each chunk.
            chunk: Returns the items of one chunk, always the same.
        """
        self._ends = [0, *accumulate(sizes)]
        self._chunk = chunk

    def __len__(self) -> int:
        """Return the number of items of all chunks."""
        return self._ends[-1]

    def __iter__(self) -> Iterator[T]:
        """Iterate over all items; each chunk is made once."""
        return self._between(0, len(self))

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[T, ...]: ...
    def __getitem__(self, index: int | slice) -> T | tuple[T, ...]:
        """Return an item, or a tuple of some next to each other."""
        if isinstance(index, slice):
            first, end, step = index.indices(len(self))
            return tuple(self._between(first, end))[::step]
        position = range(len(self))[index]
        return next(self._between(position, position + 1))

    def _between(self, first: int, end: int) -> Iterator[T]:
        chunk = bisect_right(self._ends, first) - 1
        while first < end:
            start = self._ends[chunk]
            yield from self._chunk(chunk)[first - start : end - start]
            chunk += 1
            first = self._ends[chunk]
