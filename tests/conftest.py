"""Fixtures that every test may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run, however busy the machine: a red test means a change of the code.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def hmt_data() -> Path:
    """Return the folder of recorded logs; without one the test is skipped."""
    name = os.environ.get("HMT_DATA")
    if not name:
        pytest.skip("HMT_DATA does not name the folder of recorded logs")
    if not (folder := Path(name)).is_dir():
        pytest.skip(f"HMT_DATA={name} is not a folder")
    return folder
