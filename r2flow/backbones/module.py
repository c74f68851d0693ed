"""A module of one's own in the place of a backbone by name."""

from typing import Any

from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.base.errors import InputError

MODULE = "own"  # its name in a config, where `network` is its class


class ModuleBackbone(Backbone):
    """v(t, x) by any module that takes t, (B,), and x, (B, C, H, W)."""

    def __init__(self, rays: Tensor, network: nn.Module, **common: Any) -> None:
        super().__init__(rays, **common)
        self.network = network

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        return self.network(t.expand(len(x)), x)


def module_backbone(rays: Tensor, network: nn.Module | str, **common: Any) -> Backbone:
    """A module as a backbone; itself if it is one.

    Raises:
        InputError: only its class is known, as to a checkpoint.
    """
    if isinstance(network, str):
        raise InputError(
            f"its network is a {network}, a module of its user: give backbone={network}(...) to "
            "load_from_checkpoint, r2flow.load or a stage with this parent."
        )
    return network if isinstance(network, Backbone) else ModuleBackbone(rays, network, **common)
