"""Both clients against a running daemon; every test adds scans to the drive of the ones before."""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
import threading
import urllib.request
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import zenoh
from prometheus_client.parser import text_string_to_metric_families

from hmt_service.client import AsyncHmtClient, HmtClient
from hmt_service.client.local import free_endpoint
from hmt_service.core.types import EventKind, GlobalMap, OdometryReading, Reading
from hmt_service.errors import DeadlineExceeded, InvalidInput, NotFound, Unavailable
from hmt_service.io.trajectory import read_tum
from hmt_service.service.codec import decode, decode_place
from hmt_service.service.keys import Input
from hmt_service.service.session import Endpoints, Mode, open_session
from tests.flat import readings
from tests.service.harness import DEADLINE_S, RunningDaemon, running_daemon, wait_until

SCANS = 200
ROOT = Path(__file__).parents[2]
PROGRAMS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
METRICS_PORT = int(free_endpoint().rpartition(":")[2])


class Drive:
    """The readings of one drive, some at a time."""

    def __init__(self) -> None:
        self._readings = iter(readings(2000))

    def next(self, scans: int) -> list[Reading]:
        return list(islice(self._readings, 2 * scans))


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory, drive: Drive) -> Iterator[RunningDaemon]:
    folder = tmp_path_factory.mktemp("clients") / "out"
    with running_daemon(folder, options=["--metrics", str(METRICS_PORT)]) as daemon:
        with daemon.client() as client:
            for reading in drive.next(SCANS):
                client.publish(reading)
            client.finish()
        yield daemon


@pytest.fixture
def client(daemon: RunningDaemon) -> Iterator[HmtClient]:
    with daemon.client() as client:
        yield client


def points_of(answer: GlobalMap) -> dict[int, int]:
    return {area.area: len(area.points_in_area) for area in answer.areas}


# ------------------------------------------------------------------ questions


def test_the_trajectory_is_the_saved_one_and_says_what_it_is_of(
    daemon: RunningDaemon, client: HmtClient
) -> None:
    saved, answer = read_tum(daemon.out / "trajectory.tum"), client.trajectory()
    assert (answer.reference_area, answer.is_smoothed) == (0, True)
    assert answer.hypothesis == client.status().hypothesis == client.map().hypothesis
    assert answer.revision == client.status().revision
    for mine, theirs in zip(answer.poses, saved, strict=True):
        assert mine.stamp_s == pytest.approx(theirs.stamp_s, abs=1e-6)
        np.testing.assert_allclose(mine.reference_from_body, theirs.reference_from_body, atol=1e-6)
    first, last = saved[50].stamp_s, saved[70].stamp_s
    part = client.trajectory(start_s=first - 0.01, end_s=last + 0.01)
    assert [pose.stamp_s for pose in part.poses] == [pose.stamp_s for pose in answer.poses[50:71]]
    assert client.trajectory(end_s=-1.0).poses == ()
    with pytest.raises(NotFound, match="4711"):
        client.trajectory(hypothesis=4711)


def test_an_area_is_that_of_the_map_with_its_visits_and_neighbours(client: HmtClient) -> None:
    whole = client.map()
    for placed in whole.areas:
        answer = client.area(placed.area)
        assert (answer.reference_area, answer.hypothesis) == (0, whole.hypothesis)
        assert answer.area.version == placed.version > 0
        np.testing.assert_array_equal(answer.area.points_in_area, placed.points_in_area)
        assert len(answer.visits) == placed.visits
        assert sum(visit.keyframes for visit in answer.visits) == placed.keyframes
        np.testing.assert_allclose(answer.visits[0].area_from_visit, np.eye(4), atol=1e-9)
        arcs = [arc for arc in whole.arcs if placed.area in (arc.area_a, arc.area_b)]
        assert [(arc.area_a, arc.area_b) for arc in answer.arcs] == [
            (arc.area_a, arc.area_b) for arc in arcs
        ]
    with pytest.raises(NotFound, match="4711"):
        client.area(4711)
    bare = client.area(0, with_points=False).area
    assert (len(bare.points_in_area), bare.version) == (0, 0)


def test_hypotheses_are_those_of_the_posterior(client: HmtClient) -> None:
    answer, posterior = client.hypotheses(), client.posterior()
    assert (answer.hypotheses, answer.revision) == (posterior.hypotheses, posterior.revision)
    assert answer.hypotheses[0].arcs == client.status().arcs > 0


def test_points_that_are_known_are_not_sent_again(client: HmtClient) -> None:
    whole = client.map()
    again = client.map(known=whole)
    assert points_of(again) == points_of(whole)
    for mine, theirs in zip(again.areas, whole.areas, strict=True):
        assert mine.points_in_area is theirs.points_in_area
    area = whole.areas[0]
    assert client.area(area.area, known=area).area.points_in_area is area.points_in_area


