"""What a program needs to talk to a daemon: typed calls, typed errors, and a way to send readings.

References:
    own.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar, cast

import zenoh

from hmt_service.core.types import (
    Comparison,
    Event,
    GlobalMap,
    History,
    HmtPose,
    MapMethod,
    OdometryReading,
    Posterior,
    Reading,
)
from hmt_service.errors import AccessDenied, DeadlineExceeded, HmtError, InvalidInput, Unavailable
from hmt_service.service.codec import PREFIX, decode
from hmt_service.service.keys import Call, Control, Input, Keys
from hmt_service.service.readings import encode_reading
from hmt_service.service.reports import Ack, Status
from hmt_service.service.session import client_endpoints, open_session

T = TypeVar("T")


class HmtClient:
    """One connection to the daemon of one robot; a context manager that closes it."""

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        site: str = "site",
        robot: str = "robot",
        timeout_s: float = 10.0,
        zenoh_config: Path | None = None,
    ) -> None:
        """Connect.

        Args:
            endpoint: Zenoh endpoint of the daemon, or of a router that reaches it; None for the
                one that `zenoh_config` names, or `DEFAULT_ENDPOINT`.
            site: Where the robot works.
            robot: Which one it is.
            timeout_s: How long to wait for an answer, wall clock.
            zenoh_config: File of Zenoh settings: certificates or a password.

        Raises:
            InvalidInput: If a name cannot be part of a key, or Zenoh refuses the file.
            NotFound: If there is no such file.
            Unavailable: If nobody listens at the endpoint, or does not let this client in.
        """
        endpoints = client_endpoints(
            endpoint, timeout_s=min(3.0, timeout_s), zenoh_config=zenoh_config
        )
        self._endpoint = ", ".join(endpoints.connect)
        self._keys = Keys(site, robot)
        self._timeout_s = timeout_s
        self._session = open_session(endpoints)
        self._publishers: dict[Input, zenoh.Publisher] = {}

    def __enter__(self) -> Self:
        """Return the client."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the connection."""
        self._session.close()

    def status(self) -> Status:
        """Return the daemon's counters."""
        return self._call(self._keys.call(Call.STATUS), Status)

    def pose(self) -> HmtPose:
        """Return where the robot is."""
        return self._call(self._keys.call(Call.POSE), HmtPose)

    def posterior(self) -> Posterior:
        """Return the belief over topologies."""
        return self._call(self._keys.call(Call.POSTERIOR), Posterior)

    def events(self) -> tuple[Event, ...]:
        """Return the latest events, the oldest first."""
        return self._call(self._keys.call(Call.EVENTS), tuple)

    def history(self) -> History:
        """Return what was believed of where the robot is, over time."""
        return self._call(self._keys.call(Call.HISTORY), History)

    def map(
        self,
        method: MapMethod = MapMethod.CONSISTENT,
        *,
        reference: int | None = None,
        hypothesis: int | None = None,
        with_points: bool = True,
    ) -> GlobalMap:
        """Return a global map.

        Args:
            method: How the poses of the areas are found.
            reference: Area whose frame the map is in; None for the daemon's choice.
            hypothesis: Hypothesis; None for the most probable one.
            with_points: Whether to fetch the submaps.
        """
        parameters = {
            "method": method,
            "reference": reference,
            "hypothesis": hypothesis,
            "points": int(with_points),
        }
        return self._call(self._keys.call(Call.MAP), GlobalMap, parameters)

    def areas(self, *, reference: int | None = None, hypothesis: int | None = None) -> GlobalMap:
        """Return the consistent map without points; the arguments are those of `map`."""
        parameters = {"reference": reference, "hypothesis": hypothesis}
        return self._call(self._keys.call(Call.AREAS), GlobalMap, parameters)

    def compare(self, *, reference: int | None = None, hypothesis: int | None = None) -> Comparison:
        """Return how far both global maps are apart; the arguments are those of `map`."""
        parameters = {"reference": reference, "hypothesis": hypothesis}
        return self._call(self._keys.call(Call.COMPARE), Comparison, parameters)

    def finish(self, *, timeout_s: float = 600.0) -> Ack:
        """Have everything processed that was published here, and the map completed and saved."""
        return self._call(self._keys.control(Control.FINISH), Ack, timeout_s=timeout_s)

    def save(self) -> Ack:
        """Have the map saved as it is."""
        return self._call(self._keys.control(Control.SAVE), Ack)

    def shut_down(self) -> Ack:
        """Have the daemon save the map and end."""
        return self._call(self._keys.control(Control.SHUTDOWN), Ack)

    def publish(self, reading: Reading) -> int:
        """Send a reading; waits while the network or the daemon is behind, and drops nothing.

        Returns:
            The size of what was sent, bytes.

        Raises:
            Unavailable: If nobody takes it, or not from this client.
        """
        message = encode_reading(reading)
        name = Input.ODOMETRY if isinstance(reading, OdometryReading) else Input.SCAN
        self.publish_raw(name, message.payload, message.encoding)
        return len(message.payload)

    def publish_raw(self, name: Input, payload: bytes, encoding: str) -> None:
        """Send any payload as a scan or as odometry.

        Raises:
            Unavailable: If nobody takes it, or not from this client.
        """
        if name not in self._publishers:
            self._publishers[name] = self._publisher(self._keys.input(name))
        self._publishers[name].put(payload, encoding=encoding)

    def _publisher(self, key: str) -> zenoh.Publisher:
        publisher = self._session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
        )
        # Before the daemon's subscription is known here, samples would go nowhere.
        is_matched = threading.Event()
        listener = publisher.declare_matching_listener(lambda _: is_matched.set())
        # The stubs say bool, and the object is always true.
        status = cast(zenoh.MatchingStatus, publisher.matching_status)
        is_there = status.matching or is_matched.wait(self._timeout_s)
        listener.undeclare()
        if not is_there:
            raise self._nobody(key)
        return publisher

    def _call(
        self,
        key: str,
        kind: type[T],
        parameters: Mapping[str, object] | None = None,
        *,
        timeout_s: float | None = None,
    ) -> T:
        """Ask, and return the only answer.

        Raises:
            HmtError: The daemon's, `AccessDenied` when it may not be asked this by this client, or
                `Unavailable` when there is no daemon.
        """
        given = [f"{k}={v}" for k, v in (parameters or {}).items() if v is not None]
        selector = f"{key}?{';'.join(given)}" if given else key
        timeout_s = timeout_s or self._timeout_s
        for reply in self._session.get(selector, timeout=timeout_s):
            answer = reply.result
            if not str(answer.encoding).startswith(PREFIX):
                text = f"{selector} at {self._endpoint}: {answer.payload.to_string()}"
                raise DeadlineExceeded(f"no answer in {timeout_s:g} s: {text}")
            value = decode(answer.payload.to_bytes(), str(answer.encoding))
            if isinstance(value, HmtError):
                raise value
            if not isinstance(value, kind):
                raise InvalidInput(f"{selector} was answered by a {type(value).__name__}")
            return value
        raise self._nobody(selector)

    def _nobody(self, key: str) -> Unavailable:
        name = f"daemon of site {self._keys.site}, robot {self._keys.robot}"
        tokens = self._session.liveliness().get(self._keys.liveliness, timeout=self._timeout_s)
        if any(reply.ok is not None for reply in tokens):
            return AccessDenied(f"the {name} is at {self._endpoint}, and {key} is not granted here")
        return Unavailable(f"nobody answers {key} at {self._endpoint}: no {name}")
