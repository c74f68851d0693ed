"""Feature networks of the metrics, by name. Importing this loads none of them, nor torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from r2flow.registry import Registry

if TYPE_CHECKING:
    from r2flow.metrics.extractors.base import Extractor


class Extractors(Registry["str | type[Extractor]"]):
    """Networks by name: classes, or `module:Class` of this package, imported when it is needed."""

    def add(self, name: str, entry: str | type[Extractor]) -> None:
        """Enter a network of your own, and with it the metrics of its features.

        Raises:
            ValueError: the name is taken.
        """
        from r2flow.metrics import add_network

        super().add(name, entry)
        add_network(name)


EXTRACTORS = Extractors(
    "extractor",
    handcrafted="handcrafted:Handcrafted",
    handcrafted_range="handcrafted:HandcraftedRange",
    rangenet53="rangenet:RangeNet53",
    rangenet21="rangenet:RangeNet21",
    pointnet="pointnet:PointNet",
    minkowskinet="minkowski:MinkowskiNet",
    spvcnn="spvcnn:SPVCNN",
)


def extractor_class(name: str) -> type[Extractor]:
    """The class behind a name of `EXTRACTORS`."""
    entry = EXTRACTORS[name]
    if not isinstance(entry, str):
        return entry
    module, cls = entry.split(":")
    return getattr(importlib.import_module(f"{__name__}.{module}"), cls)


def load_extractor(name: str) -> Extractor:
    """A network with its trained weights, in evaluation mode on the CPU.

    Raises:
        InputError: no such name, or weights that are not on this machine; `r2flow weights` says how to get them.
    """
    return extractor_class(name).trained()
