"""Custom sensors as YAML files, for commands and, in conf/sensor/, for training."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from r2flow.errors import InputError, naming
from r2flow.files import atomic_write, reading
from r2flow.lidar.sensors import Sensor, build_sensor
from r2flow.registry import UnknownName, check_options

ENDINGS = (".yaml", ".yml")
LARGEST_FILE = 1 << 20  # bytes; a sensor is a dozen lines


def read_sensor(path: str | Path, rows: int | None = None, columns: int | None = None) -> Sensor:
    """Read a sensor from a YAML file with the options of `build_sensor`, in another size if given."""
    path = Path(path)
    with reading(path, LARGEST_FILE, "sensor's YAML"):
        options = yaml.safe_load(path.read_text(encoding="utf-8"))
    if not isinstance(options, dict) or not all(isinstance(key, str) for key in options):
        raise InputError(f"{path} is no sensor: it needs lines as `name: mine` and `elevations: [15.0, 13.0, ...]`.")
    sized = {"rows": rows, "columns": columns}
    options.update({key: value for key, value in sized.items() if value is not None})
    check_options(str(path), build_sensor, options)
    with naming(path):
        return build_sensor(**options)


def named_sensor(sensor: Sensor | str, size: tuple[int, int] | None = None) -> Sensor:
    """A sensor, given directly, by name or by YAML file, at an image size of (rows, columns)."""
    if size is not None and not (isinstance(size, tuple | list) and [type(n) for n in size] == [int, int]):
        raise InputError(f"a size is (rows, columns), found {size!r}.")
    if isinstance(sensor, Sensor):
        return sensor if size is None else sensor.resized(*size)
    sensor = str(sensor)
    if sensor.lower().endswith(ENDINGS):
        return read_sensor(sensor, *(size or (None, None)))
    try:
        return build_sensor(sensor, *(size or (None, None)))
    except UnknownName as error:
        raise UnknownName(f"{error} Your own is a YAML file: r2flow sensor SCANS --out NAME.yaml") from None


def write_sensor(sensor: Sensor, path: str | Path, comment: str) -> None:
    """Write a sensor as a YAML file that begins with a comment, such as the source of the numbers."""
    options = {key: value for key, value in options_of_sensor(sensor).items() if key == "rows" or value is not None}
    units = "Elevations in degrees, the top row first, a row each where rows is null; ranges and height in metres."
    with atomic_write(path, "w") as file:
        file.writelines(f"# {line}\n" for line in (*comment.splitlines(), units))
        yaml.safe_dump(options, file, default_flow_style=None, sort_keys=False, width=100)


def options_of_sensor(sensor: Sensor) -> dict[str, Any]:
    """The keys of `sensor` in a config: the options of `build_sensor`, and rays through the pixels' centres."""
    options = {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(sensor).items()}
    return {**options, "rows": None, "rays": "centre"}
