"""What is in a checkpoint, for a reader and as JSON."""

from pathlib import Path
from typing import Any

from r2flow.checkpoints import load_checkpoint
from r2flow.reports.tables import print_table
from r2flow.runs import flatten


def describe(path: str | Path) -> dict[str, Any]:
    """Backbone, parameters, sensor, encoding, step and config of a checkpoint file or run folder."""
    loaded = load_checkpoint(path)
    rows, columns = loaded.sensor.shape
    return {
        "path": str(loaded.path),
        "format": loaded.format,
        "step": loaded.step,
        "stage": loaded.config.get("stage", {}).get("name", "unknown"),
        "backbone": loaded.config["backbone"]["name"],
        "parameters": sum(p.numel() for p in loaded.generator.parameters()),
        "image": [loaded.encoding.channels, rows, columns],
        "sensor": loaded.sensor.name,
        "range_m": [loaded.sensor.min_range, loaded.sensor.max_range],
        "encoding": loaded.config["encoding"],
        "config": loaded.config,
    }


def print_contents(contents: dict[str, Any]) -> None:
    """The same as two short tables."""
    summary = {key: value for key, value in contents.items() if key != "config"}
    summary["image"] = " x ".join(map(str, contents["image"]))
    summary["encoding"] = ", ".join(f"{key} {value}" for key, value in contents["encoding"].items())
    summary |= {key: f"{value:,}" for key, value in summary.items() if isinstance(value, int)}
    print_table([(key, str(value)) for key, value in summary.items()], ("", ""))
    print()
    config = flatten({key: value for key, value in contents["config"].items() if key != "published"})
    print_table([(key, str(value)) for key, value in config], ("config", "value"))
