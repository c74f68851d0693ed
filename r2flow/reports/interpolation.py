"""From one real scan to another through the noise: the paper's figure 3, and a point cloud for every frame."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.generators import Sampler, as_flow
from r2flow.inversion import TIGHT, interpolate_scans
from r2flow.reports.inversion import Real, errors_of
from r2flow.reports.outputs import ScanBar, formats_of, write_scan
from r2flow.reports.pages import Page, prepare_folder
from r2flow.reports.tables import table

log = logging.getLogger(__name__)

MOST = 8  # frames in the figure, evenly chosen


def interpolation(
    checkpoint: Checkpoint,
    scans: Sequence[Real],
    frames: int,
    out: str | Path,
    sampler: Sampler = TIGHT,
    batch_size: int = 1,
    command: str = "",
) -> Page:
    """Write `frames` scans on the way from one scan to another as `out/frames/NNN.ply` and `.npy`.

    Returns:
        The page with the figure, still to be written.

    Raises:
        InputError: a scan or a solver that cannot be used, before anything is written; a scan without its noise.
    """
    as_flow(checkpoint.generator, "interpolation").check_sampler(sampler)
    if len(scans) != 2:
        raise InputError(f"needs the two scans to go between, found {len(scans)}; name two files.")
    pair = torch.stack([scan.image for scan in scans])
    prepare_folder(out)
    names = [scan.name for scan in scans]
    rays = checkpoint.sensor.rays()
    # both ends go there and back
    with ScanBar("interpolating", frames, (frames + 2) * checkpoint.generator.evaluations_of(sampler)) as bar:
        found = interpolate_scans(checkpoint, pair, frames, sampler, batch_size, bar.evaluated, bar.finished)
    lost = [number for number, solved in enumerate(found.converged.tolist()) if not solved]
    if lost:
        log.warning("not solved, and no scans of this flow: %s; try another solver.", ", ".join(map(str, lost)))
    images = found.images.nan_to_num(0.0).numpy()
    rows = []
    for number, (weight, image) in enumerate(zip(found.weights.tolist(), images, strict=True)):
        write_scan(image, rays, Path(out, "frames"), f"{number:03d}", [f for f in formats_of(checkpoint) if f != "bin"])
        returns = int((image[0] > 0).sum())
        evaluations = int(found.evaluations[number])
        row = {"frame": number, "weight": weight, "returns": returns, "evaluations": evaluations}
        rows.append({**row, "converged": bool(found.converged[number])})
    ends = errors_of(checkpoint, found.ends, names, pair)
    figure = interpolation_figure(pair.numpy(), images, found.weights.tolist(), rays, names)
    return _page(checkpoint, rows, ends, figure, command)


def interpolation_figure(
    real: np.ndarray, frames: np.ndarray, weights: Sequence[float], rays: Tensor, names: Sequence[str]
) -> Any:
    """Columns from one real scan over the frames between to the other; perspective, bird's-eye view and images.

    Args:
        real: The two scans, (2, 2 or 1, H, W), in metres.
        frames: Scans on the way, (N, 2 or 1, H, W); the first and the last are the real ones' round trips.
        weights: Of the frames, (N,).
        names: Of the real scans.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from r2flow.reports.pictures import BACKGROUND

    chosen = sorted({round(i * (len(frames) - 1) / (MOST - 1)) for i in range(MOST)}) if len(frames) > MOST else None
    chosen = chosen or list(range(len(frames)))
    columns = [(f"real: {names[0]}", real[0])]
    columns += [(_title(index, weights), frames[index]) for index in chosen]
    columns += [(f"real: {names[1]}", real[1])]
    heights = [1.15, 1.6, *[0.5] * real.shape[1]]
    width, height = 2.45 * len(columns), 1.55 * sum(heights) + 0.75
    figure = Figure(figsize=(width, height), facecolor=BACKGROUND)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(
        len(heights), len(columns), height_ratios=heights, hspace=0.05, wspace=0.04,
        left=0.35 / width, right=1 - 0.08 / width, top=1 - 0.62 / height, bottom=0.08 / height,
    )  # fmt: skip
    for place, (title, image) in enumerate(columns):
        _draw_column(figure, grid, place, title, image, rays, real=place in (0, len(columns) - 1))
    _bracket(figure, grid, 1, 1, "inversion")
    _bracket(figure, grid, 2, len(columns) - 3, "slerp between the two noises")
    _bracket(figure, grid, len(columns) - 2, len(columns) - 2, "inversion")
    return figure


def _title(index: int, weights: Sequence[float]) -> str:
    return "there and back" if index in (0, len(weights) - 1) else f"w = {weights[index]:.2f}"


def _draw_column(figure: Any, grid: Any, place: int, title: str, image: np.ndarray, rays: Tensor, real: bool) -> None:
    from r2flow.lidar.projection import image_to_points
    from r2flow.reports.pictures import FOREGROUND, draw_birds_eye, draw_perspective, draw_range, draw_reflectance

    xyz, _ = image_to_points(image, rays)
    panels: list[tuple[str, Any]] = [
        ("perspective", lambda axes: draw_perspective(axes, xyz, label=False)),
        ("bird's-eye view", lambda axes: draw_birds_eye(axes, xyz, label=False)),
        ("range", lambda axes: draw_range(axes, image, label=False)),
        ("reflectance", lambda axes: draw_reflectance(axes, image, label=False)),
    ]
    for row, (name, draw) in enumerate(panels[: 2 + len(image)]):
        axes = figure.add_subplot(grid[row, place])
        draw(axes)
        if row == 0:
            axes.set_title(title, color="#ffd479" if real else FOREGROUND, fontsize=9, pad=4)
        if place == 0:
            axes.set_ylabel(name, color=FOREGROUND, fontsize=8)
        if real:
            for spine in axes.spines.values():
                spine.set(visible=True, color="#ffd479", linewidth=1.2)


def _bracket(figure: Any, grid: Any, first: int, last: int, text: str) -> None:
    """A line over the columns first to last, and what they have in common."""
    from r2flow.reports.pictures import FOREGROUND

    if last < first:
        return
    left, right = (grid[0, place].get_position(figure) for place in (first, last))
    y = 1 - 0.3 / figure.get_figheight()
    inset = 0.08 / figure.get_figwidth()
    figure.add_artist(_line([left.x0 + inset, right.x1 - inset], [y, y], FOREGROUND))
    figure.text((left.x0 + right.x1) / 2, y, text, color=FOREGROUND, fontsize=9, ha="center", va="bottom")


def _line(x: Sequence[float], y: Sequence[float], colour: str) -> Any:
    from matplotlib.lines import Line2D

    return Line2D(x, y, color=colour, linewidth=0.8)


def _page(
    checkpoint: Checkpoint, rows: Sequence[dict[str, Any]], ends: Sequence[dict[str, Any]], figure: Any, command: str
) -> Page:
    between = {"frame": "frame", "weight": "w"} | {key: key for key in ("returns", "evaluations", "converged")}
    of_ends = {"scan": "scan", "rms": "RMS, model space", "median_m": "median, m", "dropped": "rays lost or gained"}
    text = (
        f"Both scans were carried to their noise by the flow of {checkpoint.path.name}, step {checkpoint.step}; frames "
        "come from the spherical interpolation (slerp) of the two. The first and the last frame are the scans' round "
        "trips; their evaluations are those of both ways.",
        table(ends, {**of_ends, "noise_std": "std of x_0", "converged": "converged"}),
        table(rows, between),
    )
    device = str(checkpoint.generator.device)
    return Page("interpolation", "From scan to scan", text, rows, {"interpolation": figure}, command, device=device)
