"""Encodings of a range, from metres to [0, 1] and back."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.base.registry import Registry
from r2flow.lidar.sensors import Sensor


class _RangeFormat:
    """Maps ranges r in metres, (..., 1, H, W), to values y in [0, 1] and back: r / r_max."""

    def __init__(self, sensor: Sensor) -> None:
        self.min_range = sensor.min_range
        self.max_range = sensor.max_range

    def forward(self, r: Tensor) -> Tensor:
        return r / self.max_range

    def inverse(self, y: Tensor) -> Tensor:
        return y * self.max_range


class _LogScale(_RangeFormat):
    """log2(r + 1) / log2(r_max + 1), the paper's eq. 5: finer near the sensor."""

    def __init__(self, sensor: Sensor) -> None:
        self.scale = math.log2(sensor.max_range + 1)

    def forward(self, r: Tensor) -> Tensor:
        return torch.log2(r + 1) / self.scale

    def inverse(self, y: Tensor) -> Tensor:
        return torch.exp2(y * self.scale) - 1


class ShiftedLog(_LogScale):
    """log2(r + 1.0001) / scale, with scale = log2(r_max + 1) rounded up to hundredths.

    Used by LiDARGen (r_max 63 m, scale 6) and LiDM (56 m, 5.84). A ray without return is
    log2(1.0001) / scale, not exactly 0; the inverse, 2^(scale y) - 1, keeps the offset of 0.1 mm.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.scale = math.ceil(100 * math.log2(sensor.max_range + 1) - 1e-9) / 100

    def forward(self, r: Tensor) -> Tensor:
        return super().forward(r.clamp(min=0) + 1e-4)

    def inverse(self, y: Tensor) -> Tensor:
        return super().inverse(y.clamp(0, 1))


class _Inverse(_RangeFormat):
    """r_min / r, 0 for no return.

    float32 resolves r to r^2 / r_min 2^-26: 2 mm for limits of 0.3 and 200 m.
    """

    def forward(self, r: Tensor) -> Tensor:
        return torch.where(r > 0, self.min_range / r.clamp(min=1e-12), 0.0)

    inverse = forward  # type: ignore[assignment]


class _InverseDepth(_Inverse):
    """r_min / r within the range limits, else 0, in both directions, as in DUSty: no tolerance."""

    def forward(self, r: Tensor) -> Tensor:
        return torch.where((r >= self.min_range) & (r <= self.max_range), super().forward(r), 0.0)

    def inverse(self, y: Tensor) -> Tensor:
        inverse = y / self.min_range
        inside = (inverse >= 1 / self.max_range) & (inverse <= 1 / self.min_range)
        return torch.where(inside, super().inverse(y), 0.0)


FORMATS: Registry[Callable[[Sensor], _RangeFormat]] = Registry(
    "range format",
    logscale=_LogScale,
    shifted_log=ShiftedLog,
    inverse=_Inverse,
    inverse_depth=_InverseDepth,
    metric=_RangeFormat,
)
