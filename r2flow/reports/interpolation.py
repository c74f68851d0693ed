"""Interpolation of two real scans in noise space: the paper's figure 3, and a point cloud per frame."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.data.sources import spread
from r2flow.generators import Sampler
from r2flow.inversion import interpolate_scans, round_trip
from r2flow.lidar.projection import write_scan
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.sampling import warn_unsolved
from r2flow.progress import Bar
from r2flow.reports.pages import Page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.tables import table
from r2flow.reports.view import Panel, most_images, write_page

ENDS = {
    "scan": "scan", "rms": "RMS, model space", "median_m": "median, m", "dropped": "rays lost or gained",
    "noise_std": "std of x_0", "converged": "converged",
}  # fmt: skip


def interpolation(
    checkpoint: Checkpoint, names: Sequence[str], pair: Tensor, frames: int, out: Path, sampler: Sampler
) -> Page:
    """Write `frames` scans between two (`real_scans`) as `out/frames/NNN.ply` and `.npy`; return the unwritten page."""
    rays = checkpoint.sensor.rays()
    with Bar("interpolating", frames, evaluations=frames * (sampler.evaluations(checkpoint.generator) or 0)) as bar:
        result = interpolate_scans(checkpoint, pair, frames, sampler, progress=bar.evaluated, arrived=bar.set)
    warn_unsolved(result.converged)
    images, weights = result.images.nan_to_num(0.0).numpy(), result.weights.tolist()
    rows = []
    for number, (weight, image) in enumerate(zip(weights, images, strict=True)):
        write_scan(image, rays, out / "frames", f"{number:03d}", ("ply", "npy"))
        rows.append({
            "frame": number, "weight": weight, "returns": int((image[0] > 0).sum()),
            "evaluations": int(result.evaluations[number]), "converged": bool(result.converged[number]),
        })  # fmt: skip
    errors = round_trip(checkpoint, result.ends) | {"converged": result.ends.converged}
    ends_rows = [{"scan": name} | {key: errors[key][i].item() for key in errors} for i, name in enumerate(names)]
    text = (
        f"The flow of {checkpoint.path.name}, step {checkpoint.step}, inverted both scans to noise and generated the "
        "frames from spherical interpolations (slerp) of it. The first and last frames are round trips of the scans; "
        "their evaluations include both directions.",
        table(ends_rows, ENDS),
        table(rows, {"frame": "frame", "weight": "w"} | {key: key for key in ("returns", "evaluations", "converged")}),
    )
    first, last = (Panel(f"real: {name}", image[None], rays) for name, image in zip(names, pair.numpy(), strict=True))
    chosen = spread(len(images), most_images(images.shape) - 2)
    captions = [f"w = {weights[i]:.2f}" for i in chosen]
    panels = [first, Panel("between", images[chosen], rays, None, captions), last]
    write_page(out / "interpolation.html", panels, "Interpolation")
    figures = {"interpolation": interpolation_figure(pair.numpy(), images, weights, rays, names)}
    return Page("interpolation", "Interpolation", text, rows, figures, device=str(checkpoint.generator.device))


def interpolation_figure(
    real: np.ndarray, frames: np.ndarray, weights: Sequence[float], rays: Tensor, names: Sequence[str]
) -> Figure:
    """Contact sheet of the real scans and the frames between them; the first and last frame are round trips."""
    last = len(frames) - 1
    chosen = sorted({round(i) for i in np.linspace(0, last, 8)})
    between = {i: "round trip" if i in (0, last) else f"w = {weights[i]:.2f}" for i in chosen}
    titles = [f"real: {names[0]}", *between.values(), f"real: {names[1]}"]
    return contact_sheet([real[0], *frames[chosen], real[1]], rays, titles)
