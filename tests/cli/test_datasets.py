"""`hmt datasets`: the table against the recorded logs, and fetching from a server of the test's."""

from __future__ import annotations

import bz2
import hashlib
import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from hmt_service.__main__ import next_step
from hmt_service.cli.app import app
from hmt_service.client.local import free_endpoint
from hmt_service.errors import InvalidInput, NotFound, Unavailable, Unreachable
from hmt_service.io import datasets
from hmt_service.io.datasets import DATASETS, Dataset, RecordedFile, checksum

LOG, RELATIONS = b"ODOM 0 0 0 0 0 0 1 host 1\n" * 5000, b"1 2 0 0 0 0 0 0\n"
SMALL = Dataset(
    "a small log",
    "nowhere",
    "none",
    (
        RecordedFile("2d/small.clf.bz2", len(LOG), hashlib.sha256(LOG).hexdigest()),
        RecordedFile("2d/small.relations", len(RELATIONS), hashlib.sha256(RELATIONS).hexdigest()),
    ),
)


@contextmanager
def server(files: Mapping[str, bytes], *, is_cut: bool = False) -> Iterator[str]:
    """Serve files over HTTP on loopback, cut in half if so; yields the address of their folder."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = files.get(self.path.removeprefix("/logs/"))
            if content is None:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) // 2] if is_cut else content)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        thread = threading.Thread(target=http.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{http.server_address[1]}/logs"
        finally:
            http.shutdown()
            thread.join()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a log that is small enough to be served by a test."""
    monkeypatch.setattr(datasets, "DATASETS", {"small": SMALL})


def fetched(folder: Path, mirror: str, name: str = "small") -> Result:
    command = ["datasets", "fetch", name, "--out", str(folder), "--mirror", mirror]
    return CliRunner().invoke(app, command)


def test_every_log_is_listed_with_origin_licence_and_checksum() -> None:
    text = CliRunner().invoke(app, ["datasets"]).stdout
    for name, dataset in DATASETS.items():
        assert name in text
        for part in (dataset.origin, dataset.licence, *(file.sha256 for file in dataset.files)):
            assert part in text
    listed = json.loads(CliRunner().invoke(app, ["datasets", "--json"]).stdout)
    assert [*listed] == [*DATASETS]
    assert listed["intel"]["files"][0]["sha256"] == DATASETS["intel"].files[0].sha256


@pytest.mark.parametrize("name", DATASETS)
def test_the_checksums_are_those_of_the_recorded_logs(name: str, hmt_data: Path) -> None:
    for file in DATASETS[name].files:
        assert checksum(hmt_data / file.name) == file.sha256


@pytest.mark.usefixtures("small")
def test_a_log_is_fetched_compressed_and_then_only_checked(tmp_path: Path) -> None:
    with server({"small.clf": LOG, "small.relations": RELATIONS}) as address:
        result = fetched(tmp_path, address)
    assert result.exit_code == 0
    assert bz2.decompress((tmp_path / "2d/small.clf.bz2").read_bytes()) == LOG
    assert (tmp_path / "2d/small.relations").read_bytes() == RELATIONS
    again = fetched(tmp_path, "http://127.0.0.1:1/nobody")
    assert again.exit_code == 0
    assert again.stderr.count("already there, checksum right") == 2


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("content", [LOG[:-1], LOG + b"more", LOG.replace(b"0 0", b"0 1", 1)])
def test_another_file_is_refused_with_both_checksums_and_not_kept(
    content: bytes, tmp_path: Path
) -> None:
    with server({"small.clf": content}) as address:
        error = fetched(tmp_path, address).exception
    assert isinstance(error, InvalidInput)
    assert SMALL.files[0].sha256 in str(error)
    assert [*tmp_path.rglob("small*")] == []


@pytest.mark.usefixtures("small")
def test_what_is_there_and_is_another_file_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "2d").mkdir()
    (tmp_path / "2d/small.clf.bz2").write_bytes(bz2.compress(b"my own"))
    error = fetched(tmp_path, "http://127.0.0.1:1/nobody").exception
    assert isinstance(error, InvalidInput)
    assert bz2.decompress((tmp_path / "2d/small.clf.bz2").read_bytes()) == b"my own"


@pytest.mark.usefixtures("small")
def test_a_connection_that_breaks_leaves_nothing(tmp_path: Path) -> None:
    with server({"small.clf": LOG}, is_cut=True) as address:
        assert isinstance(fetched(tmp_path, address).exception, (Unavailable, InvalidInput))
    assert [*tmp_path.rglob("small*")] == []


@pytest.mark.usefixtures("small")
def test_a_server_that_has_no_such_file_is_told(tmp_path: Path) -> None:
    with server({}) as address:
        error = fetched(tmp_path, address).exception
    assert isinstance(error, Unavailable)
    assert "404" in str(error)


@pytest.mark.usefixtures("small")
def test_without_internet_the_way_round_is_told(tmp_path: Path) -> None:
    address = free_endpoint().replace("tcp/", "http://")
    error = fetched(tmp_path, address).exception
    assert isinstance(error, Unreachable)
    assert address in str(error)
    assert "--mirror" in next_step(error)
    assert [*tmp_path.rglob("small*")] == []


@pytest.mark.usefixtures("small")
def test_only_http_is_an_address(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="no address of http"):
        list(datasets.fetch("small", tmp_path, mirror=tmp_path.as_uri()))


def test_what_has_no_address_says_where_to_look(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match=r"fr079\.clf is not known; take it from .*slamevaluation"):
        list(datasets.fetch("fr079", tmp_path))
    with pytest.raises(NotFound, match="every fourth point"):
        list(datasets.fetch("kitti00-part", tmp_path))
    with pytest.raises(NotFound, match="there are intel"):
        list(datasets.fetch("nothing", tmp_path))
