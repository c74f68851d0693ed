"""Tables in Markdown, in LaTeX and in the terminal."""

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from r2flow.base.errors import one_line

Row = dict[str, Any]
# Rows by key, with a heading for each key in order; or cells in order, with a heading for each.
_Rows = Sequence[Row] | Sequence[Sequence[Any]]
_Columns = Mapping[str, str] | Sequence[str]

_NUMBER = re.compile(r"[-+]?\d|-?$|none$|inf$")  # how cells of a right-aligned column begin


class Table(NamedTuple):
    """A table of a page."""

    rows: _Rows
    columns: _Columns
    title: str = ""


Part = str | Table  # of the text of a page


def markdown(rows: _Rows, columns: _Columns, title: str = "") -> str:
    """Format a table for Markdown, numbers with three digits."""
    lines = [[cell.replace("|", "\\|") for cell in line] for line in _as_text(rows, columns)]
    lines.insert(1, ["---"] * len(lines[0]))
    heading = [f"## {title}\n"] if title else []
    return "\n".join([*heading, *(f"| {' | '.join(line)} |" for line in lines)])


def latex(rows: _Rows, columns: _Columns, title: str = "") -> str:
    """Format a table for LaTeX, of the package booktabs."""
    lines = [
        " & ".join(re.sub(r"([&%$#_{}])", r"\\\1", cell) for cell in line).replace("±", r"$\pm$")
        for line in _as_text(rows, columns)
    ]
    heading = [f"% {title}"] if title else []
    head, *body = (rf"{line} \\" for line in lines)
    begin = rf"\begin{{tabular}}{{{'l' * len(columns)}}}"
    parts = [*heading, begin, r"\toprule", head, r"\midrule", *body]
    return "\n".join([*parts, r"\bottomrule", r"\end{tabular}"]) + "\n"


def print_table(rows: _Rows, columns: _Columns, title: str = "") -> None:
    """Print a table: numbers right-aligned, no heading line if all headings are "".

    A terminal's table has its width; elsewhere, as in a log, lines are as long as their cells.
    """
    lines = _as_text(rows, columns)
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=any(lines[0]))
    for heading, *cells in zip(*lines, strict=True):
        numeric = all(map(_NUMBER.match, cells))
        grid.add_column(Text(heading), justify="right" if numeric else "left", overflow="fold")
    for line in lines[1:]:
        grid.add_row(*map(Text, line))
    if title:
        print(title)
    console = Console()
    if not console.is_terminal:
        console.width = 10**6
    with console.capture() as captured:
        console.print(grid)
    for printed in captured.get().splitlines():
        print(printed.rstrip())


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
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}"
    return f"{value:.1e}"


def short_names(paths: Sequence[str | Path]) -> list[str]:
    """Names of files or folders, with as many parents as needed to be unique."""
    parts = [Path(os.path.abspath(path)).parts for path in paths]  # links keep their names
    depth = 1
    while len({names[-depth:] for names in parts}) < len(set(parts)):
        depth += 1
    return ["/".join(names[-depth:]) for names in parts]


def words(values: Mapping[str, Any]) -> str:
    """Format named values that are not None: 'cores 2, threads 1'."""
    return ", ".join(f"{key} {shown(x)}" for key, x in values.items() if x is not None)


def _as_text(rows: _Rows, columns: _Columns) -> list[list[str]]:
    """Headings and cells, line by line."""
    lines = [columns, *rows]
    if isinstance(columns, Mapping):
        lines = [columns.values(), *([row.get(key) for key in columns] for row in rows)]  # type: ignore[union-attr]
    return [[one_line(shown(cell)) for cell in line] for line in lines]
