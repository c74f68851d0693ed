"""Interpolation of two real scans in noise space: the paper's figure 3, and a point cloud per frame."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.data.sources import spread
from r2flow.generators import Sampler
from r2flow.inversion import TIGHT, Real, interpolate_scans, round_trip
from r2flow.lidar.projection import image_to_points, write_scan
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.sampling import warn_unsolved
from r2flow.reports.outputs import ScanBar
from r2flow.reports.pages import Page
from r2flow.reports.pictures import draw_birds_eye, draw_perspective, draw_range, draw_reflectance
from r2flow.reports.tables import table
from r2flow.reports.view import Panel, most_images, write_page

MOST = 8  # maximum number of frames in the figure, evenly spaced
# Rows: points, then images.
PANELS = {
    "perspective": draw_perspective, "bird's-eye view": draw_birds_eye, "range": draw_range,
    "reflectance": draw_reflectance,
}  # fmt: skip
REAL = "#c2410c"
BETWEEN = {"frame": "frame", "weight": "w"} | {key: key for key in ("returns", "evaluations", "converged")}
ENDS = {
    "scan": "scan", "rms": "RMS, model space", "median_m": "median, m", "dropped": "rays lost or gained",
    "noise_std": "std of x_0", "converged": "converged",
}  # fmt: skip


def interpolation(
    checkpoint: Checkpoint,
    scans: Sequence[Real],
    frames: int,
    out: str | Path,
    sampler: Sampler = TIGHT,
) -> Page:
    """Write `frames` interpolated scans as `out/frames/NNN.ply` and `.npy`; return the page, not yet written."""
    pair, names, rays = torch.stack([scan.image for scan in scans]), [s.name for s in scans], checkpoint.sensor.rays()
    with ScanBar("interpolating", frames, frames * (sampler.evaluations(checkpoint.generator) or 0)) as bar:
        result = interpolate_scans(checkpoint, pair, frames, sampler, progress=bar.evaluated, arrived=bar.set)
    warn_unsolved(result.converged)
    images, weights = result.images.nan_to_num(0.0).numpy(), result.weights.tolist()
    rows = []
    for number, (weight, image) in enumerate(zip(weights, images, strict=True)):
        write_scan(image, rays, Path(out, "frames"), f"{number:03d}", ("ply", "npy"))
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
        table(rows, BETWEEN),
    )
    first, last = (Panel(f"real: {name}", image[None], rays) for name, image in zip(names, pair.numpy(), strict=True))
    chosen = spread(len(images), most_images(images.shape) - 2)
    captions = [f"w = {weights[i]:.2f}" for i in chosen]
    panels = [first, Panel("between", images[chosen], rays, None, captions), last]
    write_page(Path(out, "interpolation.html"), panels, "Interpolation")
    figures = {"interpolation": interpolation_figure(pair.numpy(), images, weights, rays, names)}
    return Page("interpolation", "Interpolation", text, rows, figures, device=str(checkpoint.generator.device))


def interpolation_figure(
    real: np.ndarray, frames: np.ndarray, weights: Sequence[float], rays: Tensor, names: Sequence[str]
) -> Figure:
    """Figure with the real scans as outer columns and frames in between; perspective, bird's-eye view and images.

    The first and last frames are round trips of the real scans.
    """
    last = len(frames) - 1
    chosen = sorted({round(i) for i in np.linspace(0, last, MOST)})
    between = [("round trip" if i in (0, last) else f"w = {weights[i]:.2f}", frames[i]) for i in chosen]
    columns = [(f"real: {names[0]}", real[0]), *between, (f"real: {names[1]}", real[1])]
    heights = [1.15, 1.6, *[0.5] * real.shape[1]]
    figure = Figure((1.4 * len(columns), 0.9 * sum(heights) + 0.4), facecolor="white")
    figure.set_layout_engine("constrained", hspace=0.02, wspace=0.02)
    panels = figure.subplots(len(heights), len(columns), squeeze=False, height_ratios=heights)
    for place, (title, image) in enumerate(columns):
        xyz, _ = image_to_points(image, rays)
        colour = REAL if place in (0, len(columns) - 1) else "black"
        for axes, (name, draw) in zip(panels[:, place], PANELS.items(), strict=False):
            draw(axes, xyz if name in ("perspective", "bird's-eye view") else image, label=False)
            if place == 0:
                axes.set_ylabel(name, fontsize=7)
            if colour == REAL:
                axes.spines[:].set(visible=True, color=REAL, linewidth=1.2)
        panels[0, place].set_title(title, color=colour, fontsize=7, pad=3)
    return figure
