"""Feature networks of the metrics, by name. Importing this loads none of them, nor torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from r2flow.registry import Registry

if TYPE_CHECKING:
    from r2flow.metrics.extractors.base import Extractor

# Module of this package and class of it.
EXTRACTORS: Registry[str] = Registry(
    "extractor",
    embedded="embedded:Embedded",
    embedded_range="embedded:EmbeddedRange",
    rangenet53="rangenet:RangeNet53",
    rangenet21="rangenet:RangeNet21",
    pointnet="pointnet:PointNet",
    minkowskinet="minkowski:MinkowskiNet",
    spvcnn="spvcnn:SPVCNN",
)


def extractor_class(name: str) -> type[Extractor]:
    """The class behind a name of `EXTRACTORS`, with what it needs imported now.

    Raises:
        InputError: no such name.
    """
    module, cls = EXTRACTORS[name].split(":")
    return getattr(importlib.import_module(f"{__name__}.{module}"), cls)


def load_extractor(name: str) -> Extractor:
    """A network with its trained weights, in evaluation mode on the CPU.

    Raises:
        InputError: no such name, or weights that are not on this machine; `r2flow weights` says how they come here.
    """
    return extractor_class(name).trained()


def random_extractor(name: str, seed: int = 0) -> Extractor:
    """The same network with random weights of a seed, for tests and dry runs: its `weights` say "random".

    Raises:
        InputError: no such name.
    """
    return extractor_class(name).random(seed)
