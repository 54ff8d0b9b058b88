"""Small changes of a program, from its syntax tree: each a mistake that somebody may make."""

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LONGEST = 80
OPERATORS: dict[type[ast.AST], ast.AST] = {
    ast.Add: ast.Sub(),
    ast.Sub: ast.Add(),
    ast.Mult: ast.Div(),
    ast.Div: ast.Mult(),
    ast.FloorDiv: ast.Mult(),
    ast.Mod: ast.FloorDiv(),
    ast.BitAnd: ast.BitOr(),
    ast.BitOr: ast.BitAnd(),
    ast.And: ast.Or(),
    ast.Or: ast.And(),
    ast.Lt: ast.LtE(),
    ast.LtE: ast.Lt(),
    ast.Gt: ast.GtE(),
    ast.GtE: ast.Gt(),
    ast.Eq: ast.NotEq(),
    ast.NotEq: ast.Eq(),
    ast.In: ast.NotIn(),
    ast.NotIn: ast.In(),
    ast.Is: ast.IsNot(),
    ast.IsNot: ast.Is(),
}


@dataclass(frozen=True)
class Mutant:
    """A file in which one place is another."""

    path: str  # of the file, from the top of the tree
    where: str  # function or class, with those around it
    before: str
    after: str
    number: int  # among those of one place that read the same
    first: int  # lines of the statement, from 1
    last: int
    source: str  # the whole file

    @property
    def name(self) -> str:
        """The same as long as the place reads the same."""
        more = f" #{self.number}" if self.number else ""
        return f"{self.path} {self.where}: {self.before} -> {self.after}{more}"


def mutants_of(path: Path, root: Path) -> list[Mutant]:
    """All mutants of one file, in the order of their places."""
    text = path.read_text(encoding="utf-8")
    lines = text.encode().splitlines(keepends=True)
    starts = [sum(map(len, lines[:k])) for k in range(len(lines) + 1)]
    seen: Counter[tuple[str, ...]] = Counter()
    found = []
    for where, statement, node, after in _places(ast.parse(text)):
        first = starts[node.lineno - 1] + node.col_offset
        last = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        data = text.encode()
        source = (data[:first] + after.encode() + data[last:]).decode()
        before = _short(data[first:last].decode())
        key = (where, before, _short(after))
        ends = statement.lineno, statement.end_lineno or statement.lineno
        name = path.relative_to(root).as_posix()
        found.append(Mutant(name, where, before, _short(after), seen[key], *ends, source))
        seen[key] += 1
    return found


def _short(text: str) -> str:
    """On one line, and no longer than that."""
    words = " ".join(text.split())
    return words if len(words) <= LONGEST else f"{words[:LONGEST]}..."


Place = tuple[str, ast.stmt, ast.stmt | ast.expr, str]


def _places(tree: ast.Module) -> Iterator[Place]:
    """Function, statement, what is replaced in it, and by what."""
    for where, statement in _statements(tree.body, ""):
        for node, after in [*_of_statement(statement), *_of_expressions(statement)]:
            yield where or "module", statement, node, after


def _statements(body: list[ast.stmt], where: str) -> Iterator[tuple[str, ast.stmt]]:
    for statement in body:
        if isinstance(statement, ast.If) and "TYPE_CHECKING" in ast.dump(statement.test):
            continue
        yield where, statement
        inside = where
        if isinstance(statement, ast.FunctionDef | ast.ClassDef):
            inside = f"{where}.{statement.name}".lstrip(".")
        for name in ("body", "orelse", "finalbody"):
            yield from _statements(getattr(statement, name, []), inside)
        for handler in getattr(statement, "handlers", []):
            yield from _statements(handler.body, inside)


def _of_statement(statement: ast.stmt) -> Iterator[tuple[ast.stmt, str]]:
    """Statements deleted, returns altered."""
    if isinstance(statement, ast.Expr):
        if not isinstance(statement.value, ast.Constant | ast.Yield | ast.YieldFrom):
            yield statement, "pass"
    elif isinstance(statement, ast.AugAssign | ast.Raise | ast.Continue | ast.Break):
        yield statement, "pass"
    elif isinstance(statement, ast.Return) and not (
        statement.value is None or isinstance(statement.value, ast.Constant)
    ):
        yield statement, "return None"


def _of_expressions(statement: ast.stmt) -> Iterator[tuple[ast.expr, str]]:
    """Operators, comparisons, constants and conditions of a statement, but not of those in it."""
    if isinstance(statement, ast.Raise | ast.Import | ast.ImportFrom | ast.Expr) and not (
        isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call)
    ):
        return
    for field, value in ast.iter_fields(statement):
        if field in ("annotation", "returns", "op", "type_params", "target") or (
            field in ("body", "orelse", "finalbody", "handlers")
        ):
            continue
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST) and not _is_of_types(statement, part):
                yield from _of_expression(part)
    test = statement.test if isinstance(statement, ast.If | ast.While) else None
    if isinstance(test, ast.Name | ast.Attribute | ast.Call | ast.BoolOp | ast.Subscript):
        yield test, f"not ({ast.unparse(test)})"


def _is_of_types(statement: ast.stmt, part: ast.AST) -> bool:
    """Whether it names a type: `Value = tuple[str, int]`, `X = A | B`."""
    if not isinstance(statement, ast.Assign):
        return False
    name = statement.targets[0]
    upper = isinstance(name, ast.Name) and name.id[:1].isupper() and not name.id.isupper()
    return upper and isinstance(part, ast.Subscript | ast.BinOp)


def _of_expression(node: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    if isinstance(node, ast.JoinedStr | ast.arg):
        return  # what messages say; annotations
    if isinstance(node, ast.expr):
        yield from ((node, after) for after in _changed(node))
    for child in ast.iter_child_nodes(node):
        yield from _of_expression(child)


def _changed(node: ast.expr) -> Iterator[str]:
    if isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in OPERATORS:
        other = type(node)(**{**vars(node), "op": OPERATORS[type(node.op)]})
        yield f"({ast.unparse(other)})"
    elif isinstance(node, ast.Compare) and len(node.ops) <= 2:
        for k, op in enumerate(node.ops):
            ops = [*node.ops[:k], OPERATORS[type(op)], *node.ops[k + 1 :]]
            yield f"({ast.unparse(ast.Compare(node.left, ops, node.comparators))})"
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield f"({ast.unparse(node.operand)})"
    elif isinstance(node, ast.IfExp):
        yield f"({ast.unparse(ast.IfExp(node.test, node.orelse, node.body))})"
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, bool):
            yield str(not node.value)
        elif isinstance(node.value, int):
            yield str(node.value + 1)
        elif isinstance(node.value, float):
            yield repr(node.value * 2 or 1.0)
