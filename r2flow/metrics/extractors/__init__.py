"""Registry of feature networks. Importing this module does not import networks or torch."""

from __future__ import annotations

from typing import TYPE_CHECKING

from r2flow.base.registry import Registry, lazy

if TYPE_CHECKING:
    from r2flow.metrics.extractors.base import Extractor


class _Extractors(Registry["type[Extractor]"]):
    """Registry of networks that also registers their metrics."""

    def add(self, name: str, entry: type[Extractor]) -> None:
        from r2flow.metrics import add_network

        super().add(name, entry)
        add_network(name)


EXTRACTORS = _Extractors(
    "extractor",
    handcrafted=lazy("r2flow.metrics.extractors.handcrafted:Handcrafted"),
    handcrafted_range=lazy("r2flow.metrics.extractors.handcrafted:HandcraftedRange"),
    rangenet53=lazy("r2flow.metrics.extractors.rangenet:RangeNet53"),
    rangenet21=lazy("r2flow.metrics.extractors.rangenet:RangeNet21"),
    pointnet=lazy("r2flow.metrics.extractors.pointnet:PointNet"),
    minkowskinet=lazy("r2flow.metrics.extractors.voxels:MinkowskiNet"),
    spvcnn=lazy("r2flow.metrics.extractors.voxels:SPVCNN"),
)
