"""Modules of one's own in the place of a backbone."""

from inspect import Parameter, Signature, signature
from typing import Any

from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.base.errors import InputError, check
from r2flow.base.registry import keywords_of

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
            f"its network is a {network}, a class of its user: give --plugin FILE.py, a file with "
            f"BACKBONES.add('my_net', {network}), or in Python backbone={network}(...) to "
            "load_from_checkpoint, r2flow.load or a stage with this parent."
        )
    return network if isinstance(network, Backbone) else ModuleBackbone(rays, network, **common)


def backbone_class(module: Any) -> type[Backbone]:
    """The class of backbones v(t, x) by a class of modules.

    Its options are those of the module and of `Backbone`. The module gets the rays and the options
    of `Backbone`, such as in_channels, that its constructor names.

    Raises:
        InputError: the module takes the time after the image.
    """
    order = [*signature(module.forward).bind(None, None, None).arguments]  # self, t, x
    check(
        not "".join(order[2:]).startswith("t"),
        f"{module.__name__}.forward takes {order[-1]} last, not first: see docs/extend.md.",
    )
    own = keywords_of(module)
    common = keywords_of(Backbone, given=2)
    options = [one.replace(kind=one.KEYWORD_ONLY) for one in {**own, **common}.values()]
    rays = Parameter("rays", Parameter.POSITIONAL_ONLY)

    class Own(ModuleBackbone):
        __signature__ = Signature([rays, *(one for one in options if one.name != "rays")])

        def __init__(
            self,
            rays: Tensor,
            in_channels: int = 2,
            out_channels: int | None = None,
            **options: Any,
        ) -> None:
            out_channels = out_channels or in_channels
            options |= {"rays": rays, "in_channels": in_channels, "out_channels": out_channels}
            network = module(**{name: options[name] for name in options.keys() & own})
            shared = {name: options[name] for name in options.keys() & common}
            super().__init__(rays, network, **shared)

    Own.__name__, Own.__module__ = module.__name__, module.__module__
    return Own
