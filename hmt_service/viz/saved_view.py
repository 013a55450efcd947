"""A stored map and what its run has saved, drawn in Rerun.

References:
    own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from hmt_service.core.audit import belief_of
from hmt_service.core.engine import Engine
from hmt_service.core.types import Belief, Event, GlobalMap, MapMethod
from hmt_service.errors import NotFound, Unavailable
from hmt_service.io.audit_files import read_beliefs, read_events
from hmt_service.io.map_file import read_map
from hmt_service.io.saved_run import BELIEFS, EVENTS, MAP
from hmt_service.viz.view import RIVALS, Track, View


@dataclass(frozen=True, slots=True, eq=False)
class SavedView:
    """What there is to see of a map file."""

    engine: Engine
    """The map; nothing goes on with it."""
    maps: tuple[GlobalMap, ...]
    """That of the hypothesis that is shown, and of its most probable rivals."""
    beliefs: tuple[Belief, ...]
    """What was believed over time, if a run has saved that beside the map."""
    events: tuple[Event, ...]
    """What was decided, in the same way."""

    def draw(self, view: View) -> None:
        """Draw all of it."""
        shown = self.maps[0]
        titles = [f"hypothesis {m.hypothesis}, probability {m.probability:.4f}" for m in self.maps]
        view.arrange(titles, shown)
        view.show_maps(self.maps)
        trajectory = self.engine.trajectory_between(
            -math.inf, math.inf, hypothesis=shown.hypothesis
        )
        track = Track.of(trajectory.poses)
        view.show_path(track)
        view.show_robot(track)
        snapshot = self.engine.snapshot()
        if snapshot is not None:
            view.show_posterior(snapshot.posterior)
            view.show_topology(shown, snapshot.posterior.current_area)
            view.show_beliefs(self.beliefs or (belief_of(snapshot.posterior),))
        view.show_events(self.events)


def read_view(path: Path, *, hypothesis: int | None = None) -> SavedView:
    """Read a map, and what was believed and decided where its run has saved that beside it.

    Args:
        path: A map file, or the folder of a run.
        hypothesis: The one to show; None for the most probable.

    Raises:
        NotFound: If there is no such file or hypothesis.
        InvalidInput: If a file is damaged, or the map empty.
        Unavailable: If the map cannot be read now.
    """
    file = path / MAP if path.is_dir() else path
    stored = read_map(file)
    engine = Engine.restored(stored, seed=stored.seed)
    snapshot = engine.snapshot()
    if snapshot is None:
        raise Unavailable(f"{file} is empty")
    every = [h.hypothesis for h in snapshot.posterior.hypotheses]
    if hypothesis is not None and hypothesis not in every:
        raise NotFound(f"hypothesis {hypothesis} is not one of {every}")
    shown = every[0] if hypothesis is None else hypothesis
    rivals = [h for h in every if h != shown][:RIVALS]
    maps = tuple(engine.global_map(MapMethod.CONSISTENT, hypothesis=h) for h in (shown, *rivals))
    beliefs, events = file.with_name(BELIEFS), file.with_name(EVENTS)
    believed = read_beliefs(beliefs) if beliefs.exists() else ()
    if not believed or set(believed[-1].hypotheses) != set(every):
        return SavedView(engine, maps, (), ())  # none, or those of another map
    return SavedView(engine, maps, believed, read_events(events) if events.exists() else ())
