"""Mutants of a program, and a loaded function that becomes one."""

import ast
import importlib
import importlib.util
import json
import sys
import tomllib
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from qsgm import load_bundle

FOLDER = Path(__file__).parents[1] / "benchmarks" / "mutants"
SOURCE = '''"""A module."""

from functools import cached_property

LIMIT = 4
Names = list[str] | None


class Counter:
    """What counts."""

    @cached_property
    def twice(self) -> int:
        """So many."""
        return 2 * LIMIT

    @property
    def more(self) -> bool:
        return self.twice > 7


def place(value: int, *, near: bool = True) -> str:
    """Where a value is."""
    if near and value < LIMIT:
        print(value)
        return f"{value + 1} is near"
    raise ValueError(f"{value - 1} is far")
'''
EXPECTED = {
    ("module", "4", "5"),
    ("module", "True", "False"),
    ("Counter.twice", "2 * LIMIT", "(2 / LIMIT)"),
    ("Counter.twice", "2", "3"),
    ("Counter.twice", "return 2 * LIMIT", "return None"),
    ("Counter.more", "return self.twice > 7", "return None"),
    ("Counter.more", "self.twice > 7", "(self.twice >= 7)"),
    ("Counter.more", "7", "8"),
    ("place", "near and value < LIMIT", "(near or value < LIMIT)"),
    ("place", "near and value < LIMIT", "not (near and value < LIMIT)"),
    ("place", "value < LIMIT", "(value <= LIMIT)"),
    ("place", "print(value)", "pass"),
    ("place", 'return f"{value + 1} is near"', "return None"),
    ("place", 'raise ValueError(f"{value - 1} is far")', "pass"),
}


@pytest.fixture
def draw(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("draw")


@pytest.fixture
def mutants(draw: ModuleType, tmp_path: Path) -> list[Any]:
    path = tmp_path / "counting.py"
    path.write_text(SOURCE)
    found: list[Any] = draw.mutants_of(path, tmp_path)
    return found


def test_every_place_that_may_be_mistaken_has_its_mutants_and_messages_and_types_have_none(
    mutants: list[Any],
) -> None:
    assert {(one.where, one.before, one.after) for one in mutants} == EXPECTED
    assert len({one.name for one in mutants}) == len(mutants)


def test_a_mutant_differs_in_one_place_only(mutants: list[Any]) -> None:
    for one in mutants:
        assert ast.dump(ast.parse(one.source)) != ast.dump(ast.parse(SOURCE))
        before, after = SOURCE.splitlines(), one.source.splitlines()
        differ = [
            k for k, pair in enumerate(zip(before, after, strict=True), 1) if len({*pair}) > 1
        ]
        assert differ
        assert all(one.first <= number <= one.last for number in differ)


def test_a_loaded_function_is_given_a_mutants_code(
    mutants: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "counting", raising=False)
    code_of = importlib.import_module("patched").code_of
    counting = importlib.import_module("counting")
    assert (counting.Counter().twice, counting.place(3)) == (8, "4 is near")
    by_key = {(one.where, one.after): one for one in mutants}
    assert code_of(by_key["module", "5"]) is None
    for key in (("Counter.twice", "3"), ("Counter.more", "8"), ("place", "return None")):
        function, function_code = code_of(by_key[key])
        function.__code__ = function_code
    counter = counting.Counter()
    assert (counter.twice, counter.more, counting.place(3)) == (12, True, None)


@pytest.fixture
def mutation(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The program itself; what covers lines is not needed to ask it."""
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setitem(sys.modules, "covering", ModuleType("covering"))
    spec = importlib.util.spec_from_file_location("mutation", FOLDER / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "mutation", module)
    spec.loader.exec_module(module)
    return module


def test_the_copied_tree_has_all_that_tests_import(mutation: ModuleType) -> None:
    settings = tomllib.loads((FOLDER.parents[1] / "pyproject.toml").read_text())
    paths = settings["tool"]["pytest"]["ini_options"]["pythonpath"]
    assert {Path(path).parts[0] for path in paths} <= set(mutation.NEEDED)


def test_the_shared_bundle_is_a_whole_one(mutation: ModuleType, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    assert mutation._write_bundle(tmp_path / "bundle") == 0
    assert load_bundle(tmp_path / "bundle").manifest.files


def test_what_survived_is_tried_again_where_it_has_to_be_loaded_anew(
    mutation: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first of two survivors was tried with everything loaded, the other could not be."""
    entries = [{"mutant": name, "result": "survived"} for name in ("one", "other", "one")]
    (tmp_path / "log").write_text("".join(f"{json.dumps(entry)}\n" for entry in entries))
    trials = [SimpleNamespace(mutant=SimpleNamespace(name=name)) for name in ("one", "other")]
    tried: list[str] = []
    monkeypatch.setattr(mutation, "_tell", lambda _work, trial, _: tried.append(trial.mutant.name))
    mutation._try_all(trials, tmp_path, True, 2)
    assert tried == ["other"]
