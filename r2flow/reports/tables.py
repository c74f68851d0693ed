"""Tables in Markdown and in the terminal."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from rich.cells import cell_len

from r2flow.errors import one_line

Row = Mapping[str, Any]
# By key, with a heading for each in order; or cells in order, with a heading for each.
Rows = Sequence[Row] | Sequence[Sequence[Any]]
Columns = Mapping[str, str] | Sequence[str]

NUMBER = re.compile(r"[-+]?\d|-?$|none$|inf$")  # how cells of a right-aligned column begin


def table(rows: Rows, columns: Columns) -> str:
    """Format rows as a Markdown table, numbers with three digits."""
    headings, cells = _text(rows, columns)
    escaped = [[cell.replace("|", "\\|") for cell in line] for line in (headings, *cells)]
    first, *others = ["| " + " | ".join(line) + " |" for line in escaped]
    return "\n".join([first, "|" + "---|" * len(headings), *others])


def print_table(rows: Rows, columns: Columns, title: str = "") -> None:
    """Print rows as a table: numbers right-aligned, cells not truncated, no heading line if all headings are ""."""
    headings, cells = _text(rows, columns)
    lines = [headings, *cells] if any(headings) else cells
    widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
    right = [bool(cells) and all(map(NUMBER.match, column)) for column in zip(*cells or [headings], strict=True)]
    if title:
        print(title)
    for line in lines:
        gaps = [" " * (width - cell_len(cell)) for cell, width in zip(line, widths, strict=True)]
        padded = [gap + cell if r else cell + gap for cell, gap, r in zip(line, gaps, right, strict=True)]
        print("  ".join(padded).rstrip())


def shown(value: Any) -> str:
    """Format a value: 0.00123, 1.2e-05, 128, '' for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if not isinstance(value, float):
        return str(value)
    if math.isnan(value):
        return "-"
    return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e4 else f"{value:.1e}"


def words(values: Mapping[str, Any]) -> str:
    """Format named values: 'cores 2, threads 1'."""
    return ", ".join(f"{key} {shown(value)}" for key, value in values.items())


def _text(rows: Rows, columns: Columns) -> tuple[list[str], list[list[str]]]:
    if isinstance(columns, Mapping):
        rows, columns = [[row.get(key) for key in columns] for row in rows], list(columns.values())  # type: ignore[union-attr]
    return [*map(one_line, columns)], [[one_line(shown(cell)) for cell in row] for row in rows]
