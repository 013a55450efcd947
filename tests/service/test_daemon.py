"""A running daemon: it maps what comes in, and nothing that comes in brings it down."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from hmt_service.client import HmtClient
from hmt_service.core.config import load_config
from hmt_service.core.engine import Engine
from hmt_service.core.geometry import planar_pose
from hmt_service.core.odometry import Odometry
from hmt_service.core.types import MapMethod, OdometryReading, Reading, Scan
from hmt_service.errors import HmtError, InvalidInput, NotFound, Unavailable
from hmt_service.io.trajectory import read_tum
from hmt_service.service.codec import decode
from hmt_service.service.keys import Input
from hmt_service.service.readings import encode_reading
from hmt_service.service.session import Endpoints, Mode, open_session
from tests.flat import SETTINGS, readings
from tests.messages import laser_scan
from tests.service.harness import RunningDaemon, as_received, running_daemon, wait_until

SCANS = 200
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningDaemon]:
    """Return a daemon that has mapped the flat."""
    with running_daemon(tmp_path_factory.mktemp("daemon") / "out") as daemon:
        with daemon.client() as client:
            for call in (
                client.pose,
                client.posterior,
                client.hypotheses,
                client.map,
                client.trajectory,
                client.compare,
            ):
                with pytest.raises(Unavailable, match="keyframe"):
                    call()
            for reading in readings(SCANS):
                client.publish(reading)
            ack = client.finish()
            assert (ack.received, ack.accepted, ack.refused) == (2 * SCANS, 2 * SCANS, 0)
            assert ack.processed_scans == SCANS
            assert ack.files == (
                "trajectory.tum",
                "map.hmt",
                "events.jsonl",
                "posterior.jsonl",
                "summary.json",
            )
        yield daemon


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[HmtClient]:
    with daemon.client() as client:
        yield client


@pytest.fixture(scope="module")
def offline() -> Engine:
    """Return the map that one process makes of what the daemon receives, to the last bit."""
    config = load_config(text=SETTINGS)
    odometry, engine = Odometry(config), Engine(config)
    for reading in readings(SCANS):
        if (tracking := odometry.process(as_received(reading, config.sensor))) is not None:
            engine.process(tracking)
    engine.finish()
    return engine


# ------------------------------------------------------------------ what it is for


def test_the_map_is_that_of_the_offline_run(client: HmtClient, offline: Engine) -> None:
    for method in MapMethod:
        mine, theirs = client.map(method), offline.global_map(method)
        assert (mine.method, mine.reference_area) == (theirs.method, theirs.reference_area)
        assert len(mine.arcs) == len(theirs.arcs)
        for a, b in zip(mine.areas, theirs.areas, strict=True):
            assert (a.area, a.keyframes, a.visits) == (b.area, b.keyframes, b.visits)
            np.testing.assert_allclose(
                a.reference_from_area.mean, b.reference_from_area.mean, atol=1e-9
            )
            np.testing.assert_allclose(a.points_in_area, b.points_in_area, atol=1e-6)


def test_the_trajectory_on_disk_is_that_of_the_offline_run(
    daemon: RunningDaemon, offline: Engine
) -> None:
    saved, expected = read_tum(daemon.out / "trajectory.tum"), offline.trajectory()
    assert [p.stamp_s for p in saved] == pytest.approx([p.stamp_s for p in expected], abs=1e-6)
    for a, b in zip(saved, expected, strict=True):
        np.testing.assert_allclose(a.reference_from_body, b.reference_from_body, atol=1e-8)


def test_the_pose_is_that_of_the_last_scan(client: HmtClient, offline: Engine) -> None:
    pose, last = client.pose(), offline.trajectory()[-1]
    assert pose.stamp_s == last.stamp_s
    np.testing.assert_allclose(pose.reference_from_body.mean, last.reference_from_body, atol=1e-9)
    assert pose.probability == pytest.approx(client.posterior().current_area[pose.area])


def test_areas_are_the_map_without_points(client: HmtClient) -> None:
    areas, whole = client.areas(), client.map()
    assert [a.area for a in areas.areas] == [a.area for a in whole.areas]
    assert all(len(a.points_in_area) == 0 for a in areas.areas)
    assert all(len(a.points_in_area) > 0 for a in whole.areas)


def test_a_map_can_be_asked_for_in_the_frame_of_any_area(client: HmtClient) -> None:
    for area in client.areas().areas:
        answer = client.map(reference=area.area, with_points=False)
        here = next(a for a in answer.areas if a.area == area.area)
        np.testing.assert_allclose(here.reference_from_area.mean, np.eye(4), atol=1e-9)
        assert client.compare(reference=area.area).reference_area == area.area


def test_events_are_kept(client: HmtClient, offline: Engine) -> None:
    entered = [event for event in client.events() if event.kind == "area_entered"]
    assert len(entered) >= len(offline.global_map(MapMethod.CONSISTENT).areas)


def test_the_counters_add_up(client: HmtClient) -> None:
    status = client.status()
    counts = status.input
    assert counts.received == counts.accepted + sum(counts.refused.values()) + counts.queued
    assert status.tracked_scans == status.processed_scans >= SCANS
    assert [process.name for process in status.processes] == ["odometry", "topology"]
    assert all(process.is_ready and process.backlog == 0 for process in status.processes)
    assert status.config_hash == load_config(text=SETTINGS).hash()


def test_the_gateway_never_loads_what_holds_the_interpreter(daemon: RunningDaemon) -> None:
    """One registration in this process would freeze every answer."""
    maps = Path(f"/proc/{daemon.process.pid}/maps")
    if not maps.exists():
        pytest.skip("no /proc")
    loaded = maps.read_text()
    assert "zenoh" in loaded
    assert not [name for name in ("/gtsam", "/kiss_icp", "/open3d", "/scipy/") if name in loaded]


# ------------------------------------------------------------------ wrong questions


def ask(daemon: RunningDaemon, selector: str) -> HmtError | None:
    """Return the error that a selector below the robot's key is answered with."""
    endpoints = Endpoints(mode=Mode.CLIENT, connect=(daemon.endpoint,))
    with open_session(endpoints) as session:
        replies = list(session.get(f"hmt/site/robot/{selector}", timeout=5.0))
    assert len(replies) == 1
    answer = replies[0].result
    value = decode(answer.payload.to_bytes(), str(answer.encoding))
    return value if isinstance(value, HmtError) else None


