"""Metrics on a network's features of scans."""

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.metrics.base import Protocol, ScanMetric
from r2flow.metrics.extractors import EXTRACTORS
from r2flow.metrics.extractors.base import Extractor
from r2flow.metrics.extractors.weights import weights_hash
from r2flow.metrics.scans import Scans


class FeatureMetric(ScanMetric):
    """A metric whose rows are a network's features; a name in `EXTRACTORS` loads the network with its weights."""

    representation = "features of a network"
    kind: ClassVar[str]
    names: ClassVar[Mapping[str, str]] = {}

    def __init__(self, extractor: Extractor | str, keep: bool = False, **options: Any) -> None:
        network = EXTRACTORS[extractor].trained() if isinstance(extractor, str) else extractor.eval()
        if isinstance(extractor, str) and network.weights == "random":  # a plug-in's own `trained`
            network.weights = weights_hash(network)
        name = f"{self.kind}_{network.name}"
        name = f"{name}_random" if network.weights == "random" else self.names.get(network.name, name)
        super().__init__(keep, name=name, **options)
        self.extractor = network
        self.needs_reflectance = network.needs_reflectance

    @property
    def protocol(self) -> Protocol:
        network = self.extractor
        layer = f"{network.layer}, {network.dim}"
        return Protocol(self.name, self.representation, self.mask, network.name, network.weights, layer, self.settings)

    def rows(self, scans: Scans) -> Tensor:
        """Features of a batch, (B, D), computed once per network for all metrics."""
        # Networks with equal names and weights are the same; random networks are identified by object.
        network = self.extractor
        key = network if network.weights == "random" else (network.name, network.weights)
        if key not in scans.features:
            with torch.no_grad():
                scans.features[key] = network.features(scans)
        return scans.features[key]
