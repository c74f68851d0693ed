"""Contents of a checkpoint, as tables and JSON."""

from pathlib import Path
from typing import Any

from r2flow.config import flatten
from r2flow.model.checkpoint import load_checkpoint
from r2flow.models import MODELS, name_of
from r2flow.reports.tables import print_table


def describe(path: str | Path) -> dict[str, Any]:
    """Generator, parameters, sensor, encoding, step and config of a checkpoint file or run folder."""
    loaded = load_checkpoint(path)
    model = name_of(loaded.path)
    about = {"model": model, "draws": MODELS[model].about, "licence": MODELS[model].licence} if model else {}
    return {
        **about,
        "path": str(loaded.path),
        "bytes": loaded.path.stat().st_size,
        "format": loaded.format,
        "step": loaded.step,
        "stage": loaded.config.get("stage", {}).get("name", "unknown"),
        "generator": (loaded.config.get("generator") or {}).get("name", "rectified_flow"),
        "backbone": (loaded.config["backbone"] or {}).get("name"),
        "parameters": sum(p.numel() for p in loaded.generator.parameters()),
        "image": list(loaded.encoding.shape),
        "sensor": loaded.sensor.name,
        "range_m": [loaded.sensor.min_range, loaded.sensor.max_range],
        "encoding": loaded.config["encoding"],
        **(loaded.generator.drawing() if loaded.generator.draws or loaded.generator.told else {}),
        "config": loaded.config,
    }


def print_contents(contents: dict[str, Any]) -> None:
    summary = {key: value for key, value in contents.items() if key != "config"}
    summary["image"] = " x ".join(map(str, contents["image"]))
    for name in ("encoding", "sampler", "few"):
        if options := contents.get(name):
            summary[name] = ", ".join(f"{key} {value}" for key, value in options.items())
    summary |= {key: f"{value:,}" for key, value in summary.items() if type(value) is int}
    print_table([(key, str(value)) for key, value in summary.items()], ("", ""))
    print()
    config = flatten({key: value for key, value in contents["config"].items() if key != "published"})
    print_table([(key, str(value)) for key, value in config if value is not None], ("config", "value"))
