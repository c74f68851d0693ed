"""What each backbone costs: the paper's table II, measured here."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from statistics import median
from typing import Any

import torch
from torch import nn

from r2flow.backbones import build_backbone, configurations
from r2flow.backbones.cost import RULE, count_macs, count_parameters
from r2flow.errors import InputError
from r2flow.generators import RectifiedFlow, build_generator
from r2flow.lidar.sensors import Sensor
from r2flow.reports.tables import print_table
from r2flow.reports.timing import timed


def backbone_costs(
    sensor: Sensor, names: Sequence[str] | None = None, channels: int = 2, repeats: int = 3, device: str = "cpu"
) -> Iterator[dict[str, Any]]:
    """Parameters, GMAC and median latency of every configuration for one image, one at a time.

    Args:
        names: Of `configurations`; None for all.
        repeats: Timed evaluations after one warm-up; with 0 the latency is None.

    Returns:
        `{name, parameters, gmac, latency_ms}`; a configuration that cannot take the size has None for all three and
        says why under `error`.

    Raises:
        InputError: an unknown name.
    """
    known = configurations()
    for name in names or known:
        options = known[name]
        row: dict[str, Any] = {"name": name, "parameters": None, "gmac": None, "latency_ms": None}
        try:
            with torch.device("cpu" if repeats > 0 else "meta"):  # counting needs no weights
                model = build_backbone(options, sensor.rays(), channels).eval()
        except InputError as error:
            yield {**row, "error": str(error)}
            continue
        row["parameters"], row["gmac"] = count_parameters(model), count_macs(model) / 1e9
        if repeats > 0:
            row["latency_ms"] = latency(model.to(device), (1, channels, *sensor.shape), repeats, device)
        yield row


def cost(config: Mapping[str, Any], repeats: int = 0, device: str = "cpu") -> dict[str, Any]:
    """Parameters, GMAC and, if `repeats`, milliseconds of one evaluation for one image of a config's backbone."""
    generator = build_generator(config)
    if not isinstance(generator, RectifiedFlow):
        return {"parameters": count_parameters(generator), "gmac": None, "latency_ms": None}
    model = generator.untold().backbone.eval()
    parameters, gmac, shape = count_parameters(model), count_macs(model) / 1e9, (1, *generator.space.shape)
    time = latency(model.to(device), shape, repeats, device) if repeats else None
    return {"parameters": parameters, "gmac": gmac, "latency_ms": time}


def latency(model: nn.Module, shape: tuple[int, ...], repeats: int, device: str) -> float:
    """Median milliseconds of one evaluation in float32, without gradients."""
    x, t = torch.randn(shape, device=device), torch.full((shape[0],), 0.5, device=device)
    with torch.inference_mode():
        seconds = [timed(partial(model, t, x), device)[1] for _ in range(repeats + 1)]
    return 1e3 * median(seconds[1:])


def print_costs(rows: Sequence[dict[str, Any]], sensor: Sensor, device: str) -> None:
    """The rows as a table, with the counting rule."""
    height, width = sensor.shape
    formats = {"parameters": "{:,}", "gmac": "{:.2f}", "latency_ms": "{:,.0f}"}
    cells = [
        row | {key: form.format(row[key]) for key, form in formats.items() if row[key] is not None} for row in rows
    ]
    columns = {"name": "backbone", "parameters": "parameters", "gmac": "GMAC", "latency_ms": "latency, ms"}
    if any("error" in row for row in rows):
        columns["error"] = ""
    print_table(cells, columns, f"{height} x {width}, batch 1, float32, {device}")
    print(f"GMAC: {RULE}.")
