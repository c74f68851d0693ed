"""A sensor estimated from scans of it, with what was found."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2flow.base.errors import InputError, warn_odd
from r2flow.base.progress import track
from r2flow.data.described import describe
from r2flow.data.reflectance import DARK, is_dark
from r2flow.data.sensor_checks import warn_of_frame
from r2flow.lidar.estimation import estimate_sensor, hangs
from r2flow.lidar.matching import nearest_sensor
from r2flow.lidar.scan_files import Points, points_beside, read_points
from r2flow.lidar.sensors import Sensor, sensor_yaml, write_sensor


@dataclass(frozen=True)
class EstimatedSensor:
    """A sensor estimated from scans."""

    sensor: Sensor
    findings: dict[str, str]  #: what was found of beams, ranges, height and reflectance, as text
    source: str  #: what it is estimated from, for its YAML file

    def write(self, path: Path) -> None:
        """Write the sensor as YAML.

        Raises:
            InputError: there is a file with other content.
        """
        if path.exists() and path.read_bytes() != sensor_yaml(self.sensor, self.source).encode():
            raise InputError(f"{path} exists, with other content; give another --out.")
        write_sensor(self.sensor, path, self.source)


def estimated_sensor(
    scans: Sequence[str | Path],
    name: str = "mine",
    columns: Sequence[str] | None = None,
    most: int = 8,
) -> EstimatedSensor:
    """Estimate the sensor of up to `most` scans of each name: beams, resolution, range limits,
    height, reflectance.

    Args:
        scans: Scan files, folders or NAME:FOLDER, all of one sensor.
        name: Name of the sensor.
        columns: Names of the columns of files without names.

    Raises:
        InputError: scans that cannot be read or show no beams.
    """
    paths = [points_beside(Path(path)) for one in scans for path in describe(one).some(most)]
    points = [read_points(path, columns) for path in track(paths, "reading", "scans", least=16)]
    warn_of_frame(dict(zip(paths, points, strict=True)))
    sensor, beams, steps, off, ground = estimate_sensor(points, name)
    degrees = sensor.elevations
    nearest, distance = nearest_sensor(beams.elevations)
    height = f"{sensor.height:.2f} m above the ground{'' if ground else ', assumed'}"
    findings = {
        "beams": f"{len(degrees)}: {beams.order}",
        "elevations": f"{degrees[0]:+.2f} to {degrees[-1]:+.2f} degrees; "
        f"points lie {off[0]:.2f} from their beams, 95 % of them within {off[1]:.2f}",
        "nearest sensor": f"{nearest}, its beams {distance:.2f} degrees off" if nearest else "none",
        "resolution": f"{steps:,.0f} steps a turn; images of {sensor.columns} columns",
        "range seen": f"{sensor.min_range:g} to {sensor.max_range:g} m; "
        "raise min_range if the vehicle is visible",
        "height": "not known: the ground lies above the sensor" if hangs(points) else height,
        "reflectance": _reflectance(points, sensor.reflectance_scale, paths[0]),
    }
    source = f"Estimated from {len(points)} scan(s), stored {beams.order}."
    return EstimatedSensor(sensor, findings, source)


def _reflectance(points: Sequence[Points], scale: float | None, first: Path) -> str:
    """What was found of reflectance; warns if a scan named `first` has dark values."""
    if not scale:
        return "none: encoding.reflectance=false"
    values = np.concatenate([one.reflectance for one in points if one.reflectance is not None])
    if is_dark(values[values > 0], scale):
        warn_odd(first, DARK)
    beyond = (values > 1.001 * scale).sum()
    return f"reflectance_scale={scale:g}; {beyond:,} points beyond are clipped"
