"""Sensors: spinning LiDARs, described by their rays, by name or in YAML files."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from itertools import pairwise
from math import inf, pi
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError, check, quoted
from r2flow.base.files import parse_yaml, reading, write_file
from r2flow.base.registry import Registry, check_options, construct, options_of

Rays = Literal["centre", "reference"]
Convention = Literal[Rays, "lidargen", "lidm"]

_MOST_PIXELS = 1 << 24  # of an image, 128 x 131,072: more than any sensor has, but within memory
ENDINGS = (".yaml", ".yml")


@dataclass(frozen=True)
class Sensor:
    """A spinning LiDAR as an image of H beams by W azimuth bins. Elevations are in degrees."""

    name: str
    elevations: tuple[float, ...]  # of each row in degrees, the top row first, strictly decreasing
    # Azimuth bins W of a full turn; column 0 begins at +180 degrees, azimuth decreases with w.
    columns: int = 1024
    min_range: float = 1.45  # valid ranges, in metres
    max_range: float = 80.0
    height: float = 1.73  # typical height of the sensor above the ground in metres
    # Row of laser 0, 1, ... in the order of the sensor's packets; None: top-down or bottom-up.
    firing: tuple[int, ...] | None = None
    reflectance_scale: float | None = None  # value of full reflectance in its scan files
    # Factors of the 68 % and the 95 % error of points added to its scans (`r2flow calibrate`).
    error_factors: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for field in ("elevations", "firing", "error_factors"):
            values = getattr(self, field)
            if values is not None:  # lists have no hash
                object.__setattr__(self, field, tuple(np.asarray(values).tolist()))
        rows = len(self.elevations)
        order = range(rows) if self.firing is None else self.firing
        scale = 1.0 if self.reflectance_scale is None else self.reflectance_scale
        factors = (1.0, 1.0) if self.error_factors is None else self.error_factors
        inside = (90.0, *self.elevations, -90.0)
        rules = {
            "elevations must be two or more, from the top row down within (-90, 90) degrees": (
                rows > 1 and all(upper > lower for upper, lower in pairwise(inside))
            ),
            f"columns must be 1 or more, with at most {_MOST_PIXELS:,} pixels": (
                self.columns >= 1 and rows * self.columns <= _MOST_PIXELS
            ),
            "needs 0 < min_range < max_range in metres": 0 < self.min_range < self.max_range < inf,
            "height must be metres above the ground": 0 < self.height < inf,
            "firing must name each row once": sorted(order) == list(range(rows)),
            "reflectance_scale must be a positive number": 0 < scale < inf,
            "error_factors must be two positive numbers": (
                len(factors) == 2 and all(0 < factor < inf for factor in factors)
            ),
        }
        for rule, holds in rules.items():
            check(holds, f"sensor {quoted(self.name)}: {rule}.")

    def described(self) -> dict[str, Any]:
        """All fields that images depend on, as plain values: all except `reflectance_scale` and
        `error_factors`.
        """
        calibrated = ("reflectance_scale", "error_factors")
        return {name: value for name, value in asdict(self).items() if name not in calibrated}

    @property
    def shape(self) -> tuple[int, int]:
        """Image size (H, W)."""
        return len(self.elevations), self.columns

    def __str__(self) -> str:
        """Name and image size, as in messages."""
        return f"{self.name} {len(self.elevations)}x{self.columns}"

    def same_image(self, other: "Sensor") -> bool:
        """Whether images of both have the same size, and elevations within 0.001 degrees."""
        return self.shape == other.shape and np.allclose(
            self.elevations, other.elevations, atol=1e-3
        )

    @property
    def row_edges(self) -> ndarray:
        """Elevations in degrees of the edges of the rows, (H + 1,), decreasing; float64.

        Inner edges are half-way between neighbouring beams; outer edges are as far from their beam
        as its inner edge.
        """
        e = np.asarray(self.elevations, dtype=float)
        inner = (e[:-1] + e[1:]) / 2
        return np.concatenate([[2 * e[0] - inner[0]], inner, [2 * e[-1] - inner[-1]]])

    def rays(self, convention: Rays = "centre") -> Tensor:
        """Elevation e and azimuth a of every pixel in radians, (2, H, W), float32.

        `centre` is the centre of each bin: e is the beam's elevation, a = pi - 2 pi (w + 1/2) / W.
        `reference` is the upper left corner of the bin, a = pi - 2 pi w / W, an offset of half a
        bin that published R2Flow weights need.
        """
        elevation = self.row_edges[:-1]
        column = np.arange(self.columns, dtype=float)
        if convention == "centre":
            elevation = np.asarray(self.elevations, dtype=float)
            column += 0.5
        azimuth = pi * (1 - 2 * column / self.columns)  # 0 exactly in the middle
        grid = np.stack(np.meshgrid(np.deg2rad(elevation), azimuth, indexing="ij"))
        return torch.from_numpy(grid.astype(np.float32))

    def resized(
        self, rows: int | None = None, columns: int | None = None, rays: Rays = "centre"
    ) -> "Sensor":
        """The sensor with the same field of view and another number of rows and columns.

        More rows: each beam is the centre of a row, with the others evenly spread between beams.
        Fewer, or `reference`: row edges are interpolated, so that each new row covers an equal
        share of the old rows.

        Raises:
            InputError: The image would have less than two rows, no column or too many pixels.
        """
        sensor = self if columns is None else replace(self, columns=columns)
        e = self.elevations
        old = len(e)
        if rows is None or rows == old:
            return sensor
        most = _MOST_PIXELS // sensor.columns
        check(
            2 <= rows <= most,
            f"sensor {quoted(self.name)}: rows must be 2 to {most:,}, found {rows}.",
        )
        if rows > old and rays == "centre":
            beam = np.arange(-1, old + 1)  # with a step beyond the first and the last beam
            above = min(2 * e[0] - e[1], e[0] / 2 + 45)
            below = max(2 * e[-1] - e[-2], e[-1] / 2 - 45)
            centre = (2 * beam + 1) * rows // (2 * old)
            middle = np.interp(np.arange(rows), centre, [above, *e, below])
        else:
            edges = np.interp(np.linspace(0, old, rows + 1), np.arange(old + 1), self.row_edges)
            middle = (edges[:-1] + edges[1:]) / 2
        return replace(sensor, elevations=tuple(middle.tolist()), firing=None)  # not one laser each


def _built_in(name: str) -> Sensor:
    file = files("r2flow.lidar") / "built_in" / f"{name}.yaml"
    return Sensor(**yaml.safe_load(file.read_text(encoding="utf-8")))


SENSORS: Registry[Sensor] = Registry(
    "sensor",
    hdl64e=_built_in("hdl64e"),
    hdl64e_rings=_built_in("hdl64e_rings"),
    hdl32e=_built_in("hdl32e"),
    vlp16=_built_in("vlp16"),
    vlp32c=_built_in("vlp32c"),
    os1_64=_built_in("os1_64"),
    os1_128=_built_in("os1_128"),
    pandar64=_built_in("pandar64"),
)


def build_sensor(
    name: str,
    rows: int | None = None,
    columns: int | None = None,
    min_range: float | None = None,
    max_range: float | None = None,
    height: float | None = None,
    elevations: Sequence[float] | None = None,
    firing: Sequence[int] | None = None,
    reflectance_scale: float | None = None,
    error_factors: Sequence[float] | None = None,
    rays: Rays = "centre",
) -> Sensor:
    """A built-in sensor by name, or a custom sensor by `elevations`, with the given options.

    `rays` are the model's (`Sensor.rays`); with `reference`, rows are even shares of the view.
    """
    if elevations is None:
        sensor = SENSORS[name]
    elif name in SENSORS:
        raise InputError(f"{name!r} is a built-in sensor; give your own sensor another name.")
    else:
        sensor = Sensor(name, tuple(e + 0.0 for e in elevations))  # no -0.0
    options: dict[str, Any] = {
        "min_range": min_range,
        "max_range": max_range,
        "height": height,
        "firing": firing,
        "reflectance_scale": reflectance_scale,
        "error_factors": error_factors,
    }
    options = {
        name: float(value) if isinstance(value, int) else value
        for name, value in options.items()
        if value is not None
    }
    return replace(sensor, **options).resized(rows, columns, rays)


def read_sensor(path: str | Path) -> Sensor:
    """Read a sensor from a YAML file with the options of `build_sensor`."""
    with reading(Path(path), 1 << 20, "sensor's YAML"):  # of a dozen lines
        options = parse_yaml(Path(path).read_text(encoding="utf-8"))
        if not isinstance(options, dict):
            raise InputError("it is not a sensor: give `name: mine`, `elevations: [15.0, ...]`.")
        centre = options.get("rays", "centre") == "centre"
        check(centre, "rays are a model's: give sensor.rays=reference in training.")
        return construct(str(path), build_sensor, options)


def named_sensor(sensor: Sensor | str, size: tuple[int, int] | None = None) -> Sensor:
    """A sensor, given directly, by name or by YAML file, at an image size of (rows, columns)."""
    if not isinstance(sensor, Sensor):
        sensor = build_sensor(**sensor_options(sensor))
    return sensor if size is None else sensor.resized(*size)


def sensor_yaml(sensor: Sensor, comment: str) -> str:
    """A sensor as YAML that begins with a comment, such as the numbers' source."""
    units = "Elevations in degrees, the top row first; ranges and height in metres."
    lines = [f"# {line}\n" for line in (*comment.splitlines(), units)]
    options = options_of_sensor(sensor)
    text = yaml.safe_dump(options, default_flow_style=None, sort_keys=False, width=100)
    return "".join(lines) + text


def write_sensor(sensor: Sensor, path: str | Path, comment: str) -> None:
    """Write a sensor as a YAML file (`sensor_yaml`)."""
    write_file(path, sensor_yaml(sensor, comment))


def options_of_sensor(sensor: Sensor) -> dict[str, Any]:
    """The keys of `sensor` in a config: the options of `build_sensor`."""
    options = {key: np.asarray(value).tolist() for key, value in asdict(sensor).items()}
    options |= {"rows": None, "rays": "centre"}
    if sensor.name in SENSORS:  # beams by the name
        options |= {"rows": len(sensor.elevations), "elevations": None}
    return options


def sensor_options(sensor: Sensor | str | Mapping[str, Any]) -> dict[str, Any]:
    """Complete options of `build_sensor`, from a sensor, its name, a YAML file, or some options.

    Raises:
        InputError: an unknown name or option.
    """
    if isinstance(sensor, Sensor):
        return options_of_sensor(sensor)
    if isinstance(sensor, str) and sensor.lower().endswith(ENDINGS):
        return options_of_sensor(read_sensor(sensor))
    options = {**options_of(build_sensor), **SENSORS.options(sensor)}
    return check_options("sensor", build_sensor, options)
