"""The shelf of visits on the disk: a private database that disappears with the process.

References:
    own; https://www.sqlite.org/inmemorydb.html (temporary databases).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from io import BytesIO

import numpy as np

from hmt_service.core.geometry import GaussianPose
from hmt_service.core.types import Keyframe, TrackingFailure
from hmt_service.errors import Unavailable


class DiskShelf:
    """Keyframes of visits in a temporary file, where SQLite puts it (`SQLITE_TMPDIR`, `TMPDIR`)."""

    def __init__(self) -> None:
        """Prepare; nothing is opened, so that it can be handed to another process."""
        self._database: sqlite3.Connection | None = None
        self._size_bytes = 0

    @property
    def size_bytes(self) -> int:
        """What lies there."""
        return self._size_bytes

    def put(self, visit: int, keyframes: Sequence[Keyframe]) -> None:
        """Keep the keyframes of a visit.

        Raises:
            Unavailable: If the disk is full.
        """
        data = _dumped(keyframes)
        try:
            self._opened().execute("INSERT INTO visits VALUES (?, ?)", (visit, data))
        except sqlite3.OperationalError as error:
            raise Unavailable(
                f"{len(data)} bytes of visit {visit} beside {self._size_bytes} bytes of others do "
                f"not fit into the folder for temporary files: {error}"
            ) from error
        self._size_bytes += len(data)

    def get(self, visit: int) -> tuple[Keyframe, ...]:
        """Return them, the same in every bit."""
        query = self._opened().execute("SELECT keyframes FROM visits WHERE visit = ?", (visit,))
        return _loaded(query.fetchone()[0])

    def _opened(self) -> sqlite3.Connection:
        if self._database is None:
            # No name: a file that is removed as soon as it is open.
            self._database = sqlite3.connect("", isolation_level=None)
            # What does not fit is taken back.
            self._database.execute("PRAGMA journal_mode = MEMORY")
            self._database.execute(
                "CREATE TABLE visits (visit INTEGER PRIMARY KEY, keyframes BLOB NOT NULL) STRICT"
            )
        return self._database


def _dumped(keyframes: Sequence[Keyframe]) -> bytes:
    columns = (
        np.array([k.index for k in keyframes]),
        np.array([k.stamp_s for k in keyframes]),
        np.array([k.failure or "" for k in keyframes], dtype=np.str_),
        np.array([k.sensor_in_body for k in keyframes]),
        np.array([k.previous_from_body.mean for k in keyframes]),
        np.array([k.previous_from_body.covariance for k in keyframes]),
        np.array([k.own_error for k in keyframes]),
        # Each by itself: the order of its numbers in memory decides the last bit of sums, too.
        *(k.points_in_body for k in keyframes),
    )
    file = BytesIO()
    for column in columns:
        np.save(file, column, allow_pickle=False)
    return file.getvalue()


def _loaded(data: bytes) -> tuple[Keyframe, ...]:
    file = BytesIO(data)
    indices, stamps_s, failures, sensors, means, covariances, own_errors = (
        np.load(file, allow_pickle=False) for _ in range(7)
    )
    return tuple(
        Keyframe(
            index=int(indices[position]),
            stamp_s=float(stamps_s[position]),
            points_in_body=np.load(file, allow_pickle=False),
            sensor_in_body=sensors[position],
            previous_from_body=GaussianPose(means[position], covariances[position]),
            own_error=own_errors[position],
            failure=TrackingFailure(failure) if failure else None,
        )
        for position, failure in enumerate(failures.tolist())
    )
