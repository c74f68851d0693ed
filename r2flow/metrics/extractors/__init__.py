"""Registry of feature networks. Importing this module does not import networks or torch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from r2flow.registry import Registry, lazy

if TYPE_CHECKING:
    from r2flow.metrics.extractors.base import Extractor


class Extractors(Registry["type[Extractor]"]):
    """Registry of networks that also registers their metrics."""

    def add(self, name: str, entry: type[Extractor]) -> None:
        from r2flow.metrics import add_network

        super().add(name, entry)
        add_network(name)


EXTRACTORS = Extractors(
    "extractor",
    handcrafted=lazy(f"{__name__}.handcrafted:Handcrafted"),
    handcrafted_range=lazy(f"{__name__}.handcrafted:HandcraftedRange"),
    rangenet53=lazy(f"{__name__}.rangenet:RangeNet53"),
    rangenet21=lazy(f"{__name__}.rangenet:RangeNet21"),
    pointnet=lazy(f"{__name__}.pointnet:PointNet"),
    minkowskinet=lazy(f"{__name__}.voxels:MinkowskiNet"),
    spvcnn=lazy(f"{__name__}.voxels:SPVCNN"),
)