def test_only_points_that_have_changed_are_sent(client: HmtClient, drive: Drive) -> None:
    before = client.map()
    for reading in drive.next(40):
        client.publish(reading)
    client.finish()
    after, delta = client.map(), client.map(known=before)
    for whole, mine in zip(after.areas, delta.areas, strict=True):
        np.testing.assert_array_equal(mine.points_in_area, whole.points_in_area)
    versions = {area.area: area.version for area in before.areas}
    for area in after.areas:
        is_same = versions.get(area.area) == area.version
        points = next((b.points_in_area for b in before.areas if b.area == area.area), None)
        assert is_same == (points is not None and np.array_equal(points, area.points_in_area))


def test_a_large_answer_comes_in_parts_if_it_may(daemon: RunningDaemon, client: HmtClient) -> None:
    endpoints = Endpoints(mode=Mode.CLIENT, connect=(daemon.endpoint,))
    selector = "hmt/site/robot/ro/map"
    with open_session(endpoints) as session:
        (whole,) = session.get(selector, timeout=DEADLINE_S)
        replies = list(
            session.get(
                f"{selector}?part_bytes=16384",
                timeout=DEADLINE_S,
                consolidation=zenoh.ConsolidationMode.NONE,
            )
        )
    parts: dict[int, bytes] = {}
    for reply in replies:
        assert reply.ok is not None
        assert reply.ok.attachment is not None
        assert len(reply.ok.payload) <= 16384
        place, count = decode_place(reply.ok.attachment.to_bytes())
        assert count == len(replies) > 1
        parts[place] = reply.ok.payload.to_bytes()
    joined = b"".join(parts[place] for place in sorted(parts))
    assert whole.ok is not None
    assert whole.ok.attachment is None
    assert joined == whole.ok.payload.to_bytes()
    value = decode(joined, str(whole.ok.encoding))
    assert isinstance(value, GlobalMap)
    assert points_of(value) == points_of(client.map())


def test_a_deadline_is_kept_and_says_so(daemon: RunningDaemon) -> None:
    with (
        HmtClient(daemon.endpoint, timeout_s=1e-4) as client,
        pytest.raises(DeadlineExceeded),
    ):
        client.map()
    with (
        HmtClient(daemon.endpoint, timeout_s=1000.0) as client,
        pytest.raises(InvalidInput, match="1000"),
    ):
        client.map()


# ------------------------------------------------------------------ publications


def test_publications_are_iterated_until_they_are_closed(client: HmtClient, drive: Drive) -> None:
    with client.poses_live() as poses, client.posteriors_live() as posteriors:
        sent = drive.next(20)
        for reading in sent:
            client.publish(reading)
        client.finish()
        stamps = [reading.stamp_s for reading in sent if not isinstance(reading, OdometryReading)]
        assert [poses.next(DEADLINE_S).stamp_s for _ in stamps] == pytest.approx(stamps)
        assert posteriors.next(DEADLINE_S).revision <= client.status().revision
        assert poses.dropped == 0
        with pytest.raises(DeadlineExceeded):
            poses.next(0.01)
    assert list(poses) == []
    with pytest.raises(Unavailable):
        poses.next(0.01)


def test_who_is_slow_gets_the_newest_and_the_number_of_the_others(
    client: HmtClient, drive: Drive
) -> None:
    with client.poses_live(capacity=3) as poses:
        sent = drive.next(20)
        for reading in sent:
            client.publish(reading)
        client.finish()
        wait_until(lambda: poses.dropped == 17)
        assert poses.next(DEADLINE_S).stamp_s == pytest.approx(sent[-5].stamp_s)


def test_closing_a_client_ends_its_iterations(daemon: RunningDaemon) -> None:
    client = daemon.client()
    events = client.events_live()
    threading.Timer(0.1, client.close).start()
    assert list(events) == []


def test_a_client_that_is_closed_says_so(daemon: RunningDaemon, drive: Drive) -> None:
    client = daemon.client()
    client.close()
    for use in (client.status, client.poses_live, lambda: client.publish(drive.next(1)[0])):
        with pytest.raises(Unavailable, match="closed") as refused:
            use()
        assert refused.type is Unavailable


def test_who_dies_while_he_is_asked_has_not_denied_access(tmp_path: Path) -> None:
    with running_daemon(tmp_path) as daemon, daemon.client() as client:
        for reading in readings(400):
            client.publish(reading)
        killer = threading.Timer(0.2, daemon.process.kill)
        killer.start()
        with pytest.raises(Unavailable) as refused:
            client.finish()
        assert refused.type is Unavailable
        killer.join()


def test_a_loop_and_an_event_are_waited_for(client: HmtClient, drive: Drive) -> None:
    with pytest.raises(DeadlineExceeded):
        client.wait_for_loop(timeout_s=0.05)
    with pytest.raises(DeadlineExceeded):
        client.wait_for_event(EventKind.PROCESS_FAILED, timeout_s=0.05)
    client.wait_for_daemon(DEADLINE_S)
    known = client.posterior().hypotheses[0].loop_closures
    # On to the other room, and back.
    trip = threading.Thread(target=lambda: [client.publish(r) for r in drive.next(300)])
    trip.start()
    belief = client.wait_for_loop(probability=0.5, timeout_s=10.0 * DEADLINE_S)
    trip.join()
    client.finish()
    assert belief.hypotheses[0].loop_closures > known


