"""The documentation: its commands run and print what it says, its links lead somewhere, generated
pages are fresh.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from hmt_service.client.local import free_endpoint
from hmt_service.core.config import load_config
from hmt_service.service.keys import DEFAULT_ENDPOINT
from tests.drives import write_drive, write_log
from tests.mapped import map_file_in

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(page.name for page in DOCS.glob("*.md"))
EQUATIONS = range(1, 16)
MOST_S = 600.0
# As people have it, but for the port: another daemon may be there.
PREAMBLE = """
hmt() {
    case $1 in
        serve) shift; command hmt serve --listen "$HMT_CONNECT" "$@" ;;
        doctor) HMT_CONNECT= command hmt "$@" ;;
        *) command hmt "$@" ;;
    esac
}
"""


@dataclass(frozen=True)
class Block:
    """Commands of a page, and what it says that they print."""

    commands: str
    lines: tuple[str, ...]

    @property
    def is_refused(self) -> bool:
        """Whether it shows something that does not work."""
        return any(line.startswith(("error: ", "database: ")) for line in self.lines)


def blocks_of(page: str) -> list[Block]:
    found = re.findall(
        r"^```sh\n(.*?)^```(?:\n\n```text\n(.*?)^```)?",
        (DOCS / page).read_text(),
        re.MULTILINE | re.DOTALL,
    )
    return [Block(commands, tuple(text.splitlines())) for commands, text in found]


def run_page(page: str, folder: Path) -> list[tuple[str, list[int]]]:
    """Run all commands of a page in one shell; return the output and failures of each block."""
    endpoint = free_endpoint()
    script = [PREAMBLE]
    for number, block in enumerate(blocks_of(page)):
        script.append(f"trap 'echo $? >>{number}.failed' ERR")
        script.append(f"{{\n{block.commands}\n}} >{number}.out 2>&1")
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "HMT_CONNECT": endpoint,
        "COLUMNS": "400",
    }
    with subprocess.Popen(
        ["bash", "-c", "\n".join(script)], cwd=folder, env=environment, start_new_session=True
    ) as shell:
        try:
            shell.wait(MOST_S)
        finally:
            # What the page has left in the background.
            with suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)
    results = []
    for number in range(len(blocks_of(page))):
        out = (folder / f"{number}.out").read_text().replace(endpoint, DEFAULT_ENDPOINT)
        failed = folder / f"{number}.failed"
        results.append((out, [*map(int, failed.read_text().split())] if failed.exists() else []))
    return results


def assert_page_holds(page: str, folder: Path) -> None:
    for block, (out, failures) in zip(blocks_of(page), run_page(page, folder), strict=True):
        assert bool(failures) == block.is_refused, f"{block.commands}{out}"
        for line in block.lines:
            pattern = ".*".join(map(re.escape, line.split("…")))
            assert re.search(rf"^{pattern}$", out, re.MULTILINE), f"{line!r} is not in\n{out}"


def test_the_tutorial_leads_from_a_bag_to_a_map(tmp_path: Path) -> None:
    # What `make` looks at, older than what it has installed.
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / ".venv").symlink_to(Path(sys.prefix))
    write_drive(tmp_path / "drive")
    assert_page_holds("tutorial.md", tmp_path)
    for name in ("floor.pgm", "floor.yaml", "scans.tum", "posterior.png"):
        assert (tmp_path / "out/drive" / name).stat().st_size > 0
    assert (tmp_path / "out/map.png").stat().st_size > 0


def test_troubles_print_what_the_page_says(tmp_path: Path) -> None:
    bag = write_drive(tmp_path / "bag", 100)
    content = (bag / "bag.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(content[: len(content) // 2])
    write_drive(tmp_path / "no-tf", 200, has_tf=False)
    write_drive(tmp_path / "unstamped", 100, is_stamped=False)
    write_log(tmp_path / "drive.mcap", 300)
    write_log(tmp_path / "whole.mcap", 500)
    log = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(log[: int(0.95 * len(log))])
    (tmp_path / "notes.txt").write_text("bring batteries\n")
    (tmp_path / "typo.yaml").write_text("odometry:\n  keyframe_distance: 0.3\n")
    (tmp_path / "negative.yaml").write_text("odometry:\n  keyframe_distance_m: -1\n")
    damaged = bytearray(map_file_in(tmp_path).read_bytes())
    damaged[40_960:45_056] = b"\xff" * 4096
    (tmp_path / "damaged.hmt").write_bytes(damaged)
    assert_page_holds("troubleshooting.md", tmp_path)


@pytest.mark.parametrize("page", PAGES)
def test_pages_with_commands_are_run(page: str) -> None:
    assert not blocks_of(page) or page in ("tutorial.md", "troubleshooting.md")


def links() -> Iterator[tuple[str, str, str]]:
    for page in PAGES:
        for text, target in re.findall(r"\[([^\]]+)\]\(([^)]+)\)", (DOCS / page).read_text()):
            if not target.startswith("http"):
                yield page, text, target


@pytest.mark.parametrize(("page", "text", "target"), sorted(set(links())))
def test_links_lead_to_what_they_name(page: str, text: str, target: str) -> None:
    name, _, anchor = target.partition("#")
    linked = (DOCS / name) if name else DOCS / page
    assert linked.exists()
    content = linked.read_text()
    if linked.suffix == ".py":
        assert re.search(rf"^\s*(class|def) {text.strip('`')}\b", content, re.MULTILINE)
    if anchor:
        headings = re.findall(r"^#+ (.*)$", content, re.MULTILINE)
        assert anchor in {re.sub(r"[^\w\- ]", "", h).lower().replace(" ", "-") for h in headings}


def test_the_paper_s_equations_are_explained() -> None:
    text = (DOCS / "concepts.md").read_text()
    numbers = {int(number) for number in re.findall(r"\((\d+)\)", text)}
    assert numbers >= {*EQUATIONS}


def test_every_page_is_in_the_index() -> None:
    text = (DOCS / "index.md").read_text()
    assert all(f"({page})" in text for page in PAGES if page != "index.md")
    assert "docs/index.md" in (ROOT / "README.md").read_text()


# ------------------------------------------------------------------ generated pages


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", ["configuration.md", "rpc.md"])
def test_generated_pages_are_fresh(page: str, generate: ModuleType) -> None:
    assert (DOCS / page).read_text().rstrip() == generate.PAGES[page]().rstrip(), "make docs"


def test_the_example_of_the_configuration_is_taken() -> None:
    (example,) = re.findall(
        r"^```yaml\n(.*?)^```", (DOCS / "configuration.md").read_text(), re.MULTILINE | re.DOTALL
    )
    config = load_config(text=example)
    assert (config.odometry.keyframe_distance_m, config.particles.budget) == (0.3, 30)


def test_every_dependency_is_weighed_and_justified(generate: ModuleType) -> None:
    text = (DOCS / "installed-size.md").read_text()
    reasons = generate.reasons_of()
    assert {*reasons.values()}.isdisjoint({""})
    for name, reason in reasons.items():
        assert re.search(rf"^\| `{name}` \| [\d.]+ \|.*\| {re.escape(reason)} \|$", text, re.M)
