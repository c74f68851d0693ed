"""The command, and its group of reports."""

import typer

# Imports of torch and matplotlib stay inside the verbs: --help and a mistyped option answer at once.

app = typer.Typer(
    help=(
        "Rectified flows for LiDAR scans: train, sample, show, measure. "
        "--plugin MODULE, with any verb, imports a module of yours first (or a path ending in .py)."
    ),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

report = typer.Typer(help="Measure scans and flows.", no_args_is_help=True, pretty_exceptions_enable=False)
app.add_typer(report, name="report")
