"""A backbone on a part of its image: the same weights, the rays of the part, and no wrap where the turn is cut.

What a pixel sees beyond the cut is gone: neighbourhoods are moved inside, convolutions find zeros, global attention
and group norms know the part alone. The field is therefore another one, near the cut most of all; what that costs is
measured by `r2flow report savings`.
"""

import copy

from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.backbones.convolutions import Resample, RingConv2d, UNet
from r2flow.backbones.hdit import Attention, HDiT, LearnablePosition
from r2flow.errors import InputError


def unit_of(backbone: nn.Module) -> tuple[int, int]:
    """Rows and columns that a part of the image must be a multiple of, and begin at a multiple of.

    Raises:
        InputError: a backbone of which this is not known.
    """
    if isinstance(backbone, HDiT):
        shrink = 2 ** (backbone.levels - 1)
        return backbone.patch[0] * shrink, backbone.patch[1] * shrink
    if isinstance(backbone, UNet):
        halvings = sum(isinstance(module, Resample) and not module.up for module in backbone.modules())
        return 2**halvings, 2**halvings
    known = "hdit, adm_unet, efficient_unet"
    raise InputError(f"a {type(backbone).__name__} cannot be evaluated on a part of its image; these can: {known}.")


def cropped(backbone: nn.Module, rows: Tensor, columns: Tensor) -> Backbone:
    """The backbone for images (B, C, len(rows), len(columns)), its parameters shared with the whole one.

    Args:
        rows: Numbers of neighbouring rows, ascending.
        columns: Numbers of neighbouring columns; they may pass the end of the ring.

    Raises:
        InputError: a backbone that cannot be cut, or a part that is not made up of whole units (`unit_of`).
    """
    units = unit_of(backbone)
    for what, numbers, unit in zip(("rows", "columns"), (rows, columns), units, strict=True):
        if len(numbers) == 0:
            raise InputError(f"a part of the image needs {what}, at least a unit of {unit}; found none.")
        if len(numbers) % unit or int(numbers[0]) % unit:
            raise InputError(f"{what} from {int(numbers[0])}, {len(numbers)} of them, are not whole units of {unit}.")
    assert isinstance(backbone, Backbone)
    part = copy.deepcopy(backbone, {id(parameter): parameter for parameter in backbone.parameters()})
    rows, columns = rows.to(part.coords.device), columns.to(part.coords.device)
    cut = len(columns) < part.coords.shape[-1]
    part.coords = part.coords.index_select(-2, rows).index_select(-1, columns)
    for module in part.modules():
        if isinstance(module, LearnablePosition):
            assert isinstance(part, HDiT)
            tokens = rows[:: part.patch[0]] // part.patch[0], columns[:: part.patch[1]] // part.patch[1]
            kept = module.embedding.detach().index_select(1, tokens[0]).index_select(2, tokens[1])
            module.embedding = nn.Parameter(kept, requires_grad=False)
        elif cut:
            _open(module)
    part.follow_rays()
    return part


def _open(module: nn.Module) -> None:
    """Take the ring out of a layer that has one."""
    if isinstance(module, Attention) and module.local is not None:
        window, _, backend = module.local
        module.local = window, False, backend
    elif isinstance(module, RingConv2d):
        module.ring, module.padding = False, (1, 1)
    elif isinstance(module, Resample):
        module.ring = False
