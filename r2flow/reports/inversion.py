"""Real scans carried to their noise and back: files, a table, a page."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from r2flow.data.opening import open_scans, reading_for
from r2flow.inversion import Inversion, round_trip
from r2flow.model.checkpoint import Checkpoint

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
    own, needed = reading_for([], checkpoint), checkpoint.encoding.reflectance
    scale = own.reflectance_scale if reflectance_scale is None else reflectance_scale
    reading = replace(own, reflectance=needed, reflectance_scale=scale, on_bad_scan="error", within_limits=True)
    sets = [open_scans(spec, reading).spread(most) for spec in specs]
    images = [torch.from_numpy(scans.source[i]) for scans in sets for i in range(len(scans))]
    names = unique_names([Path(name) for scans in sets for name in scans.source.names])
    return [Real(name, image) for name, image in zip(names, images, strict=True)]


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
