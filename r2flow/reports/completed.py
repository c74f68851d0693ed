"""Completed scans as files and pictures."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2flow import noise
from r2flow.checkpoints import Checkpoint, weights_hash
from r2flow.completion import Completed, complete
from r2flow.data.opening import SAMPLES
from r2flow.data.partial import PartialScan
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.generators import Sampler
from r2flow.lidar.known import Mask, Ray
from r2flow.lidar.projection import image_to_points, unproject
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.transfer import Partial
from r2flow.reports.outputs import ScanBar, keep_note, warn_unsolved
from r2flow.reports.pictures import (
    BACKGROUND,
    FOREGROUND,
    dark_figure,
    draw_birds_eye,
    draw_perspective,
    draw_range,
    draw_reflectance,
    draw_values,
    save_figure,
)
from r2flow.reports.view import most_images, write_page

WRITTEN = (".bin", ".pcd", ".ply", ".npy")  # formats that answers are written in; others become .ply
SHOWN = 4  # answers on a page


@dataclass(frozen=True)
class Job:
    """What is asked of the scans.

    Attributes:
        num: Answers to each scan.
        keep: As in `r2flow.completion.complete`.
        mask: Of the measured rays of each scan those that are kept; None for all.
    """

    num: int = 1
    seed: int = 0
    keep: str = "exact"
    mask: Mask | None = None
    batch_size: int = 1


@dataclass(frozen=True)
class Error:
    """Distance of answers from the rays of a scan that a mask has hidden, the mean over the answers.

    Attributes:
        rays: Hidden rays of the scan.
        mae: Mean absolute error of the range in metres over them, 0 m standing for no return.
        both: The same over those that have a return in the scan and in the answer; NaN without any.
        wrong: Share of the hidden rays that have a return in the scan or in the answer alone.
    """

    rays: int
    mae: float
    both: float
    wrong: float


def write_completed(
    checkpoint: Checkpoint,
    scans: Sequence[PartialScan],
    out: Path,
    job: Job,
    sampler: Sampler,
    about: Mapping[str, Any],
) -> dict[str, Error | None]:
    """Complete scans and write their answers, the spread between these, a picture and a page in 3-D of each.

    A scan whose files are all there is finished and passed over. Its picture is written last.

    Args:
        about: What else decides the answers, as plain values, by which a folder is told from another.

    Returns:
        The scans that were completed now, by name, with their errors where a mask has hidden some of their rays.

    Raises:
        InputError: a folder that holds other answers, or a scan that cannot be completed.
    """
    asked = {"num": job.num, "seed": job.seed, "keep": job.keep, "weights": weights_hash(checkpoint), **about}
    settings = {**asked, "sampler": sampler.asdict()}
    _refuse_others(out, settings)
    left = [(number, scan) for number, scan in enumerate(scans) if not _picture(scan, out).is_file()]
    inputs = {scan.path.resolve() for scan in scans if scan.path}
    for _, scan in left:
        for path in answer_files(checkpoint, scan, out, job.num):
            if path.resolve() in inputs:
                raise InputError(f"{path} is one of the scans and would be replaced; give another --out.")
    found: dict[str, Error | None] = {}
    batches = math.ceil(job.num / job.batch_size) * checkpoint.generator.evaluations_of(sampler)
    with ScanBar("completing", len(left), len(left) * batches) as bar:
        for number, scan in left:
            whole = scan.read()
            given = masked(whole, job.mask, number, job.seed, scan.name)
            images, state = torch.from_numpy(given.image)[None], torch.from_numpy(given.state)[None]
            (made,) = complete(
                checkpoint, images, state, job.num, job.seed, keep=job.keep, sampler=sampler,
                batch_size=job.batch_size, first=number, progress=bar.evaluated,
            )  # fmt: skip
            if not found:  # the first answer shows that the settings can be used
                keep_note(checkpoint, out, **{**sampler.asdict(), "seed": job.seed}, **{"completion": settings})
            warn_unsolved(made.converged)
            _write(checkpoint, scan, out, given, made, job, whole if job.mask else None)
            found[scan.name] = hidden_error(whole, given, made.images) if job.mask else None
            bar.finished(len(found))
    return found


def masked(scan: Partial, mask: Mask | None, number: int, seed: int, name: str) -> Partial:
    """A scan of which a mask keeps a part; that of scan `number` is a function of (seed, number).

    Raises:
        InputError: nothing is kept, or all.
    """
    if mask is None:
        return scan
    kept = torch.from_numpy(mask(scan.state.shape, noise.generator(seed, "condition", number))).numpy()  # type: ignore[arg-type]
    measured = scan.state != Ray.UNKNOWN
    for wrong, what in ((not (measured & kept).any(), "nothing"), (not (measured & ~kept).any(), "everything")):
        if wrong:
            raise InputError(f"{name}: the mask keeps {what} that was measured; give another --mask.")
    state = np.where(kept, scan.state, int(Ray.UNKNOWN)).astype(np.uint8)
    xyz = None if scan.xyz is None else scan.xyz * kept
    return Partial(scan.image * kept, state, xyz, scan.outside)


def hidden_error(whole: Partial, given: Partial, answers: torch.Tensor) -> Error:
    """How far answers, (num, 2 or 1, H, W), are from what a mask has hidden of a scan."""
    hidden = (whole.state != Ray.UNKNOWN) & (given.state == Ray.UNKNOWN)
    truth, found = whole.image[0][hidden].astype(np.float64), answers[:, 0].numpy()[:, hidden].astype(np.float64)
    apart = np.abs(found - truth)
    both = (found > 0) & (truth > 0)
    return Error(
        int(hidden.sum()), float(apart.mean()), float(apart[both].mean()) if both.any() else math.nan,
        float(((found > 0) != (truth > 0)).mean()),
    )  # fmt: skip


def answer_ending(checkpoint: Checkpoint, scan: PartialScan) -> str:
    """The format of a scan's answers: its own, or .ply where that is not written or needs what the model lacks."""
    if scan.ending not in WRITTEN or (scan.ending == ".bin" and not checkpoint.encoding.reflectance):
        return ".ply"
    return scan.ending


