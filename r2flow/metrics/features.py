"""Metrics on a network's features of scans."""

from collections.abc import Mapping
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from r2flow.metrics import extractors
from r2flow.metrics.base import Protocol, ScanMetric
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.scans import Scans


class FeatureMetric(ScanMetric):
    """A metric whose rows are a network's features.

    Args:
        extractor: The network, or its name in `EXTRACTORS`: then it is loaded with its weights.
        keep, options: As `ScanMetric`.

    Raises:
        InputError: no network of that name, or no weights for it on this machine.
    """

    representation = "features of a network"
    kind: ClassVar[str]
    names: ClassVar[Mapping[str, str]] = {}

    def __init__(self, extractor: Extractor | str, keep: bool = False, **options: Any) -> None:
        network = extractor.eval() if isinstance(extractor, Extractor) else extractors.load_extractor(extractor)
        random = "_random" if network.weights == "random" else ""
        name = "" if random else self.names.get(network.name, "")
        super().__init__(keep, name=name or f"{self.kind}_{network.name}{random}", **options)
        self.extractor = network
        self.needs_reflectance = network.needs_reflectance

    @property
    def protocol(self) -> Protocol:
        network = self.extractor
        layer = f"{network.layer}, {network.dim}"
        return Protocol(self.name, self.representation, self.mask, network.name, network.weights, layer, self.settings)

    def rows(self, scans: Scans) -> Tensor:
        return extract(self.extractor, scans)


_COMPUTED: "WeakKeyDictionary[Scans, dict[Any, Tensor]]" = WeakKeyDictionary()


def extract(extractor: Extractor, scans: Scans) -> Tensor:
    """Features of a batch, (B, D), computed once for all metrics of the same network."""
    # Networks of one name and equal weights are the same; random ones are told apart by the object itself, not by its
    # id, which another one may have later.
    key = extractor if extractor.weights == "random" else (extractor.name, extractor.weights)
    computed = _COMPUTED.setdefault(scans, {})
    if key not in computed:
        with torch.no_grad():
            computed[key] = extractor.features(scans)
    return computed[key]
