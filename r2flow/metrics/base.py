"""Base classes of metrics between two sets of scans, and the protocol of their results."""

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from numpy import ndarray
from torch import Tensor
from torchmetrics import Metric

from r2flow.base.errors import InputError
from r2flow.base.processes import rank_and_world_size
from r2flow.base.registry import Options
from r2flow.lidar.sensors import Sensor, named_sensor
from r2flow.metrics.scans import MASK, Scans

SIDES = ("real", "generated")
BLOCK = 500  # scans: distances from 80,000 others take 320 MB, maps of two blocks 640 MB
Figures = dict[str, float]  # values by name


@dataclass(frozen=True)
class Protocol:
    """All that a result depends on except the scans; different protocols have different names."""

    metric: str  #: name in `r2flow.metrics.METRICS`
    representation: str  #: data compared per scan: "range image", "bird's-eye histogram"
    mask: tuple[float, float] = MASK  #: range limits of returns, in metres
    extractor: str | None = None  #: name of the network; None without a network
    weights: str | None = None  #: first 12 digits of the SHA-256 of its weights
    layer: str | None = None  #: its feature layer
    settings: Options = field(default_factory=dict)  #: bins, bandwidth, neighbours


def blocks(rows: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Split rows (N, D) into blocks of `BLOCK`: slices, and rows in float64."""
    for start in range(0, len(rows), BLOCK):
        block = slice(start, start + BLOCK)
        yield block, rows[block].double()


class ScanMetric(Metric):
    """A distance between real and generated scans, or several values computed together.

    `update(scans, real=...)` adds scans of either set, as in torchmetrics'
    FrechetInceptionDistance. All of torchmetrics' interface works: `forward`, `merge_state`,
    `reset`, `state_dict` (after `persistent(True)`), device moves, collections, and a compute
    across processes. Results agree to ten digits for any order of scans and number of processes.

    A subclass computes a row of numbers per scan (`rows`), and `figures` from the rows of both
    sets: see `SumMetric` and `StoredMetric`. A row of NaN marks a scan without anything to compare:
    it is left out, counted and mentioned in a remark. `name`, `representation`, `mask` and
    `settings` are as in `Protocol`.

    Args:
        sensor: Sensor of images passed to `update` as tensors.
        options: Options of torchmetrics' Metric: process_group, sync_on_compute, ...
    """

    is_differentiable = False
    full_state_update = False

    name: str
    representation: str
    mask = MASK
    settings: ClassVar[Options] = {}
    needs_reflectance: bool = False  #: whether scans without reflectance are refused
    uses_reflectance: bool = False  #: whether reflectance is used if present
    #: Whether the first value, a distance that is 0 for equal sets, is larger for fewer scans; an
    #: evaluation's verdict is by it. False: an unbiased distance; None: not a distance; both
    #: without a verdict.
    biased: bool | None = None
    remarks: list[str]  #: on the last computed values: empty scans, fewer scans than features
    counts: Tensor  #: scans of each of `SIDES` that were given, and that are compared, (2, 2)

    def __init__(self, *, sensor: Sensor | str | None = None, **options: Any) -> None:
        # Not cached: torchmetrics would return the value from before `merge_state`.
        super().__init__(**{"compute_with_cache": False, **options})
        self.sensor = None if sensor is None else named_sensor(sensor)
        self.remarks = []
        self.add_state("counts", torch.zeros(2, 2, dtype=torch.int64), "sum")
        # A MetricCollection updates only one of several metrics with equal states.
        self.add_state(f"name_{self.name}", torch.tensor(0), "sum")

    @property
    def protocol(self) -> Protocol:
        return Protocol(self.name, self.representation, self.mask, settings=self.settings)

    @abstractmethod
    def rows(self, scans: Scans) -> Tensor:
        """Numbers of each scan, (B, D); NaN for a scan without anything to compare."""

    @abstractmethod
    def accumulate(self, rows: Tensor, side: int) -> None:
        """Add finite rows to the states of a side."""

    @abstractmethod
    def figures(self) -> Figures:
        """Compute values by name from the states, and append to `remarks`."""

    def update(self, scans: Scans | Tensor, real: bool) -> None:
        """Add a batch of real or generated scans.

        Args:
            scans: `Scans`, or images (B, 2 or 1, H, W) of the metric's `sensor`: range in metres,
                reflectance in [0, 1], 0 without a return. Metrics of the same network run it once
                per `Scans` object.

        Raises:
            InputError: Images without a sensor, with impossible values, or without the reflectance
                that the metric needs.
        """
        if isinstance(scans, Tensor):
            if self.sensor is None:
                raise InputError(f"'{self.name}' needs the sensor of images: pass sensor='hdl64e'.")
            first = int(self.counts[0 if real else 1, 0])
            numbers = range(first, first + len(scans))
            scans = Scans(scans.to(self.device), self.sensor, names=numbers)
        if self.needs_reflectance and not scans.has_reflectance:
            raise InputError(
                f"'{self.name}' needs reflectance, which these scans do not have; leave it out."
            )
        if len(scans):
            self._add_rows(self.rows(scans), real)

    def _add_rows(self, rows: Tensor, real: bool) -> None:
        """Add the rows of scans to the states."""
        side = 0 if real else 1
        whole = rows.isfinite().all(1)
        self.accumulate(rows[whole], side)
        self.counts[side, 0] += len(rows)
        self.counts[side, 1] += int(whole.sum())

    def forward(self, *args: Any, **options: Any) -> Figures:
        """Update; return no values, since a batch alone has no distance."""
        self.update(*args, **options)
        return {}

    def compute(self) -> Figures:
        """Values by name; undefined values are NaN and explained in `remarks`."""
        self.remarks = []
        for side, (scans, compared) in zip(SIDES, self.counts.tolist(), strict=True):
            if not scans:
                self.remarks.append(f"there are no {side} scans.")
            elif compared < scans:
                self.remarks.append(
                    f"{scans - compared} of {scans} {side} scans are left out: empty, or nothing "
                    "to compare."
                )
        return self.figures()

    def real_state(self) -> dict[str, Tensor]:
        """States of the real set, on the CPU and gathered from all processes."""
        with self.sync_context():
            states = {
                name: _joined(value) if name == "real_rows" else value[0].clone()
                for name, value in self.metric_state.items()
                if name in ("counts", "sums", "real_rows")
            }
        return {name: value.cpu() for name, value in states.items()}

    def load_real_state(self, state: Mapping[str, Tensor]) -> None:
        """Load the states from `real_state`, after `reset`; only on the first process."""
        if rank_and_world_size()[0] == 0:
            for name, value in state.items():  # into the first row of a tensor, or an empty list
                getattr(self, name)[:1] = value.to(self.device)[None]

    def _apply(
        self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = ""
    ) -> torch.nn.Module:
        """Move alone: a change of dtype, as of a module around it, would round the states."""
        return super()._apply(lambda x: x.to(fn(x).device), exclude_state)


class SumMetric(ScanMetric):
    """A metric of the sum of rows of a set, in float64; sums of integers are exact in any order."""

    width: int  #: length of a row
    sums: Tensor  #: of both sides, (2, width)

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("sums", torch.zeros(2, self.width, dtype=torch.float64), "sum")

    @abstractmethod
    def figures_of(self, real: ndarray, generated: ndarray) -> Figures:
        """Compute values from the two sums of rows, (width,) each; zeros without any rows."""

    def accumulate(self, rows: Tensor, side: int) -> None:
        self.sums[side] += rows.sum(0, dtype=torch.float64).to(self.sums)

    def figures(self) -> Figures:
        values = self.figures_of(*self.sums.cpu().numpy())
        if self.counts[:, 0].all():
            return values
        return dict.fromkeys(values, float("nan"))


class StoredMetric(ScanMetric):
    """A metric of all rows of both sets, which are stored in float32."""

    fewest: int = 2  #: minimum number of scans per set
    #: Rows one after another; flat, since a process without rows has no width.
    real_rows: list[Tensor]
    generated_rows: list[Tensor]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("real_rows", [], "cat")
        self.add_state("generated_rows", [], "cat")

    def accumulate(self, rows: Tensor, side: int) -> None:
        stored = (self.real_rows, self.generated_rows)[side]
        stored.append(rows.flatten().float().to(self.device))

    @abstractmethod
    def value(self, real: Tensor, generated: Tensor) -> float:
        """Compute the value from rows (N, D) and (M, D), float32, which must not be changed."""

    def figures(self) -> Figures:
        real, generated = self.counts[:, 1].tolist()
        if min(real, generated) < self.fewest:
            self.remarks.append(f"{self.name} needs {self.fewest} or more scans of each set.")
            return {self.name: float("nan")}
        rows = _joined(self.real_rows).cpu().view(real, -1)
        others = _joined(self.generated_rows).cpu().view(generated, -1)
        return {self.name: self.value(rows, others)}


def _joined(rows: list[Tensor] | Tensor) -> Tensor:
    """Stored rows as one tensor, (N D,); not copied if they are one already."""
    if isinstance(rows, Tensor):  # gathered from all processes
        return rows
    return rows[0] if len(rows) == 1 else torch.cat(rows or [torch.zeros(0)])
