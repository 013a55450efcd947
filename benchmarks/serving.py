"""The one way in which benchmarks run a daemon: `hmt serve` in processes of its own.

References: own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from hmt_service.client.local import local_daemon
from hmt_service.errors import DaemonFailure


@contextmanager
def serving(*options: str) -> Iterator[str]:
    """Run `hmt serve` as `local_daemon` does, silently.

    Raises:
        DaemonFailure: If it ends or is not ready in time; with all that it has printed.
    """
    is_ready = False
    with tempfile.TemporaryFile("w+") as output:
        try:
            with local_daemon(*options, output=output) as endpoint:
                is_ready = True
                yield endpoint
        except DaemonFailure as failure:
            if is_ready:
                raise
            output.seek(0)
            raise DaemonFailure(f"{failure}: {output.read().strip()}") from None
