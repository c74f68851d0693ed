"""Base class of feature networks."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.metrics.scans import Scans


class Extractor(nn.Module, ABC):
    """A network that computes features of scans, for inference only.

    A subclass defines `features`, and `trained` unless its weights come from `r2flow weights --add`.

    Attributes:
        name: Name in `r2flow.metrics.extractors.EXTRACTORS`.
        layer: Description of the features.
        dim: Number of features, D.
        needs_reflectance: Whether reflectance is an input.
        weights: First 12 digits of the SHA-256 of its weights, set where they are loaded; "random" before.
    """

    name: ClassVar[str]
    layer: ClassVar[str]
    dim: int
    needs_reflectance: ClassVar[bool] = False
    weights: str = "random"

    @abstractmethod
    def features(self, scans: Scans) -> Tensor:
        """Features (B, D), float32; NaN for a scan without returns."""

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor], config: Mapping[str, Any]) -> Self:
        """Build the network from published tensors by name, with sizes from them; `config` may be empty."""
        return cls().filled(tensors)

    @classmethod
    def trained(cls) -> Self:
        """Load the network with the installed weights."""
        from r2flow.metrics.extractors.weights import read_kept

        return read_kept(cls)

    def filled(self, tensors: Mapping[str, Tensor]) -> Self:
        """Load exactly these parameters and switch to evaluation mode."""
        # num_batches_tracked is not used in inference; older files lack it.
        counts = {name: value for name, value in self.state_dict().items() if name.endswith("num_batches_tracked")}
        try:
            self.load_state_dict({**counts, **tensors})
        except RuntimeError as error:
            reason = str(error).splitlines()[1].strip()
            raise InputError(f"not the weights of {self.name}: {reason[:160]}") from None
        if broken := [name for name, value in self.state_dict().items() if not value.isfinite().all()]:
            raise InputError(f"not the weights of {self.name}: '{broken[0]}' has values that are not finite.")
        return self.requires_grad_(False).eval()

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device


def nan_where_empty(features: Tensor, scans: Scans) -> Tensor:
    """Features (B, D) with NaN for scans without returns."""
    returned = scans.returned.flatten(1).any(1).to(features.device)
    return torch.where(returned[:, None], features, torch.nan)
