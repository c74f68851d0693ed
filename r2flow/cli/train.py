"""Training, for those who have no checkout."""

import sys

import typer

from r2flow.cli.app import app


@app.command(
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
    epilog="Example: r2flow train data=kitti_raw data.root=FOLDER backbone=hdit_small",
)
def train(context: typer.Context) -> int:
    """Train a flow: keys and choices of the config as KEY=VALUE; --help lists the choices, --cfg job every key."""
    from r2flow.runs.launch import main

    return main(context.args, [sys.executable, "-m", "r2flow.cli", "train"])