@pytest.mark.parametrize(
    ("selector", "kind", "words"),
    [
        ("ro/map?method=teleport", InvalidInput, "teleport"),
        ("ro/map?reference=-1", InvalidInput, "-1"),
        ("ro/map?reference=0.5", InvalidInput, "0.5"),
        ("ro/map?reference=", InvalidInput, "reference"),
        ("ro/map?hypothesis=best", InvalidInput, "best"),
        ("ro/map?colour=red", InvalidInput, "colour"),
        ("ro/map?reference=4711", NotFound, "4711"),
        ("ro/map?reference=999999999999999999", NotFound, "999999999999999999"),
        ("ro/map?reference=" + "9" * 5000, InvalidInput, "18 digits"),
        ("ro/map?hypothesis=4711", NotFound, "4711"),
        ("ro/compare?reference=4711", NotFound, "4711"),
        ("ro/compare?method=consistent", InvalidInput, "method"),
        ("ro/areas?points=1", InvalidInput, "points"),
        ("ro/status?reference=1", InvalidInput, "reference"),
        ("ro/map?known=1", InvalidInput, "area:version"),
        ("ro/map?deadline=-1", InvalidInput, "deadline"),
        ("ro/map?part_bytes=1", InvalidInput, "part_bytes"),
        ("ro/area", InvalidInput, "area=IDENTIFIER"),
        ("ro/area?area=4711", NotFound, "4711"),
        ("ro/area?area=0;reference=4711", NotFound, "4711"),
        ("ro/hypotheses?hypothesis=0", InvalidInput, "hypothesis"),
        ("ro/trajectory?from=yesterday", InvalidInput, "yesterday"),
        ("ro/trajectory?hypothesis=4711", NotFound, "4711"),
        ("ro/everything", NotFound, "everything"),
        ("ro/*", InvalidInput, "several"),
        ("@ctl/explode", NotFound, "explode"),
        ("@ctl/save?now=1", InvalidInput, "now"),
    ],
)
def test_a_wrong_question_gets_a_typed_answer(
    daemon: RunningDaemon, selector: str, kind: type[HmtError], words: str
) -> None:
    error = ask(daemon, selector)
    assert type(error) is kind
    assert words in str(error)


