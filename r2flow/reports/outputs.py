"""Generated scans as files and pictures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
    track,
)
from rich.text import Text
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.flow.solvers import SOLVERS
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.sampling import batches, sample

FORMATS = ("ply", "bin", "npy")


def write_samples(
    checkpoint: Checkpoint,
    out: str | Path,
    num: int,
    steps: int,
    seed: int,
    method: str = "euler",
    formats: Sequence[str] = FORMATS,
    pictures: int = 8,
    batch_size: int = 1,
    tolerance: float = 1e-5,
) -> list[np.ndarray]:
    """Draw scans and write each as `out/NNNNNN.FORMAT`, with a page and a contact sheet of the first ones.

    Scan i of a seed is the same whatever `num` and `batch_size` are.

    Args:
        formats: `ply` and `bin` are points in metres with reflectance, `npy` the range image,
            float32 (2 or 1, H, W) in metres and reflectance.
        pictures: How many scans get a page of their own; the contact sheet shows at most 8 of them.

    Returns:
        The images drawn as pictures.

    Raises:
        InputError: an unknown format, `bin` from a model without reflectance, or nothing to draw.
    """
    if num < 1 or steps < 1 or batch_size < 1:
        raise InputError(f"needs at least one scan, step and scan a batch; found {num}, {steps} and {batch_size}.")
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"no output format named {name!r}; known: {', '.join(FORMATS)}.")
    if not checkpoint.encoding.reflectance and "bin" in formats:
        raise InputError("a KITTI .bin holds reflectance and this model has none; use --format ply,npy.")
    out, rays = Path(out), checkpoint.sensor.rays()
    shown: list[np.ndarray] = []
    # Between two finished scans the bar moves with the evaluations, whose number a fixed-step method knows.
    per_step = SOLVERS[method].evaluations if method in SOLVERS else 0
    share = num / (per_step * steps * batches(num, batch_size)) if per_step else 0.0
    columns = (BarColumn(), MofNCompleteColumn(), TextColumn("scans"), ScansPerSecond(), TimeRemainingColumn())
    with Progress(TextColumn("sampling"), *columns) as bar:
        task = bar.add_task("scans", total=num)
        for drawn in sample(
            checkpoint, num, steps, seed, method, tolerance, batch_size,
            progress=lambda: bar.advance(task, share),
        ):  # fmt: skip
            for offset, image in enumerate(drawn.images.numpy()):
                write_scan(image, rays, out, f"{drawn.first + offset:06d}", formats)
                if len(shown) < pictures:
                    shown.append(image)
            bar.update(task, completed=min(drawn.first + batch_size, num))
    if shown:
        draw_pages(shown, rays, out)
    return shown


class ScansPerSecond(ProgressColumn):
    """How fast it goes, once that can be told."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.2f} scans/s" if speed else "")


def write_scan(image: np.ndarray, rays: Tensor, out: Path, name: str, formats: Sequence[str]) -> None:
    """One range image in every format asked for."""
    xyz, reflectance = image_to_points(image, rays)
    for ending in formats:
        path = out / f"{name}.{ending}"
        if ending == "npy":
            with atomic_write(path) as file:
                np.save(file, image)
        else:
            write_points(path, xyz, reflectance if len(image) > 1 else None)


def draw_pages(images: Sequence[np.ndarray], rays: Tensor, out: Path) -> Path:
    """A page for each image and `samples.png`, the contact sheet of the first 8."""
    from r2flow.reports.pictures import contact_sheet, save_figure, scan_figure

    numbered = list(enumerate(images))
    for index, image in track(numbered, "drawing", disable=len(numbered) < 3, transient=True):
        save_figure(scan_figure(image, rays, f"sample {index}"), out / f"{index:06d}.png")
    return save_figure(contact_sheet(images[:8], rays), out / "samples.png")
