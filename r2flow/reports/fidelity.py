"""One set of scans beside another and beside controls, as a table."""

from pathlib import Path
from typing import Any

import numpy as np

from r2flow.data.sources import read_scan
from r2flow.errors import InputError
from r2flow.lidar.projection import Projection
from r2flow.lidar.scan_files import read_points
from r2flow.lidar.sensors import Sensor
from r2flow.metrics.fidelity import controls, distances, nearest, panel
from r2flow.reports.views import range_image, scans_of


def load_images(
    path: str | Path,
    sensor: Sensor,
    projection: Projection = "spherical",
    reflectance_scale: float = 1.0,
    most: int = 1000,
) -> np.ndarray:
    """The scans of a file or folder, of any known format or range images, (N, 2 or 1, H, W).

    Reflectance is there only where every scan has it. Of a folder with more than `most` scans, that many are taken,
    evenly spread over it.

    Raises:
        InputError: no scan there, or a range image of another size than the sensor's.
    """
    from rich.progress import track

    images = []
    paths = scans_of(Path(path), most)
    for file in track(paths, f"reading {path}", disable=len(paths) < 32, transient=True):
        image = range_image(file)
        if image is None:
            reflectance = read_points(file).reflectance is not None
            image = read_scan(file, sensor, projection, "centre", reflectance, reflectance_scale)
        if image.shape[1:] != sensor.shape:
            found, wanted = ("x".join(map(str, shape)) for shape in (image.shape[1:], sensor.shape))
            raise InputError(f"{file} is a range image of {found}, the sensor's is {wanted}; give --size {found}.")
        images.append(image)
    channels = min(len(image) for image in images)
    return np.stack([image[:channels] for image in images])


def fidelity(
    real: np.ndarray, other: np.ndarray, sensor: Sensor, training: np.ndarray | None = None, seed: int = 0
) -> dict[str, Any]:
    """Distances from `real` of `other`, of the training scans where given, and of four controls.

    The controls are made of the training scans; without these, of the real ones, which flatters them.

    Returns:
        `{sets: {name: {line: distance}}, won: [line], lost: [line], nearest: {name: (median, least)}}`; a line
        is won where `other` is nearer to `real` than every control.
    """
    channels = min(s.shape[1] for s in (real, other, training) if s is not None)
    real, other = real[:, :channels], other[:, :channels]
    training = None if training is None else training[:, :channels]
    truth = panel(real, sensor)
    base = real if training is None else training
    sets = {"other": other}
    if training is not None:
        sets["training scans"] = training
    made = controls(base, sensor, max(len(other), 8), seed)
    table = {name: distances(panel(images, sensor), truth) for name, images in {**sets, **made}.items()}
    won = [line for line in table["other"] if table["other"][line] < min(table[name][line] for name in made)]
    result: dict[str, Any] = {
        "sizes": {"real": len(real), "other": len(other), "training": 0 if training is None else len(training)},
        "sets": table,
        "won": won,
        "lost": [line for line in table["other"] if line not in won],
    }
    if training is not None:
        compared = {
            "other": nearest(other, training, sensor),
            "real": nearest(real, training, sensor),
            "training scans": nearest(training, training, sensor, leave_self=True),
            **{name: nearest(images, training, sensor) for name, images in made.items()},
        }
        result["nearest"] = {name: (float(np.median(d)), float(d.min())) for name, d in compared.items()}
    return result


def markdown(result: dict[str, Any], name: str = "other") -> str:
    """The result as Markdown tables; `name` stands for the set that was judged."""
    sets = {(name if key == "other" else key): value for key, value in result["sets"].items()}
    lines = ["| distance to the real scans | " + " | ".join(sets) + " |", "|---" * (len(sets) + 1) + "|"]
    for line in result["sets"]["other"]:
        values = " | ".join(
            f"**{v[line]:.3f}**" if n == name and line in result["won"] else f"{v[line]:.3f}" for n, v in sets.items()
        )
        lines.append(f"| {line} | {values} |")
    lines += ["", f"Nearer to the real scans than every control (bold): {', '.join(result['won']) or 'nowhere'}."]
    lines += [f"Not yet: {', '.join(result['lost']) or 'nowhere'}."]
    if "nearest" in result:
        lines += ["", "| distance to the nearest training scan | median | least |", "|---|---|---|"]
        for key, (median, least) in result["nearest"].items():
            lines.append(f"| {name if key == 'other' else key} | {median:.3f} | {least:.3f} |")
    sizes = ", ".join(f"{count} {key}" for key, count in result["sizes"].items() if count)
    return "\n".join([*lines, "", f"Scans: {sizes}."])
