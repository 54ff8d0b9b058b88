"""Tables for people, and numbers as JSON has them."""

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

DASH = "-"  # what stands for a missing value
TIGHT = (0, 0)  # the lines between columns are blanks, and 80 columns have to do
CLOSE = (0, 1, 0, 0)


def to_json(values: Mapping[str, Any]) -> str:
    """One JSON object on one line; a number that is not finite is a programming error."""
    return json.dumps(values, allow_nan=False)


def number(value: float, digits: int) -> float | None:
    """A rounded number; None, JSON's null, for one that is not finite."""
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    return round(float(value), digits) + 0.0 if math.isfinite(value) else None


def numbers(values: Mapping[str, float], digits: int) -> dict[str, float | None]:
    """Rounded numbers by name."""
    return {name: number(value, digits) for name, value in values.items()}


def plain_table(title: str | None) -> Table:
    """A table without vertical lines, its title on the left."""
    shown = None if title is None else Text(title)  # a name may look like markup: [x]
    return Table(title=shown, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)


def table(
    title: str | None,
    columns: Sequence[str | tuple[str, str]],
    rows: Iterable[Sequence[object]],
    left: Collection[int] = (0,),
    padding: tuple[int, ...] = (0, 1),
) -> Table:
    """A :func:`plain_table` of rows.

    Args:
        title: above it.
        columns: headings, each alone or with the format of its numbers, such as `{:.2f}`.
        rows: cells: texts, numbers, and None for a :data:`DASH`; an empty row is a line.
        left: columns that are aligned on the left; all others are on the right.
        padding: of a cell: :data:`TIGHT`, :data:`CLOSE` or rich's own.
    """
    made = plain_table(title)
    made.padding = padding  # type: ignore[assignment]
    pairs = [(column, "{}") if isinstance(column, str) else column for column in columns]
    for place, (heading, _) in enumerate(pairs):
        made.add_column(Text(heading), justify="left" if place in left else "right", no_wrap=True)
    for row in rows:
        if not row:
            made.add_section()
        else:
            made.add_row(*(_cell(value, f) for value, (_, f) in zip(row, pairs, strict=True)))
    return made


def keyed_table(
    title: str | None,
    first: str,
    columns: Sequence[tuple[str, str, str]],
    rows: Mapping[str, Mapping[str, object]],
    left: Collection[int] = (0,),
    padding: tuple[int, ...] = (0, 1),
) -> Table:
    """A :func:`table` of named rows, the names under `first`; columns: key, heading, format."""
    headings: list[str | tuple[str, str]] = [first, *((text, form) for _, text, form in columns)]
    cells = [[name, *(row[key] for key, _, _ in columns)] for name, row in rows.items()]
    return table(title, headings, cells, left, padding)


def legend(text: str) -> Text:
    """What the headings of a table mean, below it."""
    return Text(text, style="dim")


def _cell(value: object, form: str) -> Text:
    if isinstance(value, Text):
        return value
    if value is None:
        return Text(DASH)
    return Text(value if isinstance(value, str) else form.format(value))
