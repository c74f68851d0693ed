"""What every feature network of the metrics has in common."""

from typing import ClassVar

from torch import Tensor, nn

from r2flow.metrics.scans import Scans


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
    dim: ClassVar[int]
    needs_reflectance: ClassVar[bool] = False
    weights: str = "random"

    def features(self, scans: Scans) -> Tensor:
        """(B, D), float32; a row of NaN for a scan without a single return."""
        raise NotImplementedError
