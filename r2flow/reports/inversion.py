"""Real scans turned into their noise and back: files, a table, a page."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.data.sources import read_scan
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.generators import Sampler
from r2flow.inversion import TIGHT, Inversion, invert, round_trip
from r2flow.reports.outputs import ScanBar
from r2flow.reports.pages import Page, prepare_folder
from r2flow.reports.tables import print_table, table
from r2flow.reports.views import range_image

COLUMNS = {
    "scan": "scan",
    "returns": "returns",
    "evaluations": "evaluations",
    "rms": "RMS, model space",
    "median_m": "median, m",
    "rms_m": "RMS, m",
    "dropped": "rays lost or gained",
    "noise_std": "std of x_0",
    "converged": "converged",
}
SHOWN = 4  # scans in the figure


def scan_of(path: Path, checkpoint: Checkpoint, reflectance_scale: float | None = None) -> Tensor:
    """A scan as the checkpoint's flow sees it: range in metres and reflectance, (2 or 1, H, W).

    Args:
        path: A scan file of any format, projected as the flow's training scans were; or a range image, .npy of shape
            (2 or 1, H, W), in which what is not finite or beyond the sensor's limits is a dropped ray.
        reflectance_scale: The value in the file that means full reflectance; None for the one of the training.

    Raises:
        InputError: a file that cannot be read, a range image of another size, or one without needed reflectance.
    """
    sensor, needed = checkpoint.sensor, checkpoint.encoding.reflectance
    image = range_image(path)
    if image is None:
        data = checkpoint.config.get("data", {})
        scale = data.get("reflectance_scale", 1.0) if reflectance_scale is None else reflectance_scale
        projection, convention = data.get("projection", "spherical"), data.get("convention", "centre")
        return torch.from_numpy(read_scan(path, sensor, projection, convention, needed, scale))
    if image.shape[1:] != sensor.shape:
        found, wanted = ("x".join(map(str, shape)) for shape in (image.shape[1:], sensor.shape))
        raise InputError(f"{path} is a range image of {found}, the checkpoint's are {wanted}.")
    if len(image) < 1 + needed:
        raise InputError(f"{path} has no reflectance, and this flow was trained with it.")
    seen = (image[0] >= sensor.min_range) & (image[0] <= sensor.max_range)
    image = np.where(seen, image[: 1 + needed], np.float32(0))
    image[1:] = image[1:].clip(0, 1)
    return torch.from_numpy(image)


def invert_scans(
    checkpoint: Checkpoint,
    paths: Sequence[Path],
    out: str | Path,
    sampler: Sampler = TIGHT,
    batch_size: int = 1,
    reflectance_scale: float | None = None,
    command: str = "",
) -> Page:
    """Write the noise of every scan as `out/NAME.x_0.npy`, float32 (C, H, W) in model space.

    Returns:
        The page of round-trip errors, still to be written.

    Raises:
        InputError: a scan or a solver that cannot be used, before anything is written.
    """
    checkpoint.generator.check_sampler(sampler)
    scans, names = [scan_of(path, checkpoint, reflectance_scale) for path in paths], unique_names(paths)
    prepare_folder(out)
    rows: list[dict[str, Any]] = []
    pairs: list[tuple[str, np.ndarray]] = []
    way = 2 * checkpoint.generator.evaluations_of(sampler) * -(-len(paths) // batch_size)
    with ScanBar("inverting", len(paths), way) as bar:
        for first in range(0, len(paths), batch_size):
            some = slice(first, first + batch_size)
            images = torch.stack(scans[some])
            found = invert(checkpoint, images, sampler, bar.evaluated)
            for name, x_0 in zip(names[some], found.x_0.numpy(), strict=True):
                with atomic_write(Path(out, f"{name}.x_0.npy")) as file:
                    np.save(file, x_0)
            rows += errors_of(checkpoint, found, names[some], images)
            for name, image, x in zip(names[some], images, found.again, strict=True):
                if len(pairs) < 2 * SHOWN:
                    pairs += [(f"{name}, real", image.numpy()), ("there and back", _decoded(checkpoint, x))]
            bar.finished(len(rows))
    return _page(checkpoint, rows, pairs, _solver(sampler, way), command)


def errors_of(checkpoint: Checkpoint, found: Inversion, names: Sequence[str], images: Tensor) -> list[dict[str, Any]]:
    """A row of `COLUMNS` for each scan."""
    errors = round_trip(checkpoint, found)
    rows: list[dict[str, Any]] = []
    for i, name in enumerate(names):
        row: dict[str, Any] = {"scan": name, "returns": int((images[i, 0] > 0).sum())}
        row["evaluations"] = int(found.evaluations[i])
        for key in ("rms", "median_m", "rms_m", "dropped", "noise_std"):
            row[key] = float(getattr(errors, key)[i])
        rows.append({**row, "converged": bool(found.converged[i])})
    return rows


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Stems of the files, with a number where two share one."""
    stems = [path.name.split(".")[0] for path in paths]
    return [
        stem if stems.count(stem) == 1 else f"{stem}_{stems[:index].count(stem) + 1}"
        for index, stem in enumerate(stems)
    ]


def print_rows(rows: Sequence[dict[str, Any]]) -> None:
    """The errors as a table, and a line for what has not been solved."""
    headings = ("scan", "returns", "evals", "RMS", "med. m", "RMS m", "rays ±", "std x_0", "solved")
    print_table(rows, dict(zip(COLUMNS, headings, strict=True)))
    print("RMS in model space; rays ±: share of all rays lost or gained; std x_0: near 1 for scans that the flow knows")
    lost = [row["scan"] for row in rows if not row["converged"]]
    if lost:
        print(f"not solved, and their noise is NaN: {', '.join(lost)}. A larger --tolerance may do.")


def _decoded(checkpoint: Checkpoint, x: Tensor) -> np.ndarray:
    return checkpoint.encoding.decode(x).nan_to_num(0.0).numpy()


def _solver(sampler: Sampler, evaluations: int) -> str:
    return f"{sampler.method}, " + (f"{sampler.steps} steps" if evaluations else f"tolerance {sampler.tolerance:g}")


def _page(
    checkpoint: Checkpoint,
    rows: Sequence[dict[str, Any]],
    pairs: Sequence[tuple[str, np.ndarray]],
    solver: str,
    command: str,
) -> Page:
    from r2flow.reports.pictures import contact_sheet

    titles, images = zip(*pairs, strict=True)
    figure = contact_sheet(images, checkpoint.sensor.rays(), titles)
    text = (
        f"{len(rows)} scans carried from t = 1 to their noise at t = 0 and back by {solver}, through the flow of "
        f"{checkpoint.path.name}, step {checkpoint.step}. Metres are of the rays that return both times; rays lost or "
        "gained are a share of all. x_0 of a scan that the flow knows has a standard deviation near 1.",
        table(rows, COLUMNS),
    )
    device = str(checkpoint.generator.device)
    return Page("invert", "Scans there and back", text, rows, {"invert": figure}, command, device=device)
