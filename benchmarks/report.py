"""What every benchmark is given and returns.

References: own.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from benchmarks.cells import Cells, Result
from benchmarks.metric import Metric


@dataclass(frozen=True, slots=True)
class Report:
    """What a benchmark has measured, and what it has not."""

    metrics: tuple[Metric, ...]
    """The numbers; their keys begin with what was measured on."""
    skipped: tuple[str, ...] = ()
    """One sentence for everything left out."""
    figures: tuple[Path, ...] = ()
    """Pictures of the numbers, in `Run.out`."""


@dataclass(frozen=True, slots=True)
class Run:
    """How a benchmark is to run."""

    is_quick: bool
    """Whether to measure on less."""
    say: Callable[[str], None]
    """Shows a person what is being done."""
    out: Path
    """Folder for figures; exists."""
    cells: Cells
    """Results of units of work."""

    def once(self, key: str, compute: Callable[[], Result]) -> Result:
        """Return the result of one unit of work, computed unless a resumed run has it.

        Args:
            key: Name of the unit within this benchmark, parts separated by `/`.
            compute: The work.
        """
        return self.once_each({key: compute})[key]

    def once_each(
        self, units: Mapping[str, Callable[[], Result]], *, jobs: int | None = None
    ) -> dict[str, Result]:
        """Return the results of many units of work, in the order of the units.

        Args:
            units: The work by the name of the unit; with jobs, it must be possible to pickle it.
            jobs: How many processes share the work; None: this one does all of it. What is timed
                must not be shared.
        """
        results = {key: result for key in units if (result := self.cells.read(key)) is not None}
        waiting = {key: compute for key, compute in units.items() if key not in results}
        if jobs is None:
            for key, compute in waiting.items():
                self._say_progress(key, len(results), len(units))
                results[key] = compute()
                self.cells.write(key, results[key])
        elif waiting:
            with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
                futures = {pool.submit(compute): key for key, compute in waiting.items()}
                self._say_progress(next(iter(waiting)), len(results), len(units))
                for future in as_completed(futures):
                    key = futures[future]
                    results[key] = future.result()
                    self.cells.write(key, results[key])
                    self._say_progress(f"after {key}", len(results), len(units))
        return {key: results[key] for key in units}

    def _say_progress(self, key: str, done: int, total: int) -> None:
        self.say(f"{key}, {done} of {total} done" if total > 1 else key)
