"""Interpolation of two real scans in noise space: the paper's figure 3, and a point cloud per
frame.
"""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from r2flow.base.progress import Bar
from r2flow.data.sources import spread
from r2flow.generators import Sampler
from r2flow.lidar.projection import write_scan
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.inversion import interpolate_scans, metres_apart
from r2flow.model.sampling import warn_unsolved
from r2flow.reports.pages import Page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.tables import Part, Table
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
        result = interpolate_scans(
            checkpoint, pair, frames, sampler, progress=bar.evaluated, arrived=bar.set
        )
    warn_unsolved(result.converged)
    images = result.images.nan_to_num(0.0).numpy()
    rows = []
    for number, image in enumerate(images):
        write_scan(image, rays, out / "frames", f"{number:03d}", ("ply", "npy"))
        row = {
            "frame": number,
            "weight": float(result.weights[number]),
            "returns": int((image[0] > 0).sum()),
            "evaluations": int(result.evaluations[number]),
            "converged": bool(result.converged[number]),
        }
        rows.append(row)
    decode = checkpoint.encoding.decode
    errors, _, _ = metres_apart(decode(result.ends.x_1), decode(result.ends.again))
    off = ", ".join(f"{error:.2g} m" for error in errors.tolist())
    text: list[Part] = [
        f"The flow of {checkpoint.path.name}, step {checkpoint.step}, inverted both scans to noise "
        "and generated the frames from spherical interpolations (slerp) of it. The first and last "
        f"frames are round trips of the scans (median error of the range {off}); their evaluations "
        "include both directions.",
        Table(rows, {key: key for key in rows[0]}),
    ]
    captions = [f"w = {row['weight']:.2f}" for row in rows]
    first, last = (f"real: {name}" for name in names)
    real = pair.numpy()
    kept = spread(len(images), most_images(images.shape) - 2)
    panels = [
        Panel(first, real[:1], rays),
        Panel("between", images[kept], rays, frames=[captions[number] for number in kept]),
        Panel(last, real[1:], rays),
    ]
    write_viewer(out / "interpolation.html", panels, "Interpolation")
    drawn = spread(len(images), 8)
    sheet = [real[0], *images[drawn], real[1]]
    titles = [first, *(captions[number] for number in drawn), last]
    figures = {"interpolation": contact_sheet(sheet, rays, titles)}
    device = str(checkpoint.generator.device)
    return Page("interpolation", "Interpolation", text, rows, figures, device=device)