def answer_files(checkpoint: Checkpoint, scan: PartialScan, out: Path, num: int) -> list[Path]:
    """The files of a scan's answers."""
    ending, digits = answer_ending(checkpoint, scan), len(str(num - 1))
    numbers = [""] if num == 1 else [f"_{answer:0{digits}d}" for answer in range(num)]
    return [out / f"{scan.name}{number}{ending}" for number in numbers]


def _picture(scan: PartialScan, out: Path) -> Path:
    return out / f"{scan.name}.png"


def _refuse_others(out: Path, settings: Mapping[str, Any]) -> None:
    note = out / SAMPLES
    if not note.exists():
        return
    try:
        there = json.loads(note.read_text(encoding="utf-8")).get("completion")
    except (ValueError, AttributeError):
        there = None
    ours = json.loads(json.dumps(settings))
    if there is None:
        raise InputError(f"{out} holds other scans than completed ones (its {SAMPLES} says so); give another --out.")
    wrong = next((key for key in ours if there.get(key) != ours[key]), None)
    if wrong is not None:
        found, asked = (json.dumps(one) for one in (there.get(wrong), ours[wrong]))
        raise InputError(f"{out} holds scans that were completed with {wrong} {found}, not {asked}; give another --out.")


def _write(
    checkpoint: Checkpoint,
    scan: PartialScan,
    out: Path,
    given: Partial,
    made: Completed,
    job: Job,
    truth: Partial | None,
) -> None:
    rays = checkpoint.sensor.rays()
    kept = given.xyz if job.keep == "exact" else None
    for path, image in zip(answer_files(checkpoint, scan, out, job.num), made.images.numpy(), strict=True):
        if path.suffix == ".npy" and scan.path is None or path.suffix == ".npy" and given.xyz is None:
            with atomic_write(path) as file:
                np.save(file, image)
        else:
            write_points(path, *_cloud(image, rays, given, kept))
    if job.num > 1:
        deviation, returned = made.spread.numpy()
        with atomic_write(out / f"{scan.name}.spread.npz") as file:
            np.savez_compressed(file, deviation=deviation, returned=returned)
    rows = [("what is known", given.image), ("an answer", made.images[0].numpy())]
    rows += [("another answer", made.images[1].numpy())] if job.num > 1 else []
    rows += [("the whole scan", truth.image)] if truth else []
    more = [(f"answer {number}", image) for number, image in enumerate(made.images[:SHOWN].numpy())]
    seen = [rows[0], *more, *rows[-1:]] if truth else [rows[0], *more]
    seen = seen[: most_images(rays.shape)]
    stem = _picture(scan, out)
    captions, images = [f"{scan.name}: {said}" for said, _ in seen], [image for _, image in seen]
    write_page(stem.with_suffix(".html"), images, rays, captions, title=scan.name)
    save_figure(completed_figure(rows, given.state, made if job.num > 1 else None, rays, scan.name), stem)


def _cloud(
    image: np.ndarray, rays: torch.Tensor, given: Partial, kept: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Points of an answer: measured ones where they were, the others along the middles of the pixels."""
    xyz = unproject(torch.from_numpy(image[None, :1]), rays)[0].numpy()
    if kept is not None:
        xyz = np.where(given.state == Ray.RETURN, kept, xyz)
    returned = image[0] > 0
    points = np.ascontiguousarray(xyz[:, returned].T)
    return points, np.ascontiguousarray(image[1][returned]) if len(image) > 1 else None
