"""Nothing that arrives or is read can run code: only our own processes unpickle, each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "hmt_service"
SOURCES = sorted(PACKAGE.rglob("*.py"))
UNPICKLERS = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib"}
OWNER = PACKAGE / "runtime" / "messages.py"
"""What parent and children say to each other, over pipes that nobody else has an end of."""


def imported(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "").partition(".")[0]


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_module_runs_what_it_reads(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert UNPICKLERS & set(imported(tree)) == ({"pickle"} if path == OWNER else set())
    for name, call in calls(tree):
        assert name not in ("eval", "exec", "__import__", "yaml.load", "yaml.unsafe_load")
        if name in ("np.load", "numpy.load"):
            allowed = [ast.unparse(k.value) for k in call.keywords if k.arg == "allow_pickle"]
            assert allowed == ["False"]


def test_only_the_pipes_between_our_processes_are_unpickled() -> None:
    users = [
        path.relative_to(PACKAGE).as_posix()
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom)
        and node.module == "hmt_service.runtime.messages"
        and "load" in [alias.name for alias in node.names]
    ]
    assert users == ["runtime/links.py", "runtime/workers.py"]
    # Anonymous pipes: a listener would have an address that others could connect to.
    for path in SOURCES:
        names = {name for name, _ in calls(ast.parse(path.read_text()))}
        assert not names & {"Listener", "Client", "multiprocessing.Manager", "context.Manager"}
