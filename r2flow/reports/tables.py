"""Tables, in a page's Markdown and in the terminal."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from r2flow.errors import printable

Row = Mapping[str, Any]
# By key, with a heading for each in order; or cells in order, with a heading for each.
Rows = Sequence[Row] | Sequence[Sequence[Any]]
Columns = Mapping[str, str] | Sequence[str]

NUMBER = re.compile(r"[-+]?\d|-?$|none$|inf$")  # how cells of a right-aligned column begin


def table(rows: Rows, columns: Columns) -> str:
    """Rows as a Markdown table; numbers are printed to three digits."""
    headings, cells = _text(rows, columns)
    lines = ["| " + " | ".join(headings) + " |", "|" + "---|" * len(headings)]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in cells]
    return "\n".join(lines)


def print_table(rows: Rows, columns: Columns, title: str = "") -> None:
    """Rows as a table in the terminal: numbers to the right, no cell cut short; all headings "": no line of them."""
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    headings, cells = _text(rows, columns)
    grid = Table(
        box=None, header_style="bold", pad_edge=False, title=title or None, title_justify="left",
        show_header=any(headings),
    )  # fmt: skip
    for heading, column in zip(headings, zip(*cells, strict=True) if cells else headings, strict=True):
        right = bool(cells) and all(NUMBER.match(cell) for cell in column)
        grid.add_column(Text(heading), justify="right" if right else "left", no_wrap=True)
    for line in cells:
        grid.add_row(*(Text(printable(cell)) for cell in line))
    console = Console()
    # A terminal that is too narrow wraps the lines.
    console.width = max(console.width, Measurement.get(console, console.options.update(width=10**5), grid).maximum)
    with console.capture() as drawn:
        console.print(grid, crop=False)
    print("\n".join(line.rstrip() for line in drawn.get().splitlines()))  # no cell is as wide as the widest one


def shown(value: Any) -> str:
    """A value for a reader: 0.00123, 1.2e-05, 128, '' for nothing."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return "-"
    return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e4 else f"{value:.1e}"


def _text(rows: Rows, columns: Columns) -> tuple[list[str], list[list[str]]]:
    """Headings and cells."""
    if isinstance(columns, Mapping):
        return list(columns.values()), [[shown(row.get(key)) for key in columns] for row in rows]  # type: ignore[union-attr]
    return list(columns), [[shown(cell) for cell in row] for row in rows]