def test_a_sender_can_reconcile_what_it_has_sent(daemon: RunningDaemon, drive: Drive) -> None:
    with daemon.client() as client, daemon.client() as other:
        assert client.lost() == {Input.SCAN: 0, Input.ODOMETRY: 0}
        before = client.status().input
        for reading in drive.next(30):
            client.publish(reading)
            other.publish_raw(Input.SCAN, b"\xff", "text/plain")
        assert client.lost() == {Input.SCAN: 0, Input.ODOMETRY: 0}
        client.finish()
        counts = client.status().input
        assert counts.accepted - before.accepted == 60
        assert counts.refused["wrong_encoding"] - before.refused.get("wrong_encoding", 0) == 60


def test_a_daemon_is_waited_for_at_a_router() -> None:
    router = free_endpoint()
    with open_session(Endpoints(mode=Mode.PEER, listen=(router,))), HmtClient(router) as client:
        with pytest.raises(DeadlineExceeded):
            client.wait_for_daemon(0.1)
        with pytest.raises(Unavailable, match="nobody answers"):
            client.status()


# ------------------------------------------------------------------ asyncio


def test_the_asynchronous_client_says_the_same(
    daemon: RunningDaemon, client: HmtClient, drive: Drive
) -> None:
    async def ask() -> None:
        async with AsyncHmtClient(daemon.endpoint) as other:
            whole, status, details = await asyncio.gather(
                other.map(), other.status(), other.area(0)
            )
            assert points_of(whole) == points_of(client.map())
            assert status.revision == whole.revision == details.revision
            with pytest.raises(NotFound, match="4711"):
                await other.area(4711)

            await other.wait_for_daemon(DEADLINE_S)
            async with other.poses_live(capacity=5) as poses:
                sent = drive.next(10)
                for reading in sent:
                    await other.publish(reading)
                await other.finish()
                pose = await poses.first(lambda pose: pose.stamp_s >= sent[-1].stamp_s, DEADLINE_S)
                assert pose.stamp_s == pytest.approx(sent[-1].stamp_s)
                with pytest.raises(DeadlineExceeded):
                    await poses.next(0.05)
            assert [pose async for pose in poses] == []
            with pytest.raises(DeadlineExceeded):
                await other.wait_for_loop(timeout_s=0.05)
            with pytest.raises(DeadlineExceeded):
                await other.wait_for_event(timeout_s=0.05)

    asyncio.run(ask())


def test_an_asynchronous_client_that_is_not_open_says_so() -> None:
    with pytest.raises(Unavailable, match="async with"):
        asyncio.run(AsyncHmtClient().status())


# ------------------------------------------------------------------ metrics


def test_metrics_are_the_status(client: HmtClient) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{METRICS_PORT}/metrics") as answer:
        assert answer.headers["Content-Type"].startswith("text/plain")
        text = answer.read().decode()
    status = client.status()
    samples = {
        (sample.name, *sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }
    assert samples["hmt_input_received_total",] == status.input.received
    assert samples["hmt_map_areas",] == status.areas
    assert samples["hmt_scans_mapped_total",] == status.processed_scans
    assert samples["hmt_process_ready", "topology"] == 1.0
    assert samples["hmt_state", "running"] == 1.0
    assert samples["hmt_state", "stopping"] == 0.0
    assert status.localization is not None
    assert samples["hmt_localization_probability",] == status.localization.probability
    info = next(name for name in samples if name[0] == "hmt_info")
    assert {status.version, status.config_hash, "site", "robot"} <= set(info)


def test_a_port_that_is_taken_is_an_error(tmp_path: Path, daemon: RunningDaemon) -> None:
    assert daemon.process.poll() is None
    options = ["--metrics", str(METRICS_PORT)]
    with running_daemon(tmp_path / "out", is_awaited=False, options=options) as other:
        assert f"no metrics at 127.0.0.1:{METRICS_PORT}" in other.output()
    assert other.process.returncode != 0


# ------------------------------------------------------------------ programs of the README


@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_the_programs_of_the_readme_run(
    daemon: RunningDaemon, client: HmtClient, number: int, drive: Drive
) -> None:
    program = PROGRAMS[number].replace("tcp/127.0.0.1:7447", daemon.endpoint)
    program = program.replace("timeout_s=10.0", "timeout_s=0.5")
    is_endless = "async for" in program
    with subprocess.Popen(
        [sys.executable, "-u", "-c", program], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        if is_endless:
            is_told = threading.Event()

            def tell() -> None:
                while not is_told.wait(0.2):
                    for reading in drive.next(10):
                        client.publish(reading)

            telling = threading.Thread(target=tell)
            telling.start()
            said = process.stdout.readline()
            is_told.set()
            telling.join()
            process.kill()
        else:
            said = process.stdout.read()
            assert process.wait(DEADLINE_S) == 0
    assert said
