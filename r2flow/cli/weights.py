"""Files of weights by name: models, and the published feature networks: `r2flow weights`."""

from pathlib import Path
from typing import Annotated

import typer

from r2flow.cli.app import app
from r2flow.errors import InputError
from r2flow.registry import did_you_mean


@app.command(epilog="Example: r2flow weights --add rangenet53 darknet53-1024.tar.gz")
def weights(
    add: Annotated[
        tuple[str, Path] | None,
        typer.Option(metavar="NAME FILE", help="Take a model from its file, or a network from a file or a folder."),
    ] = None,
) -> None:
    """Which trained models and which networks of published distances are on this machine, and where to get others.

    Nothing is fetched: get the file, then --add it. A model is checked by its SHA-256 and kept in R2FLOW_MODELS, or
    ~/.cache/r2flow/models. A network is read as tensors alone, checked and kept in R2FLOW_WEIGHTS, or
    ~/.cache/r2flow/weights.
    """
    from r2flow.metrics.extractors.weights import SOURCES, kept, kept_file, weights_folder
    from r2flow.metrics.extractors.weights import add as take
    from r2flow.models import MODELS, add_model, model_file, models_folder
    from r2flow.reports.tables import print_table

    if add is not None:
        name, path = add
        if name in MODELS:
            print(f"{add_model(name, path)}: the model {name}")
            return
        if name not in SOURCES:
            known = [*MODELS, *SOURCES]
            raise InputError(f"no weights named {name!r}; known: {', '.join(known)}.{did_you_mean(name, known)}")
        print(f"{kept_file(name)}: weights {take(name, path)} of {path.name}")
        return
    models = [
        (name, model.about, "yes" if model_file(name).is_file() else "no", model.page or "in the package")
        for name, model in MODELS.items()
    ]
    print_table(models, ("model", "draws", "here", "file"))
    print(f"\nLooked for in {models_folder()} (R2FLOW_MODELS) unless in the package. Draw: r2flow sample MODEL\n")
    rows = [(name, source.metric, kept(name) or "no", source.file) for name, source in SOURCES.items()]
    print_table(rows, ("network", "distance", "here", "published file"))
    print(f"\nLooked for in {weights_folder()} (R2FLOW_WEIGHTS). Take one from disk: r2flow weights --add NAME FILE")
    for name, source in SOURCES.items():
        print(f"  {name}: {source.page}")
