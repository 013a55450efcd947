"""Budgets so small that nearly all of a map is on the shelf."""

from __future__ import annotations

from unittest.mock import patch

from hmt_service.core.visits import MemoryBudget
from hmt_service.io.shelf import DiskShelf


def tiny(size_bytes: int = 1, shelf: DiskShelf | None = None) -> MemoryBudget:
    """Return a budget below the least one."""
    with patch("hmt_service.core.visits.LEAST_BUDGET_BYTES", 0):
        return MemoryBudget(size_bytes, shelf or DiskShelf())
