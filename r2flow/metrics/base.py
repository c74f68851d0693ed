"""What a metric between two sets of scans is, and what is said of its figures."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

from torchmetrics import Metric

from r2flow.metrics.scans import MASK, Scans


@dataclass(frozen=True)
class Protocol:
    """All that a figure depends on beside the scans: two protocols that differ never share a name.

    Attributes:
        metric: Name in `r2flow.metrics.METRICS`.
        representation: What of a scan is compared: "range image", "points", "bird's-eye histogram", "voxels 0.05 m".
        mask: Metres between which returns are kept.
        extractor: Name of the network, or None without one.
        weights: First 12 digits of the SHA-256 of its weights, or None.
        layer: Which features of it, with their number.
        settings: Whatever else: bins, bandwidth, neighbours.
    """

    metric: str
    representation: str
    mask: tuple[float, float] = MASK
    extractor: str | None = None
    weights: str | None = None
    layer: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)

    def asdict(self) -> dict[str, Any]:
        return asdict(self)


class ScanMetric(Metric):
    """A distance between real and generated scans, or several figures that fall out together.

    As torchmetrics' own FrechetInceptionDistance, it is given both sets by `update(scans, real=...)`; unlike it,
    states are float64, so that neither order nor number of processes is seen in ten digits.
    """

    is_differentiable = False
    full_state_update = False
    needs_reflectance: ClassVar[bool] = False

    @property
    def protocol(self) -> Protocol:
        raise NotImplementedError

    def update(self, scans: Scans, real: bool, first: int = 0) -> None:
        """Take in a batch.

        Args:
            scans: The batch.
            real: Whose: the real set's or the generated one's.
            first: Number of its first scan in its set, which decides where features kept one by one are kept.
        """
        raise NotImplementedError

    def compute(self) -> dict[str, float]:
        """Figures by name. A figure that does not exist is NaN, and `remarks` says why."""
        raise NotImplementedError

    def remarks(self) -> list[str]:
        """What a reader of the figures must know: empty scans, fewer scans than dimensions, one scan alone."""
        return []
