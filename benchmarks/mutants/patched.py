"""A function that is loaded already gets a mutant's code: nothing has to be imported again."""

import sys
from collections.abc import Iterator
from functools import cached_property
from types import CodeType, FunctionType, ModuleType
from typing import Any

from draw import Mutant


def code_of(mutant: Mutant) -> tuple[FunctionType, CodeType] | None:
    """The function that a mutant's place is in, and its new code; None: it is in no function."""
    name = mutant.path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
    code: CodeType | None = compile(mutant.source, mutant.path, "exec")
    found: Any = sys.modules.get(name)
    for part in mutant.where.split("."):
        found = vars(found).get(part) if isinstance(found, ModuleType | type) else None
        code = next(_inside(code, part), None) if code is not None else None
        function = _function(found)
        if function is not None and code is not None:
            same = function.__code__.co_freevars == code.co_freevars
            return (function, code) if same else None
    return None


def _inside(code: CodeType, name: str) -> Iterator[CodeType]:
    for one in code.co_consts:
        if isinstance(one, CodeType) and one.co_name == name:
            yield one


def _function(value: Any) -> FunctionType | None:
    """What is behind decorators that keep it."""
    while value is not None and not isinstance(value, FunctionType):
        if isinstance(value, property):
            value = value.fget
        elif isinstance(value, cached_property):
            value = value.func
        else:
            value = getattr(value, "__func__", getattr(value, "__wrapped__", None))
    inner = getattr(value, "__wrapped__", None)
    return _function(inner) if inner is not None else value
