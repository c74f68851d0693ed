"""Cost of a backbone: parameters, and multiply-accumulates by the paper's rule (table II, "FLOPs").

For one image, the rule counts

- convolutions, including resampling filters: taps x input channels per output value;
- linear layers, including the four of `nn.MultiheadAttention`: inputs per output value;
- neighbourhood attention: 2 x window x channels per token of the map padded by half a window on both sides of the
  ring, where the published models compute it and crop;
- group norm: 5 per value with a learned scale and shift, 4 without.

It omits biases, activations, other norms, rotations and the two matrix products of *global* attention (for HDiT
0.40 GMAC of 77.8, for the base ADM U-Net 8.6 of 265.6): fused kernels that the paper's counter did not count. This
rule reproduces all five rows of the table to 0.02 %.
"""

import torch
from torch import Tensor, nn

from r2flow.backbones.base import Backbone

RULE = (
    "MACs of convolutions, linear layers, neighbourhood attention on the padded ring and group norm; "
    "global attention's products left out, as in the paper's table II"
)

LAYERS = nn.Conv2d, nn.ConvTranspose2d, nn.Linear, nn.GroupNorm, nn.MultiheadAttention


def count_parameters(model: nn.Module) -> int:
    """Number of learned parameters, without buffers."""
    return sum(parameter.numel() for parameter in model.parameters())


def count_macs(model: Backbone) -> int:
    """Multiply-accumulates of an evaluation for one image, by the rule above, counted on the meta device."""
    on_meta = {name: tensor.to("meta") for name, tensor in (*model.named_parameters(), *model.named_buffers())}
    x = torch.empty(1, model.in_channels, *model.coords.shape[2:], device="meta")
    counts: list[int] = []
    handles = [
        module.register_forward_hook(lambda *call: counts.append(_macs(*call)))
        for module in model.modules()
        if hasattr(module, "macs") or isinstance(module, LAYERS)
    ]
    try:
        torch.func.functional_call(model, on_meta, (torch.empty(1, device="meta"), x))
    finally:
        for handle in handles:
            handle.remove()
    return sum(counts)


def _macs(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> int:
    """Multiply-accumulates of a call, by the module's method `macs` if it has one."""
    macs = getattr(module, "macs", None)
    if macs is not None:
        return int(macs(inputs, output))
    match module:
        case nn.Conv2d():
            return output.numel() * module.weight[0].numel()
        case nn.ConvTranspose2d():
            return inputs[0].numel() * module.weight[0].numel()
        case nn.Linear():
            return output.numel() * module.in_features
        case nn.GroupNorm():
            return output.numel() * (5 if module.affine else 4)
        case nn.MultiheadAttention():
            return 4 * inputs[0].numel() * module.embed_dim
    raise TypeError(f"no rule for a {type(module).__name__}")
