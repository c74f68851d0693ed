"""What every feature network of the metrics has in common."""

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from r2flow.metrics.scans import Scans
from r2flow.noise import seed_torch


class Extractor(nn.Module):
    """Features of scans, for inference alone.

    Attributes:
        name: Name in `r2flow.metrics.extractors.EXTRACTORS`.
        layer: Which features are taken, in words.
        dim: How many, D.
        needs_reflectance: Whether the network looks at reflectance.
        weights: First 12 digits of the SHA-256 of its weights; "random" without any.
    """

    name: ClassVar[str]
    layer: ClassVar[str]
    dim: int
    needs_reflectance: ClassVar[bool] = False
    weights: str = "random"

    def features(self, scans: Scans) -> Tensor:
        """(B, D), float32; a row of NaN for a scan without a single return."""
        raise NotImplementedError

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], config: Mapping[str, Any]) -> Self:
        """The network of published weights: its sizes are read off them, its parameters are they.

        Args:
            tensors: By their published names.
            config: What the published archive says beside them; often nothing.

        Raises:
            InputError: weights of another network.
        """
        from r2flow.metrics.extractors.weights import fill

        extractor = cls()
        fill(extractor, tensors)
        return extractor

    @classmethod
    def trained(cls) -> Self:
        """The network with the weights that this machine has for it.

        Raises:
            InputError: it has none.
        """
        from r2flow.metrics.extractors.weights import read_kept

        return read_kept(cls)

    @classmethod
    def random(cls, seed: int = 0) -> Self:
        """The network with random weights that the seed alone decides."""
        with torch.random.fork_rng(devices=[]):
            seed_torch(seed, "weights")
            return cls().requires_grad_(False).eval()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def nan_where_empty(features: Tensor, scans: Scans) -> Tensor:
    """Features (B, D) with a row of NaN for each scan without a single return."""
    returned = scans.returned.flatten(1).any(1).to(features.device)
    return torch.where(returned[:, None], features, torch.nan)
