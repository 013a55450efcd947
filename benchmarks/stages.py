"""Time per process of the paper, taken from outside: the core knows no clock.

A stage is the functions that stand for one of the paper's processes. While the clock runs they are
wrapped; time spent in a stage that another one calls counts for the inner one alone, so that the
stages add up to the whole.

References:
    Blanco et al. 2008, section V, Fig. 8 (the processes) and Fig. 9(c) (their times).
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from enum import StrEnum
from typing import Any
from unittest.mock import patch

from hmt_service.core.engine import Engine
from hmt_service.core.graph import PoseGraph
from hmt_service.core.odometry import Odometry
from hmt_service.core.refinement import Refinement
from hmt_service.core.transition import Transition


class Stage(StrEnum):
    """One process of the paper, or what stands beside them."""

    METRIC_SLAM = "metric SLAM"
    AAM = "AAM"
    TSBI = "TSBI"
    WEIGHTS = "weights"
    TLCA = "TLCA"
    GRAPH = "graph"
    REST = "rest"


STAGES: Mapping[Stage, tuple[tuple[type, str], ...]] = {
    Stage.METRIC_SLAM: ((Odometry, "process"),),
    Stage.AAM: ((Engine, "_border"),),
    Stage.TSBI: ((Transition, "successors"),),
    Stage.WEIGHTS: ((Engine, "_weigh"),),
    # The part of it that exists: submaps are aligned once more when a visit is over.
    Stage.TLCA: ((Refinement, "refine"),),
    Stage.GRAPH: ((PoseGraph, "pose"), (PoseGraph, "relative")),
    # Submaps, copies of hypotheses, and everything else that the engine does itself.
    Stage.REST: ((Engine, "process"), (Engine, "finish")),
}
"""The methods of each stage."""


class StageClock:
    """Adds up the time that each stage takes itself."""

    def __init__(
        self,
        stages: Mapping[Stage, tuple[tuple[type, str], ...]] = STAGES,
        now_s: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Start at zero.

        Args:
            stages: The methods of each stage.
            now_s: Any clock.
        """
        self._stages = stages
        self._now_s = now_s
        self._inner_s: list[float] = []
        self.spent_s = dict.fromkeys(stages, 0.0)

    @contextmanager
    def running(self) -> Iterator[None]:
        """Measure all calls of the stages' methods in this block, by whatever object."""
        with ExitStack() as patches:
            for stage, methods in self._stages.items():
                for owner, name in methods:
                    patches.enter_context(
                        patch.object(owner, name, self._timed(stage, getattr(owner, name)))
                    )
            yield

    def _timed(self, stage: Stage, method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def timed(*args: Any, **kwargs: Any) -> Any:
            self._inner_s.append(0.0)
            started_s = self._now_s()
            try:
                return method(*args, **kwargs)
            finally:
                elapsed_s = self._now_s() - started_s
                self.spent_s[stage] += elapsed_s - self._inner_s.pop()
                if self._inner_s:
                    self._inner_s[-1] += elapsed_s

        return timed
