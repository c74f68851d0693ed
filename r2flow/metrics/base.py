"""What a metric between two sets of scans is, and the protocol under which its figures hold."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
import torch.distributed as dist
from torch import Tensor
from torchmetrics import Metric

from r2flow.errors import InputError
from r2flow.metrics.scans import MASK, Scans
from r2flow.metrics.store import FeatureStore

Side = Literal["real", "generated"]
SIDES: tuple[Side, Side] = ("real", "generated")
Better = Literal["smaller", "larger"]


@dataclass(frozen=True)
class Protocol:
    """What a figure depends on beside the scans: two protocols that differ never share a name.

    Attributes:
        metric: Name in `r2flow.metrics.METRICS`.
        representation: What of a scan is compared: "range image", "points", "bird's-eye histogram".
        mask: Metres between which returns are kept.
        extractor, weights, layer: Name of the network, first 12 digits of the SHA-256 of its weights, and which
            features are taken; None without a network.
        settings: Everything else: bins, bandwidth, neighbours.
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
    """A distance between real and generated scans, or several figures that are computed together.

    Both sets are given by `update(scans, real=...)`, as to torchmetrics' FrechetInceptionDistance. States are float64:
    the order of the scans and the number of processes change no figure within ten digits.

    A subclass takes a row of numbers from each scan (`rows`), adds the rows up (`accumulate`) or has them kept in a
    file (`keeping`), and computes `figures`. A row of NaN stands for a scan that has nothing to compare: it is left
    out, counted and remarked on.

    Attributes:
        name, representation, mask, settings: As in `Protocol`.
        needs_reflectance, uses_reflectance: Whether scans without reflectance are refused; whether it is read where
            there is some.
        keeping: Whether the rows are kept: "on request" (`keep=True`), "always" or "never".
        resamples: Whether it has bootstrap intervals, which are made of kept rows.
        fewest: Scans of each set that an interval takes.
        counts_empty: Whether a scan without a return is compared as well.
        of_equal_sets: The value of its figures for two equal sets; None where it depends on the sets.
        better: Which way its figures are better; a distance's smaller ones are.

    Args:
        keep: Whether the rows are kept, for bootstrap intervals.
        folder: Where they are kept. Several processes must be given the same folder; a temporary one if left out.
        name: Where one class has several names.
    """

    is_differentiable = False
    full_state_update = False

    name: str
    representation: ClassVar[str]
    mask: ClassVar[tuple[float, float]] = MASK
    settings: ClassVar[Mapping[str, Any]] = {}
    needs_reflectance: bool = False
    uses_reflectance: ClassVar[bool] = False
    keeping: ClassVar[Literal["on request", "always", "never"]] = "on request"
    resamples: ClassVar[bool] = True
    fewest: ClassVar[int] = 2
    counts_empty: ClassVar[bool] = False
    of_equal_sets: ClassVar[float | None] = 0.0
    better: ClassVar[Better] = "smaller"

    def __init__(self, keep: bool = False, folder: str | Path | None = None, *, name: str | None = None) -> None:
        super().__init__()
        self.name = name or type(self).name
        self.keeps = self.keeping == "always" or (keep and self.keeping == "on request")
        self.folder = None if folder is None else Path(folder)
        for side in SIDES:
            self.add_state(f"{side}_scans", torch.tensor(0), dist_reduce_fx="sum")
            self.add_state(f"{side}_left_out", torch.tensor(0), dist_reduce_fx="sum")
        # A MetricCollection updates only one of several metrics whose states have equal names and values.
        self.add_state(f"name_{self.name}", torch.tensor(0), dist_reduce_fx="sum")
        self._stores: dict[Side, FeatureStore] = {}
        self._remarks: list[str] = []

    @property
    def protocol(self) -> Protocol:
        return Protocol(self.name, self.representation, self.mask, settings=self.settings)

    def rows(self, scans: Scans) -> Tensor:
        """What is taken from each scan, (B, D); a row of NaN for a scan that has nothing to compare."""
        raise NotImplementedError

    def accumulate(self, rows: Tensor, side: Side) -> None:
        """Add rows, all finite, to the statistics of a side."""

    def figures(self) -> tuple[dict[str, float], list[str]]:
        """Figures by name, computed from the states, and the remarks on them."""
        raise NotImplementedError

    def update(self, scans: Scans, real: bool, first: int = 0) -> None:
        """Take in a batch of real or generated scans, the rows of which are kept from number `first` on.

        Raises:
            InputError: something else than `Scans`, or scans without the reflectance that is needed.
        """
        if not isinstance(scans, Scans):
            raise InputError(f"'{self.name}' takes metrics.scans.Scans(images, sensor), found {type(scans).__name__}.")
        if self.needs_reflectance and not scans.has_reflectance:
            raise InputError(f"'{self.name}' needs reflectance, which these scans have not; leave it out.")
        self.take_in(scans, "real" if real else "generated", first)

    def take_in(self, scans: Scans, side: Side, first: int) -> None:
        """Add a batch to the statistics of a side."""
        rows = self.rows(scans)
        whole = rows.isfinite().all(1)
        self.add_scans(side, len(rows), int((~whole).sum()))
        self.accumulate(rows[whole], side)
        if self.keeps:
            self.store(side).write(first, rows)

    def forward(self, scans: Scans, real: bool, first: int = 0) -> dict[str, float]:
        """Take in a batch; a batch has no distance of its own, so there are no figures."""
        self.update(scans, real, first)
        return {}

    def compute(self) -> dict[str, float]:
        """Figures by name. A figure that does not exist is NaN, and `remarks` says why.

        Raises:
            InputError: more or fewer rows are kept than scans were given.
        """
        for side in SIDES:
            if self.keeps and len(self.store(side)) != self.count(side):
                raise InputError(
                    f"{self.name}: {self.count(side)} {side} scans were given but {len(self.store(side))} are kept; "
                    "give every batch its own numbers (first), and all processes one folder, an empty one."
                )
        values, remarks = self.figures()
        self._remarks = self._left_out() + remarks
        return values

    def remarks(self) -> list[str]:
        """What a reader of the figures must know: empty scans, fewer scans than features, a single scan."""
        self.compute()
        return list(self._remarks)

    def add_scans(self, side: Side, scans: int, left_out: int) -> None:
        """Count scans of a side, and those among them that have nothing to compare."""
        getattr(self, f"{side}_scans").add_(scans)
        getattr(self, f"{side}_left_out").add_(left_out)

    def given(self, side: Side) -> int:
        """Scans of a side."""
        return int(getattr(self, f"{side}_scans"))

    def count(self, side: Side) -> int:
        """Scans of a side that have something to compare."""
        return self.given(side) - int(getattr(self, f"{side}_left_out"))

    def store(self, side: Side) -> FeatureStore:
        """The kept rows of a side."""
        if side not in self._stores:
            self._stores[side] = FeatureStore(f"{self.name}-{side}", self.folder)
        return self._stores[side]

    def real_state(self) -> dict[str, Tensor]:
        """All statistics of the real set, on the CPU and gathered from all processes: for a cache on disk."""
        with self.sync_context():
            names = [name for name in self._defaults if name.startswith("real_")]
            state = {name: getattr(self, name).detach().cpu().clone() for name in names}
            if self.keeps:
                state["real_rows"] = self.store("real").tensor()
        return state

    def load_real_state(self, state: Mapping[str, Tensor]) -> None:
        """Take the real set's statistics from `real_state`, after `reset`; of several processes the first holds them.

        Raises:
            InputError: a state of another metric, or without the rows that this one keeps.
        """
        own = {name: getattr(self, name) for name in self._defaults if name.startswith("real_")}
        fits = all(name in state and state[name].shape == value.shape for name, value in own.items())
        if not fits or (self.keeps and "real_rows" not in state):
            found = {name: tuple(value.shape) for name, value in state.items()}
            raise InputError(
                f"the real set's kept statistics do not fit {self.name}, found {found}; measure the real set again."
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
        self._remarks = []

    def resampled(self, weights: Mapping[Side, Tensor]) -> dict[str, Tensor]:
        """Figures of resampled sets, (R) for each name that has intervals; `weights` is how much each kept scan counts,
        (R, N)."""
        raise NotImplementedError

    def _left_out(self) -> list[str]:
        remarks = []
        for side in SIDES:
            scans, compared = self.given(side), self.count(side)
            if scans == 0:
                remarks.append(f"there are no {side} scans.")
            elif compared == 0:
                remarks.append(f"none of the {scans} {side} scans has anything to compare; are all of them empty?")
            elif compared < scans:
                left = f"{scans - compared} of {scans} {side} scans"
                remarks.append(f"{left} are left out: empty, or nothing to compare.")
        return remarks
