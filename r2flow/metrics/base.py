"""What a metric between two sets of scans is, and the protocol under which its figures hold."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat
from torchmetrics.utilities.distributed import gather_all_tensors

from r2flow.errors import InputError
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.scans import MASK, Scans
from r2flow.processes import place

Side = Literal["real", "generated"]
SIDES: tuple[Side, Side] = ("real", "generated")


@dataclass(frozen=True)
class Protocol:
    """What a figure depends on besides the scans: two protocols that differ never share a name.

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


def blocks(rows: Tensor, size: int) -> Iterator[tuple[slice, Tensor]]:
    """Rows (N, D), at most `size` at a time: their places, and they in float64."""
    for start in range(0, len(rows), size):
        yield slice(start, min(start + size, len(rows))), rows[start : start + size].double()


class ScanMetric(Metric):
    """A distance between real and generated scans, or several figures that are computed together.

    Both sets are given by `update(scans, real=...)`, as to torchmetrics' FrechetInceptionDistance. It is a torchmetrics
    Metric in all else too: `forward`, `merge_state`, `reset`, `state_dict` (after `persistent(True)`), device moves,
    collections, and a compute that all processes share. Sums are float64, whatever dtype is set: the order of the
    scans and the number of processes change no figure within ten digits.

    A subclass takes a row of numbers from each scan (`rows`), adds the rows up (`accumulate`) or keeps them
    (`keeping`), and computes `figures`. A row of NaN stands for a scan that has nothing to compare: it is left out and
    counted, and a remark says so.

    Attributes:
        name, representation, mask, settings: As in `Protocol`.
        needs_reflectance, uses_reflectance: Whether scans without reflectance are refused; whether it is read where
            there is some.
        keeping: Whether the rows are always kept in memory, float32.
        resamples: Whether it has bootstrap intervals, for which `keep=True` keeps the rows.
        fewest: Scans of each set that `resampled` takes.

    Args:
        keep: Whether bootstrap intervals are wanted.
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
    keeping: ClassVar[bool] = False
    resamples: ClassVar[bool] = True
    fewest: ClassVar[int] = 2

    def __init__(
        self, keep: bool = False, *, sensor: Sensor | None = None, name: str | None = None, **options: Any
    ) -> None:
        # Not cached: torchmetrics would return what was computed before `merge_state`.
        super().__init__(**{"compute_with_cache": False, **options})
        self.name = name or type(self).name
        self.sensor = sensor
        self.keeps = self.keeping or (keep and self.resamples)
        for side in SIDES:
            self.add_state(f"{side}_scans", torch.tensor(0), dist_reduce_fx="sum")
            self.add_state(f"{side}_left_out", torch.tensor(0), dist_reduce_fx="sum")
            if self.keeps:  # (N, 1 + D): the number of a scan, then its row
                self.add_state(f"{side}_rows", [], dist_reduce_fx="cat")
        # A MetricCollection updates only one of several metrics whose states have equal names and values.
        self.add_state(f"name_{self.name}", torch.tensor(0), dist_reduce_fx="sum")
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
        """Figures by name, computed from the states, and the remarks on them: as `resampled` unless overridden."""
        if any(self.count(side) < self.fewest for side in SIDES):
            return {self.name: float("nan")}, [f"{self.name} needs {self.fewest} scans of each set."]
        once: dict[Side, Tensor] = {side: torch.ones(1, self.count(side), dtype=torch.float64) for side in SIDES}
        return {name: float(value) for name, value in self.resampled(once).items()}, []

    def resampled(self, weights: Mapping[Side, Tensor]) -> dict[str, Tensor]:
        """Figures of resampled sets, (R) for each name that has intervals; `weights` is how much each kept scan counts,
        (R, N)."""
        raise NotImplementedError

    def update(self, scans: Scans | Tensor, real: bool, first: int | None = None) -> None:
        """Take in a batch of real or generated scans.

        Args:
            scans: `Scans`, or images (B, 2 or 1, H, W) of the metric's `sensor`: range in metres, reflectance of
                [0, 1], 0 where a ray has no return. Metrics of one network run it once for one `Scans` object.
            first: Number of the first scan: kept rows are sorted by it, so that intervals do not depend on the order
                of the batches. Numbered on if left out.
        """
        side: Side = "real" if real else "generated"
        first = self.given(side) if first is None else first
        if isinstance(scans, Tensor) and self.sensor is not None:
            scans = Scans(scans.to(self.device), self.sensor, names=range(first, first + len(scans)))
        if not isinstance(scans, Scans):
            raise InputError(
                f"'{self.name}' takes metrics.scans.Scans(images, sensor), or images once it has their sensor: "
                f"METRICS['{self.name}'](sensor=SENSORS['hdl64e']); found {type(scans).__name__} without a sensor."
            )
        if self.needs_reflectance and not scans.has_reflectance:
            raise InputError(f"'{self.name}' needs reflectance, which these scans do not have; leave it out.")
        if len(scans):
            self.take_in(scans, side, first)

    def take_in(self, scans: Scans, side: Side, first: int) -> None:
        """Add a batch to the statistics of a side."""
        self.add_rows(self.rows(scans), side, first)

    def add_rows(self, rows: Tensor, side: Side, first: int = 0) -> None:
        """Add the rows of scans `first`, `first + 1`, ... to the statistics of a side."""
        whole = rows.isfinite().all(1)
        self.add_scans(side, len(rows), int((~whole).sum()))
        self.accumulate(rows[whole], side)
        if self.keeps and whole.any():
            numbered = torch.cat([first + whole.nonzero(), rows[whole]], 1)
            getattr(self, f"{side}_rows").append(numbered.float().to(self.device))

    def forward(self, scans: Scans | Tensor, real: bool, first: int | None = None) -> dict[str, float]:
        """Take in a batch; a batch has no distance of its own, so there are no figures."""
        self.update(scans, real, first)
        return {}

    def compute(self) -> dict[str, float]:
        """Figures by name. A figure that does not exist is NaN, and `remarks` says why."""
        values, remarks = self.figures()
        self._remarks = self._left_out() + remarks
        return values

    def remarks(self) -> list[str]:
        """What a reader of the last computed figures must know: empty scans, fewer scans than features."""
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

    def kept(self, side: Side) -> Tensor:
        """The kept rows of a side in the order of their scans, (N, D) float32 on the CPU."""
        return self._numbered(side)[:, 1:]

    def _numbered(self, side: Side) -> Tensor:
        rows = getattr(self, f"{side}_rows")
        if not len(rows):
            return torch.zeros(0, 1)
        table = dim_zero_cat(rows).cpu()
        return table[table[:, 0].argsort(stable=True)]

    def real_state(self) -> dict[str, Tensor]:
        """All statistics of the real set, on the CPU and gathered from all processes: for a cache on disk."""
        with self.sync_context():
            names = [name for name in self._defaults if name.startswith("real_") and name != "real_rows"]
            state = {name: getattr(self, name).detach().cpu().clone() for name in names}
            if self.keeps:
                state["real_rows"] = self._numbered("real")
        return state

    def load_real_state(self, state: Mapping[str, Tensor]) -> None:
        """Take the real set's statistics from `real_state`, after `reset`; of several processes the first has them."""
        if place()[0] > 0:
            return
        for name, value in state.items():
            if name == "real_rows":
                self.real_rows = [value.to(self.device)] if len(value) else []
            else:
                getattr(self, name).copy_(value)

    def _sync_dist(self, dist_sync_fn: Callable[..., Any] = gather_all_tensors, process_group: Any = None) -> None:
        for side in SIDES if self.keeps else ():  # a process without rows sends none of the others' width
            rows = getattr(self, f"{side}_rows")
            width = torch.tensor(rows[0].shape[1] if rows else 0, device=self.device)
            most = max(map(int, dist_sync_fn(width, group=process_group or self.process_group)))
            if not rows:
                rows.append(torch.zeros(0, most, device=self.device))
        super()._sync_dist(dist_sync_fn, process_group)

    def set_dtype(self, dst_type: str | torch.dtype) -> Self:
        """Nothing: states stay float64, since sums in less would lose the digits of the figures."""
        return self

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
