"""`r2flow compare`: runs side by side."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.cli.output import command


@app.command(epilog="Example: r2flow compare runs/sweep --group --out reports")
def compare(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, or folders of them: a chain's, a sweep's.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for compare.md, .csv, .json and .png.")
    ] = None,
    group: Annotated[
        bool, typer.Option("--group", help="Several seeds of one configuration as mean ± spread.")
    ] = False,
) -> None:
    """Set runs side by side: loss, straightness, parameters, cost."""
    from r2flow.reports.compare import compare_page, group_runs, read_runs, tables
    from r2flow.reports.pages import prepare_folder, write_page
    from r2flow.reports.tables import print_table

    compared = read_runs(runs)
    groups = group_runs(compared) if group else {run.label: [run] for run in compared}
    if out is not None:
        prepare_folder(out)
    for title, (cells, headings) in tables(groups).items():
        print_table(cells, headings, title)
        print()
    if out is not None:
        for path in write_page(compare_page(groups, command()), out):
            print(path)
