"""Contents of a checkpoint, and what is installed."""

from pathlib import Path
from typing import Any

from r2flow.metrics import FIELD_NAMES
from r2flow.metrics.extractors.base import SOURCES, kept, weights_folder
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.shipped import MODELS, name_of
from r2flow.reports.tables import print_table


def describe(path: str | Path) -> dict[str, Any]:
    """Generator, parameters, sensor, encoding, step and config of a checkpoint."""
    loaded = load_checkpoint(path)
    model = name_of(loaded.path)
    config = loaded.config
    generator = loaded.generator
    about = {}
    if model:
        about = {"model": model, "samples": MODELS[model].about, "licence": MODELS[model].licence}
    if generator.unconditional or generator.takes_condition:
        about |= generator.drawing()
    return {
        "path": str(loaded.path),
        "bytes": loaded.path.stat().st_size,
        "format": loaded.format,
        "step": loaded.step,
        "stage": config.stage.name or "unknown",
        "generator": config.generator["name"],
        "backbone": config.backbone,
        "parameters": sum(parameter.numel() for parameter in generator.parameters()),
        "sensor": loaded.sensor.name,
        "image": list(loaded.encoding.shape),
        "range_m": [loaded.sensor.min_range, loaded.sensor.max_range],
        **about,
        "config": {key: config.stored[key] for key in config.stored if key != "published"},
    }


def print_known() -> None:
    """List the models, and the feature networks with their distances and sources."""
    print_table([(name, model.about) for name, model in MODELS.items()], ("model", "samples"))
    print()
    rows = [(name, FIELD_NAMES[name].upper(), kept(name) or "no") for name in SOURCES]
    print_table(rows, ("network", "distance", "installed"))
    print("", "Published files:", *SOURCES.values(), sep="\n")
    print(
        f"\nLooked for in {weights_folder()} (R2FLOW_WEIGHTS). Install one: r2flow info --add NAME "
        "FILE"
    )
