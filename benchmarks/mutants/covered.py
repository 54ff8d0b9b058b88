"""Which tests run a mutant's lines, by what coverage and the plugin beside it wrote."""

import ast
import json
from collections import defaultdict
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import coverage
from draw import Mutant

FIXTURE = "fixture "


class Covered:
    """The lines of a tree, and the tests that run them."""

    def __init__(self, tree: Path, data: Path, tests: Path) -> None:
        self._tree = tree
        self._data = coverage.CoverageData(str(data))
        self._data.read()
        written = json.loads(tests.read_text())
        about: dict[str, dict[str, Any]] = written["tests"]
        # Of a test alone, with all that it shares with others.
        self.seconds = {
            name: one["seconds"] + sum(written["shared"].get(k, 0) for k in one["fixtures"])
            for name, one in about.items()
            if one["passed"]
        }
        self._users = defaultdict(set)
        for name in self.seconds:
            for fixture in about[name]["fixtures"]:
                self._users[fixture].add(name)
        self._contexts: dict[str, dict[int, list[str]]] = {}

    def tests_of(self, mutant: Mutant) -> list[str]:
        """Those that run its lines, the quickest first.

        What runs when a module is loaded is run by all: then it is the lines that read the names
        which are bound there, or the body of the function whose head it is.
        """
        found = set()
        for context in self.contexts_of(mutant):
            name = context.removeprefix(FIXTURE)
            found |= {name} & self.seconds.keys() if name == context else self._users[name]
        return sorted(found, key=lambda name: (self.seconds[name], name))

    def contexts_of(self, mutant: Mutant) -> set[str]:
        """Tests, and fixtures that several share, see :meth:`tests_of`."""
        lines = [(mutant.path, line) for line in range(mutant.first, mutant.last + 1)]
        return self._contexts_on(lines) or self._contexts_on(self._instead(mutant))

    def _contexts_on(self, lines: list[tuple[str, int]]) -> set[str]:
        return {context for path, line in lines for context in self._of(path).get(line, ())} - {""}

    def _of(self, path: str) -> dict[int, list[str]]:
        if path not in self._contexts:
            self._contexts[path] = self._data.contexts_by_lineno(str(self._tree / path))
        return self._contexts[path]

    def _instead(self, mutant: Mutant) -> list[tuple[str, int]]:
        tree = ast.parse((self._tree / mutant.path).read_text(encoding="utf-8"))
        around = [one for one in ast.walk(tree) if _holds(one, mutant)]
        for one in around:
            if isinstance(one, ast.FunctionDef):
                last = one.body[-1].end_lineno or 0
                return [(mutant.path, k) for k in range(one.body[0].lineno, last + 1)]
        return [place for one in around for name in _bound(one) for place in self._read[name]]

    @cached_property
    def _read(self) -> dict[str, list[tuple[str, int]]]:
        """Where a name is read, as a name or as an attribute."""
        found = defaultdict(list)
        for path in sorted(self._tree.glob("qsgm/**/*.py")):
            name = path.relative_to(self._tree).as_posix()
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                    found[node.id].append((name, node.lineno))
                elif isinstance(node, ast.Attribute):
                    found[node.attr].append((name, node.lineno))
        return found


def _holds(node: ast.AST, mutant: Mutant) -> bool:
    kinds = ast.FunctionDef | ast.Assign | ast.AnnAssign | ast.AugAssign
    return (
        isinstance(node, kinds)
        and min([node.lineno, *(one.lineno for one in getattr(node, "decorator_list", ()))])
        <= mutant.first
        and mutant.last <= (node.end_lineno or 0)
    )


def _bound(node: ast.AST) -> Iterator[str]:
    """Names that a statement gives a value."""
    for target in getattr(node, "targets", [getattr(node, "target", None)]):
        for one in ast.walk(target) if target is not None else ():
            if isinstance(one, ast.Name):
                yield one.id
