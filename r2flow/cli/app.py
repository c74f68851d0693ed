"""The typer application and its group of reports."""

import typer

# Verbs import torch and matplotlib in their bodies, so that --help and usage errors are fast.

app = typer.Typer(
    help=(
        "Rectified flows for LiDAR scans: train, sample, view, evaluate. "
        "Every verb takes --plugin MODULE, which first imports a module or a .py file."
    ),
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

report = typer.Typer(
    help="Measure flows and solvers.", no_args_is_help=True, pretty_exceptions_enable=False
)
app.add_typer(report, name="report", rich_help_panel="Measure")
