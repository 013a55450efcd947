"""`hmt view`: what is believed, in the viewer Rerun; of a map file, or live of a daemon.

References: own.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from hmt_service.cli.connection import Connect, Robot, Site, Timeout, ZenohConfig, connected
from hmt_service.errors import DeadlineExceeded, InvalidInput, NotFound, Unavailable

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console

    from hmt_service.client import HmtClient, Live
    from hmt_service.core.types import GlobalMap, Posterior
    from hmt_service.viz.view import View

T = TypeVar("T")

WEB_PORT = 9090
_WAIT_S = 0.1
_BETWEEN_MAPS_S = 1.0
"""How often maps are asked for while they change."""
_PATH_POINTS = 5000


def view(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]", help="Map file, or the folder of a run; a daemon if not given."
        ),
    ] = None,
    connect: Connect = None,
    site: Site = "site",
    robot: Robot = "robot",
    zenoh_config: ZenohConfig = None,
    timeout: Timeout = 10.0,
    hypothesis: Annotated[
        int | None,
        typer.Option(min=0, help="Hypothesis to show; the most probable one if not given."),
    ] = None,
    save: Annotated[
        Path | None, typer.Option(help="Recording to write, such as view.rrd, instead of showing.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve a page for browsers on this machine instead.")
    ] = False,
    port: Annotated[
        int,
        typer.Option(min=1024, max=65534, help="Port of that page; the next one is used, too."),
    ] = WEB_PORT,
) -> None:
    """Show the map, its rivals with their probabilities, the belief over time, and the robot.

    Of a daemon it is live, until Ctrl-C or until the window is closed. Needs the extra `view`.
    """
    from rich.console import Console

    if save is not None and web:
        raise InvalidInput("--save writes a file, --web serves a page: give one of both")
    console, page_port = Console(stderr=True), port if web else None
    drawn = _new_view(str(file or f"{site}/{robot}"))
    with suppress(KeyboardInterrupt), _stopped_by_sigterm():
        if file is not None:
            from hmt_service.viz.saved_view import read_view

            saved = read_view(file, hypothesis=hypothesis)
            with _shown(drawn, save, page_port, console, is_live=False) as is_open:
                saved.draw(drawn)
                while is_open():
                    time.sleep(_WAIT_S)
            return
        with connected(connect, site, robot, zenoh_config, timeout_s=timeout) as client:
            client.status()  # that there is a daemon
            with (
                _shown(drawn, save, page_port, console, is_live=True) as is_open,
                suppress(KeyboardInterrupt),  # the usual end, after which a recording is complete
            ):
                LiveView(client, drawn, hypothesis).run(is_open)


class LiveView:
    """Draws what a daemon publishes, and asks for what has changed."""

    def __init__(self, client: HmtClient, view: View, hypothesis: int | None) -> None:
        """Prepare.

        Args:
            client: Connection to the daemon.
            view: Where to draw.
            hypothesis: The one to show as long as it lives; None for the most probable.
        """
        self._client = client
        self._view = view
        self._hypothesis = hypothesis
        self._maps: dict[int, GlobalMap] = {}
        self._shown: GlobalMap | None = None
        self._next_s = 0.0

    @property
    def revision(self) -> int | None:
        """Revision of the map that is drawn; None before the first."""
        return None if self._shown is None else self._shown.revision

    def run(self, is_open: Callable[[], bool]) -> None:
        """Draw until the viewer is closed.

        Raises:
            NotFound: If the hypothesis does not exist at the beginning.
            Unavailable: If the daemon is gone by then.
        """
        from hmt_service.core.audit import belief_of
        from hmt_service.core.types import StampedPose
        from hmt_service.viz.view import Track

        with (
            self._client.poses_live() as poses,
            self._client.posteriors_live() as posteriors,
            self._client.events_live() as events,
        ):
            newest = self._begin()
            while is_open():
                for posterior in _waiting(posteriors):
                    newest = posterior
                    self._view.show_beliefs([belief_of(posterior)])
                self._view.show_events(_waiting(events))
                moved = [
                    StampedPose(pose.stamp_s, pose.reference_from_body.mean)
                    for pose in _waiting(poses, _WAIT_S)
                ]
                self._view.show_robot(Track.of(moved))
                self._follow(newest)

    def _begin(self) -> Posterior | None:
        """Draw what has been, and return what is believed now; None before the first keyframe."""
        from hmt_service.viz.view import RIVALS

        rivals = [f"rival {number}" for number in range(1, RIVALS + 1)]
        self._view.arrange(["the map", *rivals])
        self._view.show_beliefs(self._client.history().beliefs)
        self._view.show_events(self._client.events())
        try:
            posterior = self._client.posterior()
        except DeadlineExceeded:
            raise
        except Unavailable:
            return None
        known = [h.hypothesis for h in posterior.hypotheses]
        if self._hypothesis is not None and self._hypothesis not in known:
            raise NotFound(f"hypothesis {self._hypothesis} is not one of {known}")
        return posterior

    def _follow(self, newest: Posterior | None) -> None:
        """Draw the maps again if they have changed and that was not just done."""
        is_new = newest is not None and (
            self._shown is None or newest.revision > self._shown.revision
        )
        if newest is None or not is_new or time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _BETWEEN_MAPS_S
        # A hypothesis that ends meanwhile, or a daemon that is restarted, is asked again later.
        with suppress(NotFound, Unavailable):
            self._draw(newest)

    def _draw(self, newest: Posterior) -> None:
        from hmt_service.viz.view import RIVALS, Track

        every = [h.hypothesis for h in newest.hypotheses]
        shown = self._hypothesis if self._hypothesis in every else every[0]
        chosen = [shown, *(h for h in every if h != shown)][: 1 + RIVALS]
        maps = []
        for each in chosen:
            # Submaps of one hypothesis are mostly those of the others.
            known = self._maps.get(each, self._shown)
            maps.append(self._client.map(hypothesis=each, known=known))
        self._maps, self._shown = dict(zip(chosen, maps, strict=True)), maps[0]
        self._view.show_maps(maps)
        self._view.show_posterior(newest)
        self._view.show_topology(maps[0], newest.current_area)
        poses = self._client.trajectory(hypothesis=shown).poses
        step = 1 + len(poses) // _PATH_POINTS
        self._view.show_path(Track.of(poses[::step]))


def _new_view(name: str) -> View:
    # When its window is closed Rerun logs errors; whether the viewer has failed is asked below.
    os.environ.setdefault("RUST_LOG", "off")
    try:
        from hmt_service.viz.view import View
    except ModuleNotFoundError as error:
        raise Unavailable(
            f"the view needs rerun-sdk ({error}): pip install 'hmt-service[view]'"
        ) from error
    return View(name)


@contextmanager
def _shown(
    drawn: View, save: Path | None, port: int | None, console: Console, *, is_live: bool
) -> Iterator[Callable[[], bool]]:
    """Send what is drawn where it is wanted; yields whether anybody still looks."""
    from hmt_service.io.whole_files import whole_files
    from hmt_service.viz.viewer import page, window

    if save is not None:
        with whole_files(save) as (part,):
            if is_live:
                drawn.save(part)
                yield lambda: True
                drawn.disconnect()
            else:
                recorded = drawn.stream()
                yield lambda: False
                part.write_bytes(recorded())
        console.print(f"saved {save}", soft_wrap=True, markup=False)
        return
    with window() if port is None else page(port) as viewer:
        drawn.connect(viewer.sink)
        if port is not None:
            typer.echo(viewer.page)
        try:
            yield lambda: viewer.is_open
        finally:
            drawn.disconnect()


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Have the viewer closed when this program is told to end."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _waiting(live: Live[T], wait_s: float = 0.0) -> Iterator[T]:
    """Yield what has been published, and wait for the first if there is none."""
    with suppress(DeadlineExceeded):
        yield live.next(wait_s)
        while True:
            yield live.next(0.0)
