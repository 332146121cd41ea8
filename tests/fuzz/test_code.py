"""Nothing that pixcal reads is run as code, and nothing listens to the network."""

import ast
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from pixcal.engine.run import Runtime, run_tasks

ROOT = Path(__file__).parents[2]
FILES = sorted(
    file
    for folder in ("pipeline/pixcal", "cli/pixcal_cli", "bench/blind_examination")
    for file in (ROOT / folder).rglob("*.py")
)
FORBIDDEN = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "os.system",
    "os.popen",
    "os.exec",
    "os.spawn",
    "yaml.load",
    "yaml.load_all",
    "yaml.full_load",
    "yaml.unsafe_load",
    "yaml.Loader",
    "yaml.UnsafeLoader",
    "yaml.FullLoader",
    "numpy.load",
    "np.load",
    "marshal",
    "shelve",
    "dill",
    "joblib",
    "subprocess",
    "LocalCluster",
    "Scheduler",
    "Server",
    "socketserver",
    "http.server",
    "allow_pickle",
}
PICKLES = {"pipeline/pixcal/engine/remote_task.py", "pipeline/pixcal/engine/cluster.py"}
"""Tasks on their way to Dask's workers, made by this process; nothing else is ever unpickled."""
STARTS = {"bench/blind_examination/second.py"}
"""The second bench, as a program of its own; what it is told are names of effects and numbers."""


def named(tree: ast.AST) -> Iterator[str]:
    """Dotted names that are used, modules that are imported, and keywords of calls."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield ast.unparse(node)
            yield node.attr if node.attr[0].isupper() else ""
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
            yield from (name.name for name in node.names)
            yield from (f"{node.module}.{name.name}" for name in node.names)
        elif isinstance(node, ast.keyword):
            yield node.arg or ""


def forbidden(text: str) -> set[str]:
    return set(named(ast.parse(text))) & FORBIDDEN


def unpickles(text: str) -> bool:
    return any(name.split(".")[0] in ("pickle", "cloudpickle") for name in named(ast.parse(text)))


@pytest.mark.quick(60)
@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_what_is_read_is_never_run(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    name = str(file.relative_to(ROOT))
    assert forbidden(text) == ({"subprocess"} if name in STARTS else set())
    assert not unpickles(text) or name in PICKLES


@pytest.mark.parametrize(
    "text",
    [
        "eval('1')",
        "yaml.load(text, Loader=loader)",
        "from yaml import load",
        "import subprocess",
        "from distributed import LocalCluster",
        "distributed.LocalCluster()",
        "read(file, allow_pickle=True)",
    ],
)
def test_a_breach_is_caught(text: str) -> None:
    assert forbidden(text)


def test_unpickling_is_caught() -> None:
    assert unpickles("import pickle")
    assert unpickles("from cloudpickle import loads")
    assert not unpickles("import json")


@pytest.mark.parametrize("cluster", ["threads", "sync"])
def test_no_port_is_opened(cluster: str) -> None:
    def ports() -> set[object]:
        connections = psutil.Process().net_connections("inet")
        return {c.laddr for c in connections if c.status == psutil.CONN_LISTEN}

    before, during = ports(), set()
    runtime = Runtime(cluster=cluster, workers=2)
    run_tasks(abs, range(4), runtime, label="x", done=lambda *_: during.update(ports()))
    assert during <= before
