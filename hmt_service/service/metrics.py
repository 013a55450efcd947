"""The status as Prometheus metrics, for whoever watches many robots.

References:
    Prometheus: metric and label naming; exposition formats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from hmt_service.errors import Unavailable
from hmt_service.service.keys import Keys
from hmt_service.service.reports import DaemonState, InputCounts, Status

_HOST = "127.0.0.1"


@contextmanager
def metrics_server(port: int, keys: Keys, status: Callable[[], Status]) -> Iterator[None]:
    """Serve metrics by HTTP on loopback meanwhile, each time as they are then.

    Args:
        port: TCP port.
        keys: Names of the robot, which are labels of `hmt_info`.
        status: Returns what the metrics are made of, at once; called from other threads.

    Raises:
        Unavailable: If the port is taken.
    """
    registry = CollectorRegistry()
    registry.register(StatusCollector(keys, status))
    try:
        server, thread = start_http_server(port, _HOST, registry)
    except OSError as error:
        raise Unavailable(f"no metrics at {_HOST}:{port}: {error}") from error
    try:
        yield
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class StatusCollector(Collector):
    """Turns the status of a daemon into metrics, one family after the other."""

    def __init__(self, keys: Keys, status: Callable[[], Status]) -> None:
        self._keys = keys
        self._status = status

    def collect(self) -> Iterable[Metric]:
        """Yield all metrics."""
        status = self._status()
        labels = {
            "version": status.version,
            "config_hash": status.config_hash,
            "site": self._keys.site,
            "robot": self._keys.robot,
        }
        yield InfoMetricFamily("hmt", "Version, settings and robot of the daemon", labels)
        yield _by_label(
            GaugeMetricFamily(
                "hmt_state", "1 for the phase that the daemon is in", None, ["state"]
            ),
            {state: float(state is status.state) for state in DaemonState},
        )
        yield GaugeMetricFamily("hmt_uptime_seconds", "Time since the start", status.uptime_s)
        yield from _of_input(status.input)
        yield CounterMetricFamily(
            "hmt_scans_tracked", "Scans that the odometry has processed", status.tracked_scans
        )
        yield CounterMetricFamily("hmt_scans_mapped", "Scans in the map", status.processed_scans)
        yield from _of_processes(status)
        yield from _of_map(status)


def _of_input(counts: InputCounts) -> Iterator[Metric]:
    yield CounterMetricFamily("hmt_input_received", "Samples that arrived", counts.received)
    yield _by_label(
        CounterMetricFamily("hmt_input_refused", "Samples refused", None, ["reason"]),
        counts.refused,
    )
    yield CounterMetricFamily(
        "hmt_input_discarded", "Samples thrown away to stop in time", counts.discarded
    )
    yield _by_label(
        CounterMetricFamily(
            "hmt_input_dropped_beams", "Beams left out of accepted scans", None, ["reason"]
        ),
        counts.dropped_beams,
    )
    yield GaugeMetricFamily("hmt_input_queued", "Samples that wait to be decoded", counts.queued)
    yield GaugeMetricFamily("hmt_input_queued_bytes", "Their memory", counts.queued_bytes)
    yield GaugeMetricFamily(
        "hmt_input_reordering", "Readings that wait for earlier ones", counts.reordering
    )


def _of_processes(status: Status) -> Iterator[Metric]:
    processes = {str(process.name): process for process in status.processes}
    yield _by_label(
        GaugeMetricFamily("hmt_process_ready", "1 if it takes work", None, ["process"]),
        {name: float(process.is_ready) for name, process in processes.items()},
    )
    yield _by_label(
        GaugeMetricFamily("hmt_process_backlog", "Messages that wait for it", None, ["process"]),
        {name: float(process.backlog) for name, process in processes.items()},
    )
    yield _by_label(
        CounterMetricFamily(
            "hmt_process_processed", "Readings or scans processed", None, ["process"]
        ),
        {name: float(process.processed) for name, process in processes.items()},
    )
    yield _by_label(
        CounterMetricFamily("hmt_process_busy_seconds", "Time worked", None, ["process"]),
        {name: process.busy_s for name, process in processes.items()},
    )
    yield _by_label(
        CounterMetricFamily(
            "hmt_process_restarts", "Times that it took the place of one", None, ["process"]
        ),
        {name: float(process.restarts) for name, process in processes.items()},
    )


def _of_map(status: Status) -> Iterator[Metric]:
    yield GaugeMetricFamily("hmt_map_revision", "Grows with every change", status.revision)
    yield GaugeMetricFamily("hmt_map_areas", "Areas of the best hypothesis", status.areas)
    yield GaugeMetricFamily("hmt_map_arcs", "Arcs of the best hypothesis", status.arcs)
    yield GaugeMetricFamily("hmt_map_keyframes", "Keyframes in the map", status.keyframes)
    yield GaugeMetricFamily("hmt_map_hypotheses", "Hypotheses alive", status.hypotheses)
    yield GaugeMetricFamily(
        "hmt_map_stored_keyframes", "Keyframes in the map file", status.stored_keyframes
    )
    localization = status.localization
    if localization is None:
        return
    yield GaugeMetricFamily(
        "hmt_localization_probability",
        "Posterior mass of the current area where that has a place in the map",
        localization.probability,
    )
    yield GaugeMetricFamily(
        "hmt_localization_entropy_nats",
        "Entropy of the marginal over areas",
        localization.entropy_nat,
    )
    yield GaugeMetricFamily(
        "hmt_localization_stamp_seconds", "Sensor time of the last keyframe", localization.stamp_s
    )
    if localization.evidence_stamp_s is not None:
        yield GaugeMetricFamily(
            "hmt_localization_evidence_stamp_seconds",
            "Sensor time when the robot last was where it had been before",
            localization.evidence_stamp_s,
        )


def _by_label(
    family: GaugeMetricFamily | CounterMetricFamily, values: Mapping[str, float]
) -> Metric:
    """Return a family with one value per label."""
    for label, value in values.items():
        family.add_metric([label], value)
    return family
