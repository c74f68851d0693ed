"""Interpolation of two real scans in noise space: the paper's figure 3, and a point cloud per
frame.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from numpy import ndarray
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
from r2flow.reports.view import Panel, most_images, write_viewer


def interpolation(
    checkpoint: Checkpoint,
    names: Sequence[str],
    pair: Tensor,
    frames: int,
    out: Path,
    sampler: Sampler,
) -> Page:
    """Write `frames` scans between two as `out/frames/NNN.ply` and `.npy`; return the unwritten
    page.
    """
    rays = checkpoint.sensor.rays()
    evaluations = frames * (sampler.evaluations(checkpoint.generator) or 0)
    with Bar("interpolating", frames, evaluations=evaluations) as bar:
        how: Any = {"progress": bar.evaluated, "arrived": bar.set}
        result = interpolate_scans(checkpoint, pair, frames, sampler, **how)
    warn_unsolved(result.converged)
    images = result.images.nan_to_num(0.0).numpy()
    weights = result.weights.tolist()
    rows = []
    for number, image in enumerate(images):
        write_scan(image, rays, out / "frames", f"{number:03d}", ("ply", "npy"))
        row = {
            "frame": number,
            "weight": weights[number],
            "returns": int((image[0] > 0).sum()),
            "evaluations": int(result.evaluations[number]),
            "converged": bool(result.converged[number]),
        }
        rows.append(row)
    errors = round_trip(checkpoint, result.ends)
    off = ", ".join(f"{error:.2g} m" for error in errors["median_m"].tolist())
    text = [
        f"The flow of {checkpoint.path.name}, step {checkpoint.step}, inverted both scans to noise "
        "and generated the "
        "frames from spherical interpolations (slerp) of it. The first and last frames are round "
        "trips of the scans "
        f"(median error of the range {off}); their evaluations include both directions.",
        table(rows, {key: key for key in rows[0]}),
    ]
    real = pair.numpy()
    first, last = (
        Panel(f"real: {name}", image[None], rays) for name, image in zip(names, real, strict=True)
    )
    chosen = spread(len(images), most_images(images.shape) - 2)
    captions = [f"w = {weights[number]:.2f}" for number in chosen]
    panels = [first, Panel("between", images[chosen], rays, None, captions), last]
    write_viewer(out / "interpolation.html", panels, "Interpolation")
    figures = {"interpolation": _interpolation_figure(real, images, weights, rays, names)}
    return Page(
        "interpolation",
        "Interpolation",
        text,
        rows,
        figures,
        device=str(checkpoint.generator.device),
    )


def _interpolation_figure(
    real: ndarray,
    frames: ndarray,
    weights: Sequence[float],
    rays: Tensor,
    names: Sequence[str],
) -> Figure:
    """Contact sheet of the real scans and the frames between them; the first and last frame are
    round trips.
    """
    chosen = spread(len(frames), 8)
    between = [f"w = {weights[number]:.2f}" for number in chosen]
    titles = [f"real: {names[0]}", *between, f"real: {names[1]}"]
    return contact_sheet([real[0], *frames[chosen], real[1]], rays, titles)
