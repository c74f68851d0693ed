"""Cost of backbones: the paper's table II, measured."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from statistics import median
from typing import Any, TypeVar

import torch

from r2flow.backbones import Backbone, build_backbone, configurations
from r2flow.backbones.cost import RULE, count_macs, count_parameters
from r2flow.errors import InputError
from r2flow.generators import build_generator
from r2flow.lidar.sensors import Sensor
from r2flow.reports.tables import print_table

T = TypeVar("T")


def backbone_costs(
    sensor: Sensor, names: Sequence[str] | None = None, repeats: int = 3, device: str = "cpu"
) -> Iterator[dict[str, Any]]:
    """Parameters, GMAC and median latency in float32 of every configuration for one image of two channels.

    The latency is None without `repeats`. A configuration that does not support the size has only an `error`.
    """
    table = configurations()
    for name in names or table:
        options = table[name]
        try:
            with torch.device("cpu" if repeats > 0 else "meta"):  # counting needs no weights
                model = build_backbone(options, sensor.rays(), 2).eval()
        except InputError as error:
            yield {"name": name, "error": str(error)}
        else:
            yield {"name": name, **_cost_of(model, repeats, device)}


def cost(config: Mapping[str, Any], repeats: int = 0, device: str = "cpu") -> dict[str, Any]:
    """Parameters, GMAC and, if `repeats`, milliseconds of one evaluation for one image of a config's backbone."""
    generator = build_generator(config).eval()
    model = getattr(generator, "backbone", None)
    if not isinstance(model, Backbone):
        return {"parameters": count_parameters(generator), "gmac": None, "latency_ms": None}
    return _cost_of(model, repeats, device)


def _cost_of(model: Backbone, repeats: int, device: str) -> dict[str, Any]:
    row: dict[str, Any] = {"parameters": count_parameters(model), "gmac": None, "latency_ms": None}
    with suppress(Exception):  # of a network that cannot run on the meta device
        row["gmac"] = count_macs(model) / 1e9
    if repeats:
        shape = 1, model.in_channels, *model.coords.shape[2:]
        model, x, t = model.to(device), torch.randn(shape, device=device), torch.full((1,), 0.5, device=device)
        with torch.inference_mode():
            seconds = [timed(partial(model, t, x), device)[1] for _ in range(repeats + 1)]
        row["latency_ms"] = 1e3 * median(seconds[1:])  # without the warm-up
    return row


def timed(call: Callable[[], T], device: torch.device | str = "cpu") -> tuple[T, float]:
    """Result of a call and its duration in seconds, including work on the device."""
    wait = torch.cuda.synchronize if torch.device(device).type == "cuda" else lambda device: None
    wait(device)
    begin = time.perf_counter()
    result = call()
    wait(device)
    return result, time.perf_counter() - begin


def print_costs(rows: Sequence[dict[str, Any]], sensor: Sensor, device: str) -> None:
    forms = {"parameters": "{:,}", "gmac": "{:.2f}", "latency_ms": "{:,.0f}"}
    cells = [row | {key: form.format(row[key]) for key, form in forms.items() if row.get(key)} for row in rows]
    columns = {"name": "backbone", "parameters": "parameters", "gmac": "GMAC", "latency_ms": "latency, ms"}
    if any("error" in row for row in rows):
        columns["error"] = ""
    print_table(cells, columns, f"{' x '.join(map(str, sensor.shape))}, batch 1, float32, {device}")
    print(f"GMAC: {RULE}.")
