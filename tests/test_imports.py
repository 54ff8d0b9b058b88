"""The house's rules: which rooms may import which.

What is imported inside a function counts, what is for annotations alone does not: no order hangs on
it.
"""

import ast
import importlib
import subprocess
import sys
from collections.abc import Iterable, Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import qsgm

TOP = Path(qsgm.__file__).parent
FILES = {
    ".".join(file.relative_to(TOP.parent).with_suffix("").parts).removesuffix(".__init__"): file
    for file in TOP.rglob("*.py")
}
# What knows no task: neither that of the bundle that ships nor another.
NO_TASK = ["tune", "sgm", "bundle", "manifest", "network", "task", "schedule", "blocks"]
NO_TASK += ["fidelity", "progress", "tables", "weights", "tuned_folder"]
HOST = ["model", "pretraining", "quantization", "graphs"]
HOST += ["export", "slim", "checkpoint", "heads", "task"]


def imported(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Modules that code imports; a name from a package is a module where there is such a file."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (name if name in FILES else f"{node.module}" for name in names)
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from imported(node.orelse)
        else:
            yield from imported(ast.iter_child_nodes(node))


def parsed(module: str) -> ast.Module:
    return ast.parse(FILES[module].read_text(encoding="utf-8"))


IMPORTS = {
    module: {name for name in imported([parsed(module)]) if name in FILES} for module in FILES
}


def inside(rooms: Iterable[str]) -> set[str]:
    """All modules of some rooms."""
    return {name for name in FILES for room in rooms if f"{name}.".startswith(f"qsgm.{room}.")}


def arrows(sources: Iterable[str], targets: Iterable[str]) -> dict[str, list[str]]:
    """Which of some modules import which of some others."""
    found = {name: sorted(IMPORTS[name] & set(targets)) for name in sorted(sources)}
    return {name: targets for name, targets in found.items() if targets}


def test_the_rooms_that_the_rules_are_about_exist() -> None:
    rooms = [*NO_TASK, "grasp", "bench", "cli", *(f"train.{room}" for room in [*HOST, "grasp"])]
    assert [room for room in rooms if not inside([room])] == []
    # The reader sees what the linter would, and inside functions.
    assert "qsgm.network" in IMPORTS["qsgm.task"]
    assert "qsgm.grasp.teach" in IMPORTS["qsgm.cli.commands"]


def test_tuning_bundles_and_geometry_know_nothing_of_grasping() -> None:
    assert arrows(inside(NO_TASK), inside(["grasp"])) == {}


def test_what_trains_and_exports_knows_nothing_of_grasping() -> None:
    rooms = [f"train.{room}" for room in HOST]
    assert arrows(inside(rooms), inside(["grasp", "train.grasp"])) == {}


def test_the_device_side_knows_nothing_of_the_hosts() -> None:
    device = FILES.keys() - inside(["train", "cli", "bench"])
    assert arrows(device, inside(["train", "cli", "bench"])) == {}


def test_nothing_but_the_command_line_imports_the_benchmarks() -> None:
    others = FILES.keys() - inside(["bench", "cli"])
    assert arrows(others, inside(["bench"])) == {}


def test_no_module_imports_itself_by_a_detour() -> None:
    TopologicalSorter(IMPORTS).prepare()


def test_graphs_are_built_and_made_slim_without_torch() -> None:
    pytest.importorskip("onnx")
    modules = inside(["train.graphs", "train.slim"])
    assert [name for name in sorted(modules) if "torch" in set(imported([parsed(name)]))] == []
    code = "import importlib, sys; [importlib.import_module(name) for name in sys.argv[1:]]"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; print('torch' in sys.modules)", *sorted(modules)],
        capture_output=True,
        text=True,
        check=False,
        cwd=TOP.parent,
    )
    assert (done.stdout, done.stderr) == ("False\n", "")


def test_everything_that_benchmarks_and_examples_ask_of_the_package_is_there() -> None:
    """They run for minutes or need other packages, so that tests run few of them."""
    pytest.importorskip("torch")
    root = TOP.parent
    scripts = [
        file for folder in ("benchmarks", "examples") for file in root.glob(f"{folder}/**/*.py")
    ]
    asked = {
        (node.module, alias.name)
        for script in scripts
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith("qsgm.")
        for alias in node.names
    }
    assert asked
    missing = [
        f"{module}.{name}"
        for module, name in sorted(asked)
        if f"{module}.{name}" not in FILES
        and not (module in FILES and hasattr(importlib.import_module(f"{module}"), name))
    ]
    assert missing == []
