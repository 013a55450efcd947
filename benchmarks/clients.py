"""Clients of a daemon, for processes of their own: one sends, one listens, others ask.

Kept apart from what measures and draws, so that such a process starts fast and takes no memory.

References:
    own. `time.perf_counter` is system-wide: two processes agree on it.
    Tene, How not to measure latency, 2013 (a client that waits must not miss the bad moments).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from itertools import count

from hmt_service.client import HmtClient
from hmt_service.core.types import HmtPose, Reading, Scan
from hmt_service.errors import DeadlineExceeded, InvalidInput, Unavailable
from hmt_service.service.codec import decode
from hmt_service.service.keys import Keys, Topic
from hmt_service.service.session import Endpoints, Mode, open_session

TURN_S = 1.0
"""How long a client asks before it is told to go on or to stop."""
_REST_S = 0.2
_SITE, _ROBOT = "site", "robot"


class Question(StrEnum):
    """What a client asks again and again."""

    POSE = "pose"
    MAP = "map"
    MAP_POINTS = "map_points"


_ASK: Mapping[Question, tuple[Callable[[HmtClient], object], float]] = {
    Question.POSE: (HmtClient.pose, 0.01),
    Question.MAP: (partial(HmtClient.map, with_points=False), 0.5),
    Question.MAP_POINTS: (HmtClient.map, 0.5),
}
"""How, and after what time again, s."""


@dataclass(frozen=True, slots=True)
class Sent:
    """Readings that went through a daemon."""

    put_s: tuple[float, ...]
    """When each was handed to the transport, s of the machine's clock."""
    duration_s: float
    """From the first one to the map completed."""
    processed: int
    """Scans in the map then."""


def rest(_: int) -> None:
    """Do nothing for long enough that each of some idle processes gets one rest of them all."""
    time.sleep(_REST_S)


def send(endpoint: str, readings: Sequence[Reading], *, is_paced: bool) -> Sent:
    """Publish readings, then have the map completed.

    Args:
        endpoint: Where the daemon listens.
        readings: In the order of time.
        is_paced: Whether each is sent when its time has come; otherwise as fast as they go.
    """
    put_s = []
    with HmtClient(endpoint, site=_SITE, robot=_ROBOT) as client:
        started_s = time.perf_counter()
        for reading in readings:
            if is_paced:
                due_s = started_s + reading.stamp_s - readings[0].stamp_s
                time.sleep(max(0.0, due_s - time.perf_counter()))
            put_s.append(time.perf_counter())
            client.publish(reading)
        processed = client.finish().processed_scans
        return Sent(tuple(put_s), time.perf_counter() - started_s, processed)


def send_forever(
    endpoint: str,
    readings: Sequence[Reading],
    is_over: Callable[[], bool],
    *,
    later_s: float = 0.0,
) -> int:
    """Publish readings when their time has come, again and again, until told; return the scans.

    Args:
        endpoint: Where the daemon listens; it may be gone for a while.
        readings: In the order of time.
        is_over: Says when to stop.
        later_s: What to add to their stamps.
    """
    scans, lap_s = 0, readings[-1].stamp_s - readings[0].stamp_s + 1.0
    with HmtClient(endpoint, site=_SITE, robot=_ROBOT) as client:
        started_s = time.perf_counter()
        for lap in count():
            for reading in readings:
                due_s = reading.stamp_s - readings[0].stamp_s + lap * lap_s
                time.sleep(max(0.0, started_s + due_s - time.perf_counter()))
                if is_over():
                    return scans
                # What nobody takes is gone, as with any sensor.
                with suppress(Unavailable):
                    client.publish(replace(reading, stamp_s=later_s + due_s))
                    scans += isinstance(reading, Scan)
    return scans


@contextmanager
def received_poses(endpoint: str) -> Iterator[list[tuple[float, bytes, str]]]:
    """Collect when each published pose arrives, with its payload and encoding, until the end."""
    received: list[tuple[float, bytes, str]] = []
    with open_session(Endpoints(mode=Mode.CLIENT, connect=(endpoint,))) as session:
        subscriber = session.declare_subscriber(
            Keys(_SITE, _ROBOT).topic(Topic.POSE),
            lambda sample: received.append(
                (time.perf_counter(), sample.payload.to_bytes(), str(sample.encoding))
            ),
        )
        yield received
        subscriber.undeclare()


def stamp_of(payload: bytes, encoding: str) -> float:
    """Return the stamp of a published pose, s.

    Raises:
        InvalidInput: If something else was published.
    """
    pose = decode(payload, encoding)
    if not isinstance(pose, HmtPose):
        raise InvalidInput(f"a {type(pose).__name__} was published as a pose")
    return pose.stamp_s


def ask(endpoint: str, question: Question, *, for_s: float = TURN_S) -> list[float]:
    """Ask one question at its pace for one turn; return how long each answer took, s."""
    call, period_s = _ASK[question]
    with HmtClient(endpoint, site=_SITE, robot=_ROBOT) as client:
        return paced(lambda: call(client), period_s=period_s, for_s=for_s)


def ask_together(
    endpoint: str, question: Question, *, clients: int, period_s: float, for_s: float
) -> list[float]:
    """Ask one question with several clients, each at the same pace.

    Args:
        endpoint: Where the daemon listens.
        question: What all of them ask.
        clients: How many there are; their turns are spread over the period.
        period_s: Time between two questions of one of them.
        for_s: Time after which no question has its turn.

    Returns:
        How long each answer took, s.
    """
    call, _ = _ASK[question]

    def one(number: int) -> list[float]:
        time.sleep(number * period_s / clients)
        with HmtClient(endpoint, site=_SITE, robot=_ROBOT) as client:
            return paced(lambda: call(client), period_s=period_s, for_s=for_s)

    with ThreadPoolExecutor(clients) as threads:
        return [latency_s for each in threads.map(one, range(clients)) for latency_s in each]


def paced(
    call: Callable[[], object],
    *,
    period_s: float,
    for_s: float,
    now: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], object] = time.sleep,
) -> list[float]:
    """Ask at a steady pace, and return how long each answer took, s.

    A question whose turn came while another one was not answered yet counts from its turn on: a
    slow answer is slow for everybody who would have asked meanwhile.

    Args:
        call: Asks once; a question that has no answer yet (`Unavailable`) does not count.
        period_s: Time between two questions.
        for_s: Time after which no question has its turn.
        now: The clock, s.
        sleep: Waits, s.
    """
    latencies_s = []
    due_s = now()
    ending_s = due_s + for_s
    while due_s < ending_s:
        asked_s, early_s = due_s, due_s - now()
        if early_s > 0.0:
            sleep(early_s)
            asked_s = now()  # to sleep too long is this client's own fault
        # What was waited for in vain counts as long as the wait was.
        with suppress(Unavailable):
            with suppress(DeadlineExceeded):
                call()
            latencies_s.append(now() - asked_s)
        due_s += period_s
    return latencies_s
