"""Real scans carried to their noise and back: files, a table, a page."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.data.opening import open_scans
from r2flow.evaluation.sets import reading_of_flow
from r2flow.files import atomic_write
from r2flow.generators import Sampler, as_flow
from r2flow.inversion import TIGHT, Inversion, invert, round_trip
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.outputs import ScanBar
from r2flow.reports.pages import Page, prepare_folder
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.tables import print_table, table

COLUMNS = {
    "scan": "scan", "returns": "returns", "evaluations": "evaluations", "rms": "RMS, model space",
    "median_m": "median, m", "rms_m": "RMS, m", "dropped": "rays lost or gained", "noise_std": "std of x_0",
    "converged": "converged",
}  # fmt: skip
SHOWN = 4  # scans in the figure


class Real(NamedTuple):
    """A real scan as a flow sees it: its name, and its range in metres and reflectance, (2 or 1, H, W)."""

    name: str
    image: Tensor


def real_scans(
    checkpoint: Checkpoint, specs: Sequence[str | Path], reflectance_scale: float | None = None, most: int = 16
) -> list[Real]:
    """Scans as the checkpoint's flow sees them, projected as its training scans were.

    Args:
        specs: As for `r2flow.data.opening.open_scans`.
        reflectance_scale: The value in the files that means full reflectance; None for the one of the training.
        most: Scans to take of a set, evenly spread over it.

    Raises:
        InputError: a scan that cannot be read, has another size, or no reflectance where the flow needs it.
    """
    own, needed = reading_of_flow(checkpoint), checkpoint.encoding.reflectance
    scale = own.reflectance_scale if reflectance_scale is None else reflectance_scale
    reading = replace(own, reflectance=needed, reflectance_scale=scale, on_bad_scan="error", within_limits=True)
    sets = [open_scans(spec, reading).spread(most) for spec in specs]
    images = [torch.from_numpy(scans.source[i]) for scans in sets for i in range(len(scans))]
    names = unique_names([Path(name) for scans in sets for name in scans.source.names])
    return [Real(name, image) for name, image in zip(names, images, strict=True)]


def invert_scans(
    checkpoint: Checkpoint,
    scans: Sequence[Real],
    out: str | Path,
    sampler: Sampler = TIGHT,
    batch_size: int = 1,
    command: str = "",
) -> Page:
    """Write the noise of every scan as `out/NAME.x_0.npy`, float32 (C, H, W) in model space.

    Returns:
        The page of round-trip errors, still to be written.

    Raises:
        InputError: a solver that cannot be used, before anything is written.
    """
    as_flow(checkpoint.generator, "inversion").check_sampler(sampler)
    prepare_folder(out)
    rows: list[dict[str, Any]] = []
    titles: list[str] = []
    pictures: list[np.ndarray] = []
    evaluations = 2 * checkpoint.generator.evaluations_of(sampler) * -(-len(scans) // batch_size)
    with ScanBar("inverting", len(scans), evaluations) as bar:
        for first in range(0, len(scans), batch_size):
            names, batch = zip(*scans[first : first + batch_size], strict=True)
            images = torch.stack(batch)
            found = invert(checkpoint, images, sampler, bar.evaluated)
            for name, x_0 in zip(names, found.x_0.numpy(), strict=True):
                with atomic_write(Path(out, f"{name}.x_0.npy")) as file:
                    np.save(file, x_0)
            rows += errors_of(checkpoint, found, names, images)
            again = checkpoint.encoding.decode(found.again).nan_to_num(0.0)
            for name, image, back in zip(names, images.numpy(), again.numpy(), strict=True):
                titles += [f"{name}, real", "there and back"]
                pictures += [image, back]
            bar.finished(len(rows))
    figure = contact_sheet(pictures[: 2 * SHOWN], checkpoint.sensor.rays(), titles[: 2 * SHOWN])
    how = f"{sampler.steps} steps" if evaluations else f"tolerance {sampler.tolerance:g}"
    text = (
        f"{len(rows)} scans carried from t = 1 to their noise at t = 0 and back by {sampler.method}, {how}, through "
        f"the flow of {checkpoint.path.name}, step {checkpoint.step}. Metres are of the rays that return both times; "
        "rays lost or gained are a share of all. x_0 of a scan like those of the training has a standard deviation "
        "near 1.",
        table(rows, COLUMNS),
    )
    device = str(checkpoint.generator.device)
    return Page("invert", "Scans there and back", text, rows, {"invert": figure}, command, device=device)


def errors_of(checkpoint: Checkpoint, found: Inversion, names: Sequence[str], images: Tensor) -> list[dict[str, Any]]:
    """A row of `COLUMNS` for each scan."""
    errors = round_trip(checkpoint, found)
    return [
        {
            "scan": name,
            "returns": int((images[i, 0] > 0).sum()),
            "evaluations": int(found.evaluations[i]),
            **{key: float(values[i]) for key, values in errors.items()},
            "converged": bool(found.converged[i]),
        }
        for i, name in enumerate(names)
    ]


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Stems of the files, with a number where two share one."""
    stems = [path.name.split(".")[0].replace(" ", "_") for path in paths]
    return [
        stem if stems.count(stem) == 1 else f"{stem}_{stems[:index].count(stem) + 1}"
        for index, stem in enumerate(stems)
    ]


def print_rows(rows: Sequence[dict[str, Any]]) -> None:
    """Print the errors as a table, and the scans that were not solved."""
    headings = ("scan", "returns", "evals", "RMS", "med. m", "RMS m", "rays ±", "std x_0", "solved")
    print_table(rows, dict(zip(COLUMNS, headings, strict=True)))
    print("RMS in model space; rays ±: share of all rays lost or gained; std x_0: near 1 for scans like the training's")
    lost = [row["scan"] for row in rows if not row["converged"]]
    if lost:
        print(f"not solved, and their noise is NaN: {', '.join(lost)}. A larger --tolerance may do.")
