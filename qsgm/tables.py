"""Tables for people and numbers for JSON: what every report shares."""

import json
import math
from collections.abc import Mapping
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text


def to_json(values: Mapping[str, Any]) -> str:
    """One JSON object on one line; a number that is not finite is a programming error."""
    return json.dumps(values, allow_nan=False)


def number(value: float, digits: int) -> float | None:
    """A rounded number; None, JSON's null, for one that is not finite."""
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    return round(float(value), digits) + 0.0 if math.isfinite(value) else None


def plain_table(title: str | None) -> Table:
    """A table without vertical lines, its title on the left."""
    shown = None if title is None else Text(title)  # a name may look like markup: [x]
    return Table(title=shown, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
