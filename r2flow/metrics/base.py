"""What a metric between two sets of scans is, and what is said of its figures."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
import torch.distributed as dist
from torch import Tensor
from torchmetrics import Metric

from r2flow.errors import InputError
from r2flow.metrics.features import FeatureStore
from r2flow.metrics.scans import MASK, Scans

Side = Literal["real", "generated"]
SIDES: tuple[Side, Side] = ("real", "generated")


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

    A subclass says what it takes from each scan (`rows`) and either adds that up (`accumulate`) or has it kept one by
    one (`keep=True`), and makes `figures` of it. Scans that have nothing to give, a row of NaN, are left out, counted
    and remarked on.

    Args:
        keep: Whether the rows are kept, in files: for metrics that need every scan, and for bootstrap intervals.
        folder: Where. Several processes must be given the same one; a temporary folder if left out.
    """

    is_differentiable = False
    full_state_update = False
    needs_reflectance: bool = False
    resamples: ClassVar[bool] = True  # whether intervals can be had of it

    real_scans: Tensor
    real_left_out: Tensor
    generated_scans: Tensor
    generated_left_out: Tensor

    def __init__(self, keep: bool = False, folder: str | Path | None = None) -> None:
        super().__init__()
        for side in SIDES:
            self.add_state(f"{side}_scans", torch.tensor(0), dist_reduce_fx="sum")
            self.add_state(f"{side}_left_out", torch.tensor(0), dist_reduce_fx="sum")
        self.keeps = keep
        self.folder = None if folder is None else Path(folder)
        self._stores: dict[Side, FeatureStore] = {}
        self._said: list[str] = []

    @property
    def protocol(self) -> Protocol:
        raise NotImplementedError

    def rows(self, scans: Scans) -> Tensor:
        """What is taken from each scan, (B, D); a row of NaN from one that has nothing to give."""
        raise NotImplementedError

    def accumulate(self, rows: Tensor, side: Side) -> None:
        """Add rows, all finite, to the statistics of a side."""

    def figures(self) -> tuple[dict[str, float], list[str]]:
        """Figures by name from the states, and what must be remarked on them."""
        raise NotImplementedError

    def update(self, scans: Scans, real: bool, first: int = 0) -> None:
        """Take in a batch.

        Args:
            scans: The batch.
            real: Whose: the real set's or the generated one's.
            first: Number of its first scan in its set, which decides where features kept one by one are kept.
        """
        side: Side = "real" if real else "generated"
        rows = self.rows(scans)
        whole = rows.isfinite().all(1)
        self.add_scans(side, len(rows), int((~whole).sum()))
        self.accumulate(rows[whole], side)
        if self.keeps:
            self.store(side).write(first, rows)

    def forward(self, scans: Scans, real: bool, first: int = 0) -> dict[str, float]:
        """Take in a batch, which has no distance of its own: no figures."""
        self.update(scans, real, first)
        return {}

    def compute(self) -> dict[str, float]:
        """Figures by name. A figure that does not exist is NaN, and `remarks` says why.

        Raises:
            InputError: rows kept by number are fewer or more than the scans counted.
        """
        for side in SIDES:
            if self.keeps and len(self.store(side)) != self.count(side):
                raise InputError(
                    f"{self.protocol.metric}: {self.count(side)} {side} scans were given but {len(self.store(side))} "
                    "are kept; give every batch its own numbers (first), and all processes one folder, a fresh one."
                )
        values, remarks = self.figures()
        self._said = self._left_out() + remarks
        return values

    def remarks(self) -> list[str]:
        """What a reader of the figures must know: empty scans, fewer scans than dimensions, one scan alone."""
        self.compute()
        return list(self._said)

    def add_scans(self, side: Side, scans: int, left_out: int) -> None:
        """Count scans of a side, and those among them that had nothing to give."""
        getattr(self, f"{side}_scans").add_(scans)
        getattr(self, f"{side}_left_out").add_(left_out)

    def count(self, side: Side) -> int:
        """Scans that have something to give."""
        return int(getattr(self, f"{side}_scans")) - int(getattr(self, f"{side}_left_out"))

    def store(self, side: Side) -> FeatureStore:
        """Where the rows of a side are kept."""
        if side not in self._stores:
            self._stores[side] = FeatureStore(f"{self.protocol.metric}-{side}", self.folder)
        return self._stores[side]

    def real_state(self) -> dict[str, Tensor]:
        """All that is known of the real set, on the CPU and gathered from all processes: for a cache on disk."""
        with self.sync_context():
            names = [name for name in self._defaults if name.startswith("real_")]
            state = {name: getattr(self, name).detach().cpu().clone() for name in names}
            if self.keeps:
                state["real_rows"] = self.store("real").tensor()
        return state

    def load_real_state(self, state: Mapping[str, Tensor]) -> None:
        """Take the real set from `real_state` after `reset`, instead of scans.

        With several processes the first one holds it, until figures are made.

        Raises:
            InputError: a state of another metric, or without the rows that this one is to keep.
        """
        own = {name: getattr(self, name) for name in self._defaults if name.startswith("real_")}
        wanted = {name: tuple(value.shape) for name, value in own.items()}
        found = {name: tuple(value.shape) for name, value in state.items()}
        fits = all(found.get(name) == shape for name, shape in wanted.items())
        if not fits or (self.keeps and "real_rows" not in found):
            rows = " and the rows of its scans" if self.keeps else ""
            raise InputError(
                f"the kept statistics of the real set do not fit {self.protocol.metric}: it takes {wanted}{rows}, "
                f"found {found}; measure the real set again."
            )
        if dist.is_available() and dist.is_initialized() and dist.get_rank() > 0:
            return
        for name, value in own.items():
            value.copy_(state[name])
        if self.keeps:
            self.store("real").write(0, state["real_rows"])

    def reset(self) -> None:
        """Forget both sets."""
        super().reset()
        if self.keeps:
            for side in SIDES:  # both, in every process: their files are numbered by how often they were cleared
                self.store(side).clear()
        self._said = []

    def resampled(self, weights: Mapping[Side, Tensor]) -> dict[str, Tensor]:
        """Figures of sets that were drawn again from the kept rows, (R) for each name.

        Args:
            weights: How often each kept scan of a side was drawn, (R, N), float64.

        Raises:
            InputError: a metric that has no interval.
        """
        raise InputError(f"{self.protocol.metric} has no bootstrap interval; leave it out of what needs one.")

    def own_group(self) -> None:
        """Keep a MetricCollection from taking two metrics for one because their counts of scans agree.

        It compares states by name and value, and what a store holds is no state.
        """
        self.add_state(f"name_{self.protocol.metric}", torch.tensor(0), dist_reduce_fx="sum")

    def _left_out(self) -> list[str]:
        said = []
        for side in SIDES:
            scans, left_out = int(getattr(self, f"{side}_scans")), int(getattr(self, f"{side}_left_out"))
            if scans == 0:
                said.append(f"there are no {side} scans.")
            elif left_out == scans:
                said.append(f"none of the {scans} {side} scans has anything to compare, as if all were empty.")
            elif left_out:
                said.append(f"{left_out} of {scans} {side} scans are left out: empty, or nothing of them counts here.")
        return said
