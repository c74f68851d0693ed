"""Networks v(t, x) and u(x, t, s) by name, and their configurations in conf/backbone."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from torch import Tensor, nn

from r2flow.backbones.adm_unet import ADMUNet
from r2flow.backbones.base import Backbone
from r2flow.backbones.efficient_unet import EfficientUNet
from r2flow.backbones.hdit import HDiT
from r2flow.backbones.local import Local
from r2flow.backbones.module import MODULE, backbone_class, module_backbone
from r2flow.backbones.vit import ViT
from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options, Registry, presets
from r2flow.lidar.sensors import SENSORS


class _Backbones(Registry[Callable[..., Backbone]]):
    """Classes of backbones, and by the names of conf/backbone the same with options."""

    def __iter__(self) -> Iterator[str]:
        return iter(sorted({*self._entries, *presets(self.kind)}))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return name in presets(self.kind) or super().__contains__(name)

    def __getitem__(self, name: str) -> Callable[..., Backbone]:
        if name == MODULE:
            return module_backbone
        if name in self._entries or name not in self:
            return super().__getitem__(name)
        options = self.options(name)
        return partial(self[options.pop("name")], **options)

    def add(self, name: str, entry: Any) -> None:
        """As `Registry.add`; of any class of modules that is called as `module(t, x)`."""
        if isinstance(entry, type) and not issubclass(entry, Backbone):
            entry = backbone_class(entry)
        super().add(name, entry)

    def options(self, given: str | Options | nn.Module) -> Config:
        """As `Registry.options`; also of a module of one's own.

        Where only the class of that is known, as to a checkpoint, an entry of this class is taken.
        """
        if isinstance(given, nn.Module):
            return {"name": MODULE, "network": given}
        options = super().options(given)
        for name, entry in self._entries.items():
            if options.get("network") == getattr(entry, "__name__", ""):
                return {"name": name}
        return options

    def build(  # type: ignore[override]
        self,
        options: str | Options | nn.Module | None,
        rays: Tensor | None = None,
        *,
        shape: tuple[int, int, int] | None = None,
        **common: Any,
    ) -> Backbone:
        """Build a backbone by name or options, as in conf/backbone, or of a module of one's own,
        for images of some rays.

        Args:
            rays: Elevation and azimuth in radians, (2, H, W).
            shape: Instead of rays: (C, H, W) of images of an HDL-64E.
            common: Further options of `Backbone`, such as in_channels.
        """
        if options is None:
            raise InputError(
                "stage.parent names a run without a backbone: leave it out, or name a flow."
            )
        if shape is not None:
            rays = SENSORS["hdl64e"].resized(*shape[1:]).rays()
            common["in_channels"] = shape[0]
        return super().build({**self.options(options), **common}, rays)


BACKBONES = _Backbones(
    "backbone", hdit=HDiT, adm_unet=ADMUNet, efficient_unet=EfficientUNet, vit=ViT, local=Local
)
