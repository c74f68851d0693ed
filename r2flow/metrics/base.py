"""Base class of metrics between two sets of scans, and the protocol of their results."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities.data import dim_zero_cat

from r2flow.errors import InputError, check
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.metrics.scans import MASK, Scans
from r2flow.processes import place

Side = Literal["real", "generated"]
SIDES: tuple[Side, Side] = ("real", "generated")


@dataclass(frozen=True)
class Protocol:
    """Everything a result depends on except the scans; different protocols have different names."""

    metric: str  #: name in `r2flow.metrics.METRICS`
    representation: str  #: data compared per scan: "range image", "points", "bird's-eye histogram"
    mask: tuple[float, float] = MASK  #: range limits of returns, in metres
    extractor: str | None = None  #: name of the network; None without a network
    weights: str | None = None  #: first 12 digits of the SHA-256 of its weights
    layer: str | None = None  #: its feature layer
    settings: Mapping[str, Any] = field(default_factory=dict)  #: other settings: bins, bandwidth, neighbours


def blocks(rows: Tensor, size: int) -> Iterator[tuple[slice, Tensor]]:
    """Split rows (N, D) into blocks of at most `size`: slices, and rows in float64."""
    for start in range(0, len(rows), size):
        yield slice(start, min(start + size, len(rows))), rows[start : start + size].double()


class ScanMetric(Metric):
    """A distance between real and generated scans, or several values computed together.

    `update(scans, real=...)` adds scans of either set, as in torchmetrics' FrechetInceptionDistance. All of
    torchmetrics' interface works: `forward`, `merge_state`, `reset`, `state_dict` (after `persistent(True)`), device
    moves, collections, and a compute across processes. Sums are float64 regardless of the dtype: results agree to ten
    digits for any order of scans and number of processes.

    A subclass computes a row of numbers per scan (`rows`), sums the rows (`accumulate`) or stores them (`keeping`), and
    computes `figures`. A row of NaN marks a scan without anything to compare: it is left out, counted and mentioned in
    a remark. Its `name`, `representation`, `mask` and `settings` are as in `Protocol`.

    Args:
        sensor: Sensor of images passed to `update` as tensors.
        options: Options of torchmetrics' Metric: process_group, sync_on_compute, ...
    """

    is_differentiable = False
    full_state_update = False

    name: str
    representation: ClassVar[str]
    mask: ClassVar[tuple[float, float]] = MASK
    settings: ClassVar[Mapping[str, Any]] = {}
    needs_reflectance: bool = False  #: whether scans without reflectance are refused
    uses_reflectance: ClassVar[bool] = False  #: whether reflectance is used if present
    keeping: ClassVar[bool] = False  #: whether rows are stored in memory, float32
    fewest: ClassVar[int] = 2  #: minimum number of scans per set for `distance`
    #: Whether the first value, a distance that is 0 for equal sets, is larger for fewer scans; an evaluation's verdict
    #: is by it. False: an unbiased distance; None: not a distance; both without a verdict.
    biased: ClassVar[bool | None] = None

    def __init__(self, *, sensor: Sensor | str | None = None, name: str | None = None, **options: Any) -> None:
        # Not cached: torchmetrics would return the value from before `merge_state`.
        super().__init__(**{"compute_with_cache": False, **options})
        self.name = name or type(self).name
        self.sensor = None if sensor is None else named_sensor(sensor)
        for side in SIDES:
            self.add_state(f"{side}_scans", torch.tensor(0), dist_reduce_fx="sum")
            self.add_state(f"{side}_left_out", torch.tensor(0), dist_reduce_fx="sum")
            if self.keeping:  # N times a scan number and its row; flat, since a process without rows has no width
                self.add_state(f"{side}_rows", [], dist_reduce_fx="cat")
        # Distinguishes metrics in a MetricCollection, which updates only one of those with equal states.
        self.add_state(f"name_{self.name}", torch.tensor(0), dist_reduce_fx="sum")
        self._remarks: list[str] = []

    @property
    def protocol(self) -> Protocol:
        return Protocol(self.name, self.representation, self.mask, settings=self.settings)

    def rows(self, scans: Scans) -> Tensor:
        """Numbers of each scan, (B, D); NaN for a scan without anything to compare."""
        raise NotImplementedError

    def accumulate(self, rows: Tensor, side: Side) -> None:
        """Add finite rows to the statistics of a side."""

    def figures(self) -> tuple[dict[str, float], list[str]]:
        """Compute values by name, and remarks, from the states; default: `distance`."""
        if any(self.count(side) < self.fewest for side in SIDES):
            return {self.name: float("nan")}, [f"{self.name} needs {self.fewest} or more scans of each set."]
        return {self.name: float(self.distance(self.kept("real"), self.kept("generated")))}, []

    def distance(self, real: Tensor, generated: Tensor) -> Tensor | float:
        """The value for the stored rows of two sets, (N, D) and (M, D) float32, which it must not change in place."""
        raise NotImplementedError

    def update(self, scans: Scans | Tensor, real: bool, numbers: Sequence[int] | None = None) -> None:
        """Add a batch of real or generated scans.

        Args:
            scans: `Scans`, or images (B, 2 or 1, H, W) of the metric's `sensor`: range in metres, reflectance in
                [0, 1], 0 without a return. Metrics of the same network run it once per `Scans` object.
            numbers: Numbers of the scans: stored rows are sorted by number, so that values do not depend on the order
                of batches. Default: counted from the number of scans so far.
        """
        side: Side = "real" if real else "generated"
        numbers = range(self.given(side), self.given(side) + len(scans)) if numbers is None else numbers
        if isinstance(scans, Tensor) and self.sensor is not None:
            scans = Scans(scans.to(self.device), self.sensor, names=numbers)
        if not isinstance(scans, Scans):
            raise InputError(
                f"'{self.name}' takes metrics.scans.Scans(images, sensor), or a tensor of images once it has their "
                f"sensor: METRICS['{self.name}'](sensor='hdl64e'); found {type(scans).__name__}"
                f"{'' if self.sensor else ' without a sensor'}."
            )
        if self.needs_reflectance and not scans.has_reflectance:
            raise InputError(f"'{self.name}' needs reflectance, which these scans do not have; leave it out.")
        if len(scans):
            rows = self.rows(scans)
            shape = tuple(rows.shape) if isinstance(rows, Tensor) else type(rows).__name__
            check(shape[:-1] == (len(scans),), f"rows of '{self.name}' must be ({len(scans)}, D), found {shape}.")
            self.add_rows(rows, side, numbers)

    def add_rows(self, rows: Tensor, side: Side, numbers: Sequence[int]) -> None:
        """Add the rows of scans of these numbers to the statistics of a side."""
        whole = rows.isfinite().all(1)
        self.accumulate(rows[whole], side)
        getattr(self, f"{side}_scans").add_(len(rows))
        getattr(self, f"{side}_left_out").add_(int((~whole).sum()))
        if self.keeping and whole.any():
            numbered = torch.cat([torch.tensor(numbers, device=rows.device)[whole, None], rows[whole]], 1)
            getattr(self, f"{side}_rows").append(numbered.flatten().float().to(self.device))

    def forward(self, scans: Scans | Tensor, real: bool, numbers: Sequence[int] | None = None) -> dict[str, float]:
        """Update; return no values, since a batch alone has no distance."""
        self.update(scans, real, numbers)
        return {}

    def compute(self) -> dict[str, float]:
        """Values by name; undefined values are NaN and explained in `remarks`."""
        values, remarks = self.figures()
        usable = isinstance(values, dict) and all(hasattr(v, "__float__") for v in values.values())
        check(usable, f"the figures of '{self.name}' must be numbers by name, found {values!r}.")
        self._remarks = []
        for side in SIDES:
            scans, compared = self.given(side), self.count(side)
            if scans == 0:
                self._remarks.append(f"there are no {side} scans.")
            elif compared < scans:
                skipped = f"{scans - compared} of {scans} {side} scans"
                self._remarks.append(f"{skipped} are left out: empty, or nothing to compare.")
        self._remarks += remarks
        return values

    def remarks(self) -> list[str]:
        """Remarks on the last computed values: empty scans, fewer scans than features."""
        return list(self._remarks)

    def given(self, side: Side) -> int:
        """Number of scans of a side."""
        return int(getattr(self, f"{side}_scans"))

    def count(self, side: Side) -> int:
        """Number of compared scans of a side."""
        return self.given(side) - int(getattr(self, f"{side}_left_out"))

    def kept(self, side: Side) -> Tensor:
        """Stored rows of a side in the order of scans, (N, D) float32 on the CPU."""
        return self._numbered(side)[:, 1:]

    def _numbered(self, side: Side) -> Tensor:
        count = self.count(side)
        if not count:
            return torch.zeros(0, 1)
        rows = getattr(self, f"{side}_rows")
        table = (rows[0] if len(rows) == 1 else dim_zero_cat(rows)).cpu().view(count, -1)
        order = table[:, 0].argsort(stable=True)
        return table if bool((order.diff() == 1).all()) else table[order]  # a copy of all rows may have no room

    def real_state(self) -> dict[str, Tensor]:
        """Statistics of the real set, on the CPU and gathered from all processes, for a disk cache."""
        with self.sync_context():
            names = [name for name in self._defaults if name.startswith("real_")]
            states = {name: getattr(self, name).detach().cpu().clone() for name in names if name != "real_rows"}
            return states | ({"real_rows": self._numbered("real").detach()} if self.keeping else {})  # rows fill memory

    def load_real_state(self, state: Mapping[str, Tensor]) -> None:
        """Load the real set's statistics from `real_state`, after `reset`; only on the first process."""
        if place()[0] > 0:
            return
        for name, value in state.items():
            rows = name == "real_rows"  # never changed in place, as sums are
            moved = value.to(self.device, copy=not rows)
            setattr(self, name, [moved.flatten()] if rows else moved)

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "") -> torch.nn.Module:
        """Move alone: a change of dtype, as of a module around it, would round the sums and the network."""
        return super()._apply(lambda x: x.to(fn(x).device), exclude_state)
