"""What is in a checkpoint, for a reader and as JSON."""

from pathlib import Path
from typing import Any

from r2flow.checkpoints import load_checkpoint
from r2flow.config import flatten


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
    from rich.console import Console
    from rich.table import Table

    summary = Table(show_header=False, box=None)
    for key, value in contents.items():
        if key != "config":
            shown = f"{value:,}" if isinstance(value, int) else value
            shown = " x ".join(map(str, value)) if key == "image" else shown
            shown = ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else shown
            summary.add_row(key, str(shown))
    details = Table("config", "value", box=None, header_style="bold")
    for key, value in flatten({k: v for k, v in contents["config"].items() if k != "published"}):
        details.add_row(key, str(value))
    console = Console()
    console.print(summary)
    console.print()
    console.print(details)
