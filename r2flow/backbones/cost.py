"""What a backbone costs: parameters, and multiply-accumulates by the paper's rule (its table II, "FLOPs").

For one image, the rule counts
- a convolution, resampling filters included: taps x input channels for each output value;
- a linear layer, the four of `nn.MultiheadAttention` included: inputs for each output value;
- neighbourhood attention: 2 x window x channels for each token of the map padded by half a window on both
  sides of the ring, where the published models compute it and crop;
- group norm: 5 for each value where it has a learned scale and shift, 4 where it has none.

It leaves out biases, activations, other norms, rotations and *global* attention's two matrix products (for HDiT
0.40 GMAC of 77.8, for the base ADM U-Net 8.6 of 265.6): fused kernels that the paper's counter did not see. It is
the one rule under which all five rows of the table come out, to 0.02 %.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.backbones.convolutions import Resample
from r2flow.backbones.hdit import Attention

RULE = (
    "MACs of convolutions, linear layers, neighbourhood attention on the padded ring and group norm; "
    "global attention's products left out, as in the paper's table II"
)


def count_parameters(model: nn.Module) -> int:
    """Learned numbers; buffers are none."""
    return sum(parameter.numel() for parameter in model.parameters())


def count_macs(model: Backbone) -> int:
    """Multiply-accumulates of one evaluation for one image, by the rule above; nothing is computed."""
    on_meta = {name: tensor.to("meta") for name, tensor in (*model.named_parameters(), *model.named_buffers())}
    x = torch.empty(1, model.in_channels, *model.coords.shape[2:], device="meta")
    with _counting(model) as counts:
        torch.func.functional_call(model, on_meta, (torch.empty(1, device="meta"), x))
    return sum(counts)


@contextmanager
def _counting(model: nn.Module) -> Iterator[list[int]]:
    counts: list[int] = []
    handles = [
        module.register_forward_hook(lambda *call: counts.append(_macs(*call)))
        for module in model.modules()
        if isinstance(module, nn.Conv2d | nn.Linear | nn.GroupNorm | nn.MultiheadAttention | Resample | Attention)
    ]
    try:
        yield counts
    finally:
        for handle in handles:
            handle.remove()


def _macs(module: nn.Module, inputs: tuple[Any, ...], output: Any) -> int:
    x: Tensor = inputs[0]
    match module:
        case nn.Conv2d():
            return output.numel() * module.weight[0].numel()
        case Resample():
            return output.numel() * module.kernel.numel() ** 2
        case nn.Linear():
            return output.numel() * module.in_features
        case nn.GroupNorm():
            return x.numel() * (5 if module.affine else 4)
        case nn.MultiheadAttention():
            return 4 * x.numel() * module.embed_dim
        case Attention() if module.local is not None:
            (rows, columns), ring, _ = module.local
            batch, height, width, channels = x.shape
            padded = width + 2 * (columns // 2) if ring else width
            return 2 * batch * height * padded * rows * columns * channels
    return 0
