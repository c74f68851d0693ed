"""Weights of the published feature networks: `r2flow weights`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from r2flow.cli.app import app

if TYPE_CHECKING:
    from rich.table import Table


@app.command(epilog="Example: r2flow weights --add rangenet53 darknet53-1024.tar.gz")
def weights(
    add: Annotated[
        tuple[str, Path] | None,
        typer.Option(metavar="NAME FILE", help="Take a network's weights from a file, a .tar.gz or a folder."),
    ] = None,
) -> None:
    """Which weights the published distances have on this machine, and where the others are to be got.

    Nothing is fetched: get the file, then --add it. It is read as tensors alone, checked against its network and
    kept in R2FLOW_WEIGHTS, or ~/.cache/r2flow/weights.
    """
    from rich.console import Console

    from r2flow.metrics.extractors.weights import SOURCES, kept_file, weights_folder
    from r2flow.metrics.extractors.weights import add as take

    if add is not None:
        name, path = add
        found = take(name, path)
        same = {True: "the published file", False: "not the published file", None: "its published hash is not known"}
        print(f"{kept_file(name)}: weights {found.weights} of {found.source} ({same[found.published]})")
        return
    Console(width=None if Console().is_terminal else 200).print(_table())
    print(f"\nLooked for in {weights_folder()} (R2FLOW_WEIGHTS). Take one from disk: r2flow weights --add NAME FILE")
    for name, source in SOURCES.items():
        print(f"  {name}: {source.page}" + (f" (git blob {source.git_blob})" if source.git_blob else ""))


def _table() -> "Table":
    from rich.table import Table

    from r2flow.metrics.extractors.weights import SOURCES, kept

    table = Table("network", "distance", "here", "published file", "bytes", "SHA-256")
    for name, source in SOURCES.items():
        found = kept(name)
        here = f"{found.weights} of {found.source}" if found else "no"
        size = "not known" if source.size is None else f"{source.size:,}"
        table.add_row(name, source.metric, here, source.file, size, source.sha256 or "not known")
    return table
