"""Generated scans as files and pictures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.files import atomic_write
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
        InputError: an unknown format, or `bin` from a model without reflectance.
    """
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"no output format named {name!r}; known: {', '.join(FORMATS)}.")
    if not checkpoint.encoding.reflectance and "bin" in formats:
        raise InputError("a KITTI .bin holds reflectance and this model has none; use --format ply,npy.")
    out, rays = Path(out), checkpoint.sensor.rays()
    shown: list[np.ndarray] = []
    columns = TextColumn("sampling"), BarColumn(), MofNCompleteColumn(), TextColumn("scans"), TimeRemainingColumn()
    with Progress(*columns) as bar:
        task = bar.add_task("scans", total=num)
        evaluations = steps * batches(num, batch_size)
        for drawn in sample(
            checkpoint, num, steps, seed, method, tolerance, batch_size,
            progress=lambda: bar.advance(task, num / evaluations if method == "euler" else 0),
        ):  # fmt: skip
            for offset, image in enumerate(drawn.images.numpy()):
                write_scan(image, rays, out, f"{drawn.first + offset:06d}", formats)
                if len(shown) < pictures:
                    shown.append(image)
            bar.update(task, completed=min(drawn.first + batch_size, num))
    if shown:
        draw_pages(shown, rays, out)
    return shown


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

    for index, image in enumerate(images):
        save_figure(scan_figure(image, rays, f"sample {index}"), out / f"{index:06d}.png")
    return save_figure(contact_sheet(images[:8], rays), out / "samples.png")
