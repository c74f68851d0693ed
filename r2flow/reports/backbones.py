"""Cost of backbones: the paper's table II, measured."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from statistics import median
from typing import Any, TypeVar

import torch
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from r2flow.backbones import BACKBONES, Backbone
from r2flow.base.errors import InputError
from r2flow.base.progress import track
from r2flow.generators import build_generator
from r2flow.lidar.sensors import Sensor
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table

_T = TypeVar("_T")

RULE = (
    "MACs of convolutions, matrix products, neighbourhood attention on the padded ring and group "
    "norm; "
    "scaled_dot_product_attention's products left out, as in the paper's table II"
)

_COLUMNS = {
    "name": "backbone",
    "parameters": "parameters",
    "gmac": "GMAC",
    "latency_ms": "latency, ms",
    "error": "",
}

_ATEN = torch.ops.aten
# Two operations a multiply-accumulate, as torch's counter.
_OPERATIONS: dict[Any, Callable[..., int]] = {
    _ATEN.native_group_norm: lambda x, weight, *_, **__: 2 * math.prod(x) * (5 if weight else 4),
}


class _FusedAttention(TorchDispatchMode):
    """Leaves the products of `scaled_dot_product_attention` out: an empty result of its shape.

    The counter's mapping does not do: torch 2.15 decomposes the operation before it looks there.
    """

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        if func is _ATEN.scaled_dot_product_attention.default:
            query, _, value = args[:3]
            return query.new_empty(*query.shape[:-1], value.shape[-1])
        return func(*args, **(kwargs or {}))


def count_parameters(model: nn.Module) -> int:
    """Number of learned parameters, without buffers."""
    return sum(parameter.numel() for parameter in model.parameters())


def count_macs(model: Backbone) -> int:
    """Multiply-accumulates of an evaluation for one image by the paper's rule (table II, "FLOPs"),
    on the meta device.

    The rule counts

    - convolutions, including resampling filters: taps x input channels per output value;
    - linear layers, recurrent layers and other matrix products: inputs per output value;
    - neighbourhood attention: 2 x window x channels per token of the map padded by half a window on
      both sides of the ring, where the published models compute it and crop;
    - group norm: 5 per value with a learned scale and shift, 4 without.

    It omits biases, activations, other norms, rotations and the two products of
    `scaled_dot_product_attention` (for HDiT 0.40 GMAC of 77.8, for the base ADM U-Net 8.6 of
    265.6): fused kernels that the paper's counter did not count. This rule reproduces all five rows
    of the table to 0.02 %.

    A module may have a method `macs(inputs, output)`, which replaces what is counted in its calls
    outside its children.
    """
    on_meta: dict[int, Any] = {
        id(tensor): tensor.detach().to("meta") for tensor in (*model.parameters(), *model.buffers())
    }
    model = copy.deepcopy(model, on_meta)  # without its weights
    x = torch.empty(1, model.in_channels, *model.coords.shape[2:], device="meta")
    # Of the modules that are being called: operations before, and those of inner calls.
    calls: list[list[int]] = []
    stated: list[int] = []

    def enter(module, inputs):
        calls.append([counter.get_total_flops(), 0])

    def leave(module, inputs, output):
        before, inner = calls.pop()
        operations = counter.get_total_flops() - before
        if calls:
            calls[-1][1] += operations
        if hasattr(module, "macs"):
            stated.append(int(module.macs(inputs, output)) - (operations - inner) // 2)

    for module in model.modules():
        module.register_forward_pre_hook(enter)
        module.register_forward_hook(leave)
    with (
        torch.inference_mode(),
        FlopCounterMode(display=False, custom_mapping=_OPERATIONS) as counter,
        _FusedAttention(),  # within the counter, so that it comes first
    ):
        model(torch.empty(1, device="meta"), x)
    return counter.get_total_flops() // 2 + sum(stated)


def report_backbones(
    sensor: Sensor, names: Sequence[str] | None = None, repeats: int = 3, device: str = "cpu"
) -> Page:
    """The page of `backbone_costs`."""
    names = names or list(BACKBONES)
    costs = backbone_costs(sensor, names, repeats, device)
    rows = list(track(costs, "measuring", "backbones", total=len(names)))
    size = " x ".join(map(str, sensor.shape))
    table = Table(rows, _COLUMNS, f"{size}, batch 1, float32, {device}")
    text: list[Part] = [table, f"GMAC: {RULE}."]
    return Page("backbones", "Cost of backbones", text, rows, device=device)


def backbone_costs(
    sensor: Sensor, names: Sequence[str] | None = None, repeats: int = 3, device: str = "cpu"
) -> Iterator[Row]:
    """Parameters, GMAC and median latency in float32 of every configuration for one image of two
    channels.

    The latency is None without `repeats`. A configuration that does not support the size has only
    an `error`.
    """
    for name in names or BACKBONES:
        backbone = BACKBONES[name]
        try:
            with torch.device("cpu" if repeats > 0 else "meta"):  # counting needs no weights
                model = backbone(sensor.rays()).eval()
        except InputError as error:
            yield {"name": name, "error": str(error)}
        else:
            yield {"name": name, **_cost_of(model, repeats, device)}


def cost(config: Mapping[str, Any], repeats: int = 0, device: str = "cpu") -> Row:
    """Parameters, GMAC and, if `repeats`, milliseconds of one evaluation for one image of a
    config's backbone.
    """
    generator = build_generator(config).eval()
    model = getattr(generator, "backbone", None)
    if not isinstance(model, Backbone):
        return {"parameters": count_parameters(generator), "gmac": None, "latency_ms": None}
    return _cost_of(model, repeats, device)


def _cost_of(model: Backbone, repeats: int, device: str) -> Row:
    row: Row = {"parameters": count_parameters(model), "gmac": None, "latency_ms": None}
    with suppress(Exception):  # of a network that cannot run on the meta device
        row["gmac"] = count_macs(model) / 1e9
    if repeats:
        shape = 1, model.in_channels, *model.coords.shape[2:]
        model = model.to(device)
        x = torch.randn(shape, device=device)
        t = torch.full((1,), 0.5, device=device)
        with torch.inference_mode():
            seconds = [timed(partial(model, t, x), device)[1] for _ in range(repeats + 1)]
        row["latency_ms"] = 1e3 * median(seconds[1:])  # without the warm-up
    return row


def timed(call: Callable[[], _T], device: torch.device | str = "cpu") -> tuple[_T, float]:
    """Result of a call and its duration in seconds, including work on the device."""
    wait = (
        torch.accelerator.synchronize if torch.device(device).type != "cpu" else lambda device: None
    )
    wait(device)
    begin = time.perf_counter()
    result = call()
    wait(device)
    return result, time.perf_counter() - begin
