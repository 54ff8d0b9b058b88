"""The house's arrows: nothing imports a benchmark but the command line, and nothing in a circle."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import qsgm

TOP = Path(qsgm.__file__).parent


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(TOP.parent).with_suffix("").parts).removesuffix(".__init__")


def imports_of(path: Path, *, lazy: bool) -> set[str]:
    """Modules of the package that a file imports; `lazy`: inside functions and for types, too."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found = set()
    for node in ast.walk(tree) if lazy else tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("qsgm"):
            names = {f"{node.module}.{one.name}" for one in node.names}
            found |= {name if name in MODULES else str(node.module) for name in names}
        elif isinstance(node, ast.Import):
            found |= {one.name for one in node.names if one.name.startswith("qsgm")}
    return found


MODULES = {module_of(path): path for path in TOP.rglob("*.py")}


def test_only_the_command_line_imports_a_benchmark() -> None:
    users = {
        name
        for name, path in MODULES.items()
        if any(one.startswith("qsgm.bench") for one in imports_of(path, lazy=True))
    }
    assert {name for name in users if not name.startswith(("qsgm.bench", "qsgm.cli"))} == set()


def test_no_module_imports_itself_in_the_end() -> None:
    graph = {name: imports_of(path, lazy=False) - {name} for name, path in MODULES.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle
