"""What each backbone costs: the paper's table II, measured here."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from statistics import median
from typing import Any

import torch
from torch import nn

from r2flow.backbones import Backbone, build_backbone, configurations
from r2flow.backbones.cost import RULE, count_macs, count_parameters
from r2flow.errors import InputError
from r2flow.generators import RectifiedFlow, build_generator
from r2flow.lidar.sensors import Sensor
from r2flow.reports.tables import print_table
from r2flow.reports.timing import timed


def backbone_costs(
    sensor: Sensor, names: Sequence[str] | None = None, repeats: int = 3, device: str = "cpu"
) -> Iterator[dict[str, Any]]:
    """Parameters, GMAC and median latency of every configuration for one image of two channels, one at a time.

    Args:
        names: Of `configurations`; None for all.
        repeats: Timed evaluations after one warm-up; with 0 the latency is None.

    Returns:
        `{name, parameters, gmac, latency_ms}`; a configuration that cannot take the size has None for all three and
        says why under `error`.
    """
    known = configurations()
    for name in names or known:
        options = known[name]
        row: dict[str, Any] = {"name": name, "parameters": None, "gmac": None, "latency_ms": None}
        try:
            with torch.device("cpu" if repeats > 0 else "meta"):  # counting needs no weights
                model = build_backbone(options, sensor.rays(), 2).eval()
        except InputError as error:
            yield {**row, "error": str(error)}
            continue
        yield {**row, **_cost_of(model, (1, 2, *sensor.shape), repeats, device)}


def cost(config: Mapping[str, Any], repeats: int = 0, device: str = "cpu") -> dict[str, Any]:
    """Parameters, GMAC and, if `repeats`, milliseconds of one evaluation for one image of a config's backbone."""
    generator = build_generator(config)
    if not isinstance(generator, RectifiedFlow):
        return {"parameters": count_parameters(generator), "gmac": None, "latency_ms": None}
    return _cost_of(generator.backbone.eval(), (1, *generator.space.shape), repeats, device)


def _cost_of(model: Backbone, shape: tuple[int, ...], repeats: int, device: str) -> dict[str, Any]:
    row = {"parameters": count_parameters(model), "gmac": count_macs(model) / 1e9, "latency_ms": None}
    return row | {"latency_ms": latency(model.to(device), shape, repeats, device)} if repeats else row


def latency(model: nn.Module, shape: tuple[int, ...], repeats: int, device: str) -> float:
    """Median milliseconds of one evaluation in float32, without gradients."""
    x, t = torch.randn(shape, device=device), torch.full((shape[0],), 0.5, device=device)
    with torch.inference_mode():
        seconds = [timed(partial(model, t, x), device)[1] for _ in range(repeats + 1)]
    return 1e3 * median(seconds[1:])


def print_costs(rows: Sequence[dict[str, Any]], sensor: Sensor, device: str) -> None:
    """The rows as a table, with the counting rule."""
    forms = {"parameters": "{:,}", "gmac": "{:.2f}", "latency_ms": "{:,.0f}"}
    cells = [row | {key: form.format(row[key]) for key, form in forms.items() if row[key] is not None} for row in rows]
    columns = {"name": "backbone", "parameters": "parameters", "gmac": "GMAC", "latency_ms": "latency, ms"}
    if any("error" in row for row in rows):
        columns["error"] = ""
    print_table(cells, columns, f"{' x '.join(map(str, sensor.shape))}, batch 1, float32, {device}")
    print(f"GMAC: {RULE}.")
