"""Cost of a backbone: parameters, and multiply-accumulates by the paper's rule (table II, "FLOPs").

For one image, the rule counts

- convolutions, including resampling filters: taps x input channels per output value;
- linear layers, recurrent layers and other matrix products: inputs per output value;
- neighbourhood attention: 2 x window x channels per token of the map padded by half a window on both sides of the
  ring, where the published models compute it and crop;
- group norm: 5 per value with a learned scale and shift, 4 without.

It omits biases, activations, other norms, rotations and the two products of `scaled_dot_product_attention` (for HDiT
0.40 GMAC of 77.8, for the base ADM U-Net 8.6 of 265.6): fused kernels that the paper's counter did not count. This
rule reproduces all five rows of the table to 0.02 %.

A module may have a method `macs(inputs, output)`, which replaces what is counted in its calls outside its children.
"""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from r2flow.backbones.base import Backbone

RULE = (
    "MACs of convolutions, matrix products, neighbourhood attention on the padded ring and group norm; "
    "scaled_dot_product_attention's products left out, as in the paper's table II"
)

ATEN = torch.ops.aten
OPERATIONS: dict[Any, Callable[..., int]] = {  # two operations a multiply-accumulate, as the counter of torch
    ATEN.native_group_norm: lambda x, weight, *_, **__: 2 * math.prod(x) * (5 if weight else 4),
    ATEN.scaled_dot_product_attention.default: lambda *_, **__: 0,
}


def count_parameters(model: nn.Module) -> int:
    """Number of learned parameters, without buffers."""
    return sum(parameter.numel() for parameter in model.parameters())


def count_macs(model: Backbone) -> int:
    """Multiply-accumulates of an evaluation for one image, by the rule above, counted on the meta device."""
    on_meta = {name: tensor.detach().to("meta") for name, tensor in (*model.named_parameters(), *model.named_buffers())}
    x = torch.empty(1, model.in_channels, *model.coords.shape[2:], device="meta")
    calls: list[list[int]] = []  # of the modules that are being called: operations before, and those of inner calls
    stated: list[int] = []

    def enter(module: nn.Module, inputs: Any) -> None:
        calls.append([counter.get_total_flops(), 0])

    def leave(module: nn.Module, inputs: Any, output: Any) -> None:
        before, inner = calls.pop()
        operations = counter.get_total_flops() - before
        if calls:
            calls[-1][1] += operations
        if hasattr(module, "macs"):
            stated.append(int(module.macs(inputs, output)) - (operations - inner) // 2)  # type: ignore[operator]

    handles = [module.register_forward_pre_hook(enter) for module in model.modules()]
    handles += [module.register_forward_hook(leave) for module in model.modules()]
    try:
        with torch.inference_mode(), FlopCounterMode(display=False, custom_mapping=OPERATIONS) as counter:
            torch.func.functional_call(model, on_meta, (torch.empty(1, device="meta"), x), tie_weights=False)
    finally:
        for handle in handles:
            handle.remove()
    return counter.get_total_flops() // 2 + sum(stated)
