"""Spinning LiDARs, each described by its rays: what every other room needs to know of a sensor."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.registry import Registry

Convention = Literal["centre", "reference"]


@dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR as an image of H beams by W azimuth bins.

    Attributes:
        name: Name in the table.
        elevations: Elevation of each row in degrees, the top row first, strictly falling.
        columns: Azimuth bins W of a full turn; column 0 begins at +180 degrees and azimuth falls with w.
        min_range: Nearest valid range in metres.
        max_range: Farthest valid range in metres.
        height: Usual height of the sensor above the ground in metres.

    Raises:
        InputError: fewer than two rows or one column, elevations that do not fall or leave
            (-90, 90) degrees, or range limits that are not 0 < min_range < max_range.
    """

    name: str
    elevations: tuple[float, ...]
    columns: int = 1024
    min_range: float = 1.45
    max_range: float = 80.0
    height: float = 1.73

    def __post_init__(self) -> None:
        e = self.elevations
        if len(e) < 2 or any(b >= a for a, b in pairwise(e)) or e[0] >= 90 or e[-1] <= -90:
            raise InputError(
                f"sensor {self.name!r}: elevations must be two or more, fall from the top row down and lie "
                f"within (-90, 90) degrees; found {len(e)} of them, {list(e)[:4]}..."
            )
        if self.columns < 1:
            raise InputError(f"sensor {self.name!r}: columns must be at least 1, found {self.columns}.")
        if not (0 < self.min_range < self.max_range < math.inf):
            raise InputError(
                f"sensor {self.name!r}: needs 0 < min_range < max_range, "
                f"found {self.min_range} and {self.max_range} metres."
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return len(self.elevations), self.columns

    @property
    def row_edges(self) -> np.ndarray:
        """Elevations in degrees that part the rows, (H + 1,), falling; float64.

        Half-way between neighbouring beams; the outer two lie as far outside as the inner ones inside.
        """
        e = np.asarray(self.elevations, dtype=np.float64)
        inner = (e[:-1] + e[1:]) / 2
        return np.concatenate([[2 * e[0] - inner[0]], inner, [2 * e[-1] - inner[-1]]])

    def rays(self, convention: Convention = "centre") -> Tensor:
        """Elevation e and azimuth a of every pixel in radians, (2, H, W), float32.

        `centre` looks through the middle of each bin: e is the beam's elevation and
        a = pi - 2 pi (w + 1/2) / W. `reference` is the bin's upper left corner, a = pi - 2 pi w / W, as the
        published R2Flow weights were trained with: biased by half a bin, kept for them alone.
        """
        if convention == "centre":
            elevation, shift = np.asarray(self.elevations, dtype=np.float64), 0.5
        elif convention == "reference":
            elevation, shift = self.row_edges[:-1], 0.0
        else:
            raise InputError(f"no ray convention named {convention!r}; known: centre, reference.")
        azimuth = math.pi - 2 * math.pi * (np.arange(self.columns) + shift) / self.columns
        grid = np.stack(np.meshgrid(np.deg2rad(elevation), azimuth, indexing="ij"))
        return torch.from_numpy(grid.astype(np.float32))

    def resized(self, rows: int | None = None, columns: int | None = None) -> "Sensor":
        """The same field of view in another number of rows and columns.

        New row edges are interpolated between the old ones, so that each new row looks at an equal
        share of the old rows, whether these are evenly spaced or not.
        """
        sensor = self if columns is None else replace(self, columns=columns)
        old = len(self.elevations)
        if rows is None or rows == old:
            return sensor
        if rows < 2:
            raise InputError(f"sensor {self.name!r}: an image needs at least 2 rows, found {rows}.")
        edges = np.interp(np.linspace(0, old, rows + 1), np.arange(old + 1), self.row_edges)
        middle = (edges[:-1] + edges[1:]) / 2
        return replace(sensor, elevations=tuple(middle.tolist()))


def evenly_spaced(top: float, bottom: float, rows: int) -> tuple[float, ...]:
    """Elevations in degrees of `rows` bins that share the field of view [bottom, top]: their middles."""
    step = (top - bottom) / rows
    return tuple(top - step * (row + 0.5) for row in range(rows))


def _beams(top: float, step: float, count: int) -> Sequence[float]:
    return tuple(top - step * beam for beam in range(count))


# Median elevations of the 64 rings of an HDL-64E, measured on unfolded KITTI scans; another car's lie within 0.2
# degrees. Rings are not evenly spaced, which matters wherever a row is a ring: under scan unfolding.
HDL64E_RINGS = (
    2.45, 2.06, 1.80, 1.34, 1.06, 0.64, 0.37, 0.00, -0.34, -0.74, -1.02,
    -1.35, -1.72, -2.05, -2.37, -2.71, -3.00, -3.36, -3.63, -3.99, -4.28, -4.61,
    -4.95, -5.28, -5.63, -5.94, -6.24, -6.50, -6.87, -7.21, -7.45, -7.81, -8.41,
    -8.93, -9.39, -9.77, -10.23, -10.83, -11.33, -11.75, -12.20, -12.63, -13.15, -13.67,
    -14.24, -14.68, -15.17, -15.53, -16.14, -16.67, -17.22, -17.67, -18.18, -18.58, -19.03,
    -19.57, -20.08, -20.67, -21.16, -21.56, -22.00, -22.64, -23.16, -23.64,
)  # fmt: skip

# hdl64e is the image of the paper: 64 equal bins between +3 and -25 degrees, 1.45 to 80 m.
SENSORS: Registry[Sensor] = Registry(
    "sensor",
    hdl64e=Sensor("hdl64e", evenly_spaced(3.0, -25.0, 64)),
    hdl64e_rings=Sensor("hdl64e_rings", HDL64E_RINGS),
    hdl32e=Sensor("hdl32e", tuple(_beams(32 / 3, 4 / 3, 32)), min_range=1.0, max_range=100.0, height=1.84),
    vlp16=Sensor("vlp16", tuple(_beams(15.0, 2.0, 16)), min_range=0.5, max_range=100.0),
)


@lru_cache(maxsize=32)
def _build(name: str, rows: int | None, columns: int | None, changes: tuple[tuple[str, float], ...]) -> Sensor:
    sensor = SENSORS[name].resized(rows, columns)
    return replace(sensor, **dict(changes)) if changes else sensor  # type: ignore[arg-type]


def build_sensor(
    name: str,
    rows: int | None = None,
    columns: int | None = None,
    min_range: float | None = None,
    max_range: float | None = None,
    height: float | None = None,
) -> Sensor:
    """A sensor of the table at an image size, its limits overridden where given."""
    changes = {"min_range": min_range, "max_range": max_range, "height": height}
    return _build(name, rows, columns, tuple((k, float(v)) for k, v in changes.items() if v is not None))
