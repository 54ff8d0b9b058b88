"""What the tables of several benchmarks share."""

from rich.table import Table
from rich.text import Text

from qsgm.tune.report import plain_table


def right_table(title: str, *headings: str) -> Table:
    """Columns of numbers."""
    table = plain_table(title)
    table.padding = (0, 1, 0, 0)
    for heading in headings:
        table.add_column(Text(heading), justify="right")
    return table
