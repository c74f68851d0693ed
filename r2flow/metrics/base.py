"""What a metric between two sets of scans is, and the protocol under which its figures hold."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import torch
import torch.distributed as dist
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.distributed import gather_all_tensors

from r2flow.errors import InputError
from r2flow.lidar.sensors import Sensor
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

    Both sets are given by `update(scans, real=...)`, as to torchmetrics' FrechetInceptionDistance. It is a torchmetrics
    Metric in all else too: `forward`, `merge_state`, `reset`, `state_dict` (after `persistent(True)`), device moves,
    collections, and a compute that all processes share. States are float64, whatever dtype is set: the order of the
    scans and the number of processes change no figure within ten digits.

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
        folder: Where they are kept; in temporary files, one each process, if left out. Processes that share a folder
            need not send each other their rows when they compute, but must number their scans (`update(first=...)`).
        sensor: Of the images that `update` is given as tensors.
        name: Where one class has several names.
        options: Those of torchmetrics' Metric: process_group, sync_on_compute, ...
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

    def __init__(
        self,
        keep: bool = False,
        folder: str | Path | None = None,
        *,
        sensor: Sensor | None = None,
        name: str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.name = name or type(self).name
        self.sensor = sensor
        self.keeps = self.keeping == "always" or (keep and self.keeping == "on request")
        self.folder = None if folder is None else Path(folder)
        for side in SIDES:
            self.add_state(f"{side}_scans", torch.tensor(0), dist_reduce_fx="sum")
            self.add_state(f"{side}_left_out", torch.tensor(0), dist_reduce_fx="sum")
        # A MetricCollection updates only one of several metrics whose states have equal names and values.
        self.add_state(f"name_{self.name}", torch.tensor(0), dist_reduce_fx="sum")
        self._stores: dict[Side, FeatureStore] = {}
        self._gathered: dict[Side, FeatureStore] = {}  # the rows of all processes, while synced
        self._next: dict[Side, int] = dict.fromkeys(SIDES, 0)  # number of the next scan that nobody numbers
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

    def update(self, scans: Scans | Tensor, real: bool, first: int | None = None) -> None:
        """Take in a batch of real or generated scans.

        Args:
            scans: `Scans`, or images (B, 2 or 1, H, W) of the metric's `sensor`: range in metres, reflectance of
                [0, 1], 0 where a ray has no return. Metrics of one network run it once for one `Scans` object.
            first: Number of the first scan, by which its row is kept: a row given again replaces the old one. Numbered
                on from the last one if left out.

        Raises:
            InputError: something else, scans without the reflectance that is needed, or values that no scan has.
        """
        side: Side = "real" if real else "generated"
        if isinstance(scans, Tensor) and self.sensor is not None:
            start = self._next[side] if first is None else first
            scans = Scans(scans.to(self.device), self.sensor, names=range(start, start + len(scans)))
        if not isinstance(scans, Scans):
            found = "images without a sensor" if isinstance(scans, Tensor) else type(scans).__name__
            raise InputError(
                f"'{self.name}' takes metrics.scans.Scans(images, sensor), or images once it has their sensor: "
                f"METRICS['{self.name}'](sensor=SENSORS['hdl64e']); found {found}."
            )
        if self.needs_reflectance and not scans.has_reflectance:
            raise InputError(f"'{self.name}' needs reflectance, which these scans have not; leave it out.")
        if first is None:
            if self.keeps and self.folder is not None and dist.is_available() and dist.is_initialized():
                raise InputError(f"'{self.name}': processes that share a folder number their scans: update(first=...).")
            first = self._next[side]
        before = self.given(side)
        self.take_in(scans, side, first)
        self._next[side] = max(self._next[side], first + self.given(side) - before)

    def take_in(self, scans: Scans, side: Side, first: int) -> None:
        """Add a batch to the statistics of a side."""
        rows = self.rows(scans)
        whole = rows.isfinite().all(1)
        self.add_scans(side, len(rows), int((~whole).sum()))
        self.accumulate(rows[whole], side)
        if self.keeps:
            self.store(side).write(first, rows)

    def forward(self, scans: Scans | Tensor, real: bool, first: int | None = None) -> dict[str, float]:
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
        """The kept rows of a side; while synced, those of all processes."""
        if side in self._gathered:
            return self._gathered[side]
        if side not in self._stores:
            self._stores[side] = FeatureStore(f"{self.name}-{side}", self.folder)
        return self._stores[side]

    def _append(self, side: Side, rows: Tensor) -> None:
        """Keep further rows, (N, D), behind those that are there."""
        self.store(side).write(self._next[side], rows)
        self._next[side] += len(rows)

    def _loaded(self) -> None:
        """Statistics came in by another way than `update`."""
        self._update_count, self._computed = max(self._update_count, 1), None

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
        self._loaded()
        if dist.is_available() and dist.is_initialized() and dist.get_rank() > 0:
            return
        for name, value in own.items():
            value.copy_(state[name])
        if self.keeps:
            self.store("real").write(0, state["real_rows"])
        self._next["real"] = max(self._next["real"], int(state["real_scans"]))

    def reset(self) -> None:
        """Forget both sets."""
        super().reset()
        self._clear()

    def _clear(self) -> None:
        self._gathered.clear()
        if self.keeps:
            for side in SIDES:  # both, in every process: their files are numbered by how often they were cleared
                self.store(side).clear()
        self._next = dict.fromkeys(SIDES, 0)
        self._remarks = []

    # What torchmetrics does with states has to be done with kept rows as well.

    def merge_state(self, incoming_state: "dict[str, Any] | Metric") -> None:
        """Add the statistics and kept rows of another metric of this class, or of its `state_dict`.

        Raises:
            InputError: rows are kept here and not there.
        """
        rows: dict[Side, Tensor] = {}
        shares = isinstance(incoming_state, ScanMetric) and None is not self.folder == incoming_state.folder
        if self.keeps and not shares:
            for side in SIDES:
                if isinstance(incoming_state, ScanMetric) and incoming_state.keeps:
                    rows[side] = incoming_state.store(side).tensor()
                elif isinstance(incoming_state, dict) and f"{side}_rows" in incoming_state:
                    rows[side] = incoming_state[f"{side}_rows"]
                else:
                    raise InputError(f"{self.name} keeps a row of each scan, and what is merged into it has none.")
        super().merge_state(incoming_state)
        for side, more in rows.items():
            self._append(side, more)
        self._loaded()

    def state_dict(  # type: ignore[override]  # as torchmetrics' own
        self, destination: dict[str, Any] | None = None, prefix: str = "", keep_vars: bool = False
    ) -> dict[str, Any]:
        """As torchmetrics'; the kept rows are with the states, where `persistent(True)` was asked for."""
        found = super().state_dict(destination=destination, prefix=prefix, keep_vars=keep_vars)
        if self.keeps and any(self._persistent.values()):
            found |= {f"{prefix}{side}_rows": self.store(side).tensor().clone() for side in SIDES}
        return found

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *others: Any) -> None:
        rows = {side: state_dict.pop(f"{prefix}{side}_rows", None) for side in SIDES}
        has_states = any(prefix + name in state_dict for name in self._defaults)
        super()._load_from_state_dict(state_dict, prefix, *others)
        if not has_states:
            return
        for name in self._defaults:  # what is loaded is added to in place, and is the caller's
            setattr(self, name, getattr(self, name).detach().clone().to(self.device))
        self._clear()
        for side, kept in rows.items():
            if self.keeps and kept is None:
                others[-1].append(f"{self.name} keeps a row of each scan, and there is no '{prefix}{side}_rows'.")
            elif self.keeps:
                self._append(side, kept)
            self._next[side] = self.given(side)
        self._loaded()

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:
        super()._sync_dist(dist_sync_fn, process_group)
        if not self.keeps or self.folder is not None:
            return
        for side in SIDES:
            rows = self.store(side).tensor().to(self.device)
            gathered = FeatureStore(f"{self.name}-{side}-gathered")
            first = 0
            for part in dist_sync_fn(rows, group=process_group or self.process_group):
                if len(part):
                    gathered.write(first, part)
                first += len(part)
            self._gathered[side] = gathered

    def unsync(self, should_unsync: bool = True) -> None:
        """As torchmetrics'."""
        super().unsync(should_unsync)
        if should_unsync:
            self._gathered.clear()

    def set_dtype(self, dst_type: str | torch.dtype) -> Self:
        """Nothing: states stay float64, since sums in less would lose the digits of the figures."""
        return self

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