def test_parameters_of_zenoh_itself_are_let_pass(daemon: RunningDaemon) -> None:
    assert ask(daemon, "ro/status?_time=[now(-1h)..]") is None


# ------------------------------------------------------------------ wrong input


LASER = "application/protobuf;foxglove.LaserScan"
CLOUD = "application/protobuf;foxglove.PointCloud"


def laser(ranges: list[float], *, frame_id: str = "body", stamp_s: float = 5000.0) -> bytes:
    message = laser_scan(ranges, stamp_s=stamp_s)
    message.frame_id = frame_id
    return message.SerializeToString()


def ten_million_points() -> bytes:
    points = np.ones((10_000_000, 3))
    return encode_reading(Scan(5000.0, points, np.zeros(3))).payload


@pytest.mark.parametrize(
    ("name", "build", "encoding", "reason"),
    [
        (Input.SCAN, lambda: np.random.default_rng(1).bytes(3000), LASER, "not_protobuf"),
        (Input.SCAN, lambda: laser([1.0] * 50)[:-7], LASER, "not_protobuf"),
        (Input.SCAN, lambda: laser([NAN] * 50), LASER, "nan_ranges"),
        (Input.SCAN, lambda: laser([-INF] * 50), LASER, "negative_ranges"),
        (Input.SCAN, lambda: laser([-1.0] * 50), LASER, "negative_ranges"),
        (Input.SCAN, lambda: laser([]), LASER, "empty"),
        (Input.SCAN, lambda: b"", LASER, "bad_stamp"),
        (Input.SCAN, lambda: laser([1.0], stamp_s=1.0), LASER, "time_backwards"),
        (Input.SCAN, lambda: laser([1.0], frame_id="map"), LASER, "wrong_frame"),
        (Input.SCAN, lambda: laser([1.0]), "text/plain", "wrong_encoding"),
        (Input.ODOMETRY, lambda: laser([1.0]), LASER, "wrong_encoding"),
        (Input.SCAN, ten_million_points, CLOUD, "too_large"),
    ],
)
def test_wrong_input_is_refused_counted_and_survived(
    client: HmtClient, name: Input, build: Callable[[], bytes], encoding: str, reason: str
) -> None:
    before, pose = client.status().input, client.pose()
    client.publish_raw(name, build(), encoding)
    wait_until(
        lambda: client.status().input.refused.get(reason, 0) == before.refused.get(reason, 0) + 1
    )
    assert client.status().input.accepted == before.accepted
    assert client.pose().stamp_s == pose.stamp_s
    assert len(client.map().areas) > 0


def test_refused_input_becomes_an_event(client: HmtClient) -> None:
    client.publish_raw(Input.SCAN, b"\xff", LASER)
    wait_until(
        lambda: any(
            event.kind == "input_dropped" and "not_protobuf" in event.message
            for event in client.events()
        )
    )


def test_input_under_an_unknown_key_is_refused(daemon: RunningDaemon, client: HmtClient) -> None:
    endpoints = Endpoints(mode=Mode.CLIENT, connect=(daemon.endpoint,))
    with open_session(endpoints) as session:
        session.put("hmt/site/robot/in/sonar", b"ping")
        session.delete("hmt/site/robot/in/scan")
        wait_until(lambda: client.status().input.refused.get("unknown_key") == 2)


def test_odd_input_that_is_no_error_is_survived(client: HmtClient) -> None:
    """Scans that see next to nothing, and wheels that jump to the other end of the world."""
    last = client.pose().stamp_s
    odd: list[Reading] = [
        Scan(last + 1.0, np.zeros((1, 3)), np.zeros(3)),
        Scan(last + 2.0, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.zeros(3)),
        Scan(last + 3.0, np.full((500, 3), 1.0), np.zeros(3)),
        OdometryReading(last + 3.5, planar_pose(9e6, -9e6, 3.0)),
    ]
    accepted = client.status().input.accepted
    for reading in odd:
        client.publish(reading)
    client.publish_raw(Input.SCAN, laser([INF] * 50, stamp_s=last + 4.0), LASER)
    client.finish()
    assert client.status().input.accepted == accepted + 5
    assert client.pose().stamp_s == pytest.approx(last + 4.0)
    assert len(client.map().areas) > 0
