"""Completed scans as files and pictures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2flow import noise
from r2flow.data.partial import PartialScan
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Mask, Ray, share_in_sectors
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.transfer import Partial
from r2flow.metrics.completion import common_mae
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import Completed, complete
from r2flow.models import DEFAULT, DENSIFY
from r2flow.progress import track
from r2flow.reports.outputs import ScanBar, recipe_of, warn_unsolved
from r2flow.reports.pictures import completed_figure, save_figure
from r2flow.reports.view import write_page
from r2flow.store import Store, read_manifest

WRITTEN = (".bin", ".pcd", ".ply", ".npy")  # formats that answers are written in; others become .ply
SHOWN = 4  # answers on a page


@dataclass(frozen=True)
class Job:
    """How scans are completed.

    Attributes:
        num: Answers to each scan.
        mask: Of the measured rays of each scan those that are kept; None for all.
        fill_gaps: Whether rays without a return count as not measured.
        pictures: How many scans get a picture and a page in 3-D.
    """

    num: int = 1
    seed: int = 0
    mask: Mask | None = None
    fill_gaps: bool = False
    batch_size: int = 1
    pictures: int = 8
    precision: Precision = "32-true"


def write_completed(
    checkpoint: Checkpoint,
    scans: Sequence[PartialScan],
    out: Path,
    job: Job,
    sampler: Sampler,
    about: Mapping[str, Any],
) -> dict[str, np.ndarray | None]:
    """Complete scans and write their answers, the spread between these, pictures and pages in 3-D.

    Scans whose answers are all in the folder are skipped.

    Args:
        about: What else decides the answers, as plain values.

    Returns:
        The scans that were completed now, by name, with their `hidden_errors` where a mask has hidden some of their
        rays, else None.

    Raises:
        InputError: a folder that holds other files or answers, or a scan that cannot be completed.
    """
    files = {scan.name: answer_files(checkpoint, scan, out, job.num) for scan in scans}
    for scan in scans:
        if scan.path and (out / scan.name).resolve().parent == scan.path.resolve().parent:
            raise InputError(f"{out} is the folder of the scans; give another --out.")
    settings = {
        "num": job.num, "fill_gaps": job.fill_gaps,
        **about, "precision": job.precision,
    }  # fmt: skip
    store = Store(out, "answers", recipe_of(checkpoint, job.seed, {"completion": settings}, **sampler.asdict()))
    inputs = _inputs(store, {scan.name: scan.identity() for scan in scans}, files)
    left = [number for number, scan in enumerate(scans) if not all(path.is_file() for path in files[scan.name])]
    done: dict[str, np.ndarray | None] = {}
    batches = math.ceil(job.num / job.batch_size) * (sampler.evaluations(checkpoint.generator) or 0)
    with ScanBar("completing", len(left) * job.num, len(left) * batches, "answers") as bar:
        for number in left:
            scan = scans[number]
            whole, given = hiding(scan, job, number)
            images, state = torch.from_numpy(given.image)[None], torch.from_numpy(given.state)[None]
            (completed,) = complete(
                checkpoint, images, state, job.num, job.seed, sampler=sampler, batch_size=job.batch_size, first=number,
                precision=job.precision, progress=bar.evaluated,
            )  # fmt: skip
            if not done:  # the first answer shows that the settings can be used
                store.write_manifest(inputs=inputs)
            warn_unsolved(completed.converged)
            if number < job.pictures:
                _draw(checkpoint, scan, out, given, completed, whole if job.mask else None)
            _write(checkpoint, scan, out, files[scan.name], given, completed)
            done[scan.name] = hidden_errors(whole, given, completed) if job.mask else None
            if not completed.evaluations.any():
                print(f"{scan.name}: everything is known; see --fill-gaps and --mask")
            bar.finished(len(done) * job.num)
    return done


def lack_sectors(scans: Sequence[PartialScan], job: Job) -> bool:
    """Whether most unknown rays of each scan lie in sectors without a known ray; a scan without unknown rays is either.

    Raises:
        InputError: so it is of some scans and not of others.
    """
    kinds: dict[bool, str] = {}
    for number, scan in enumerate(track(scans, "looking at", "scans")):
        state = hiding(scan, job, number)[1].state
        if (state == Ray.UNKNOWN).any():
            kinds.setdefault(share_in_sectors(state) >= 0.5, scan.name)
    if len(kinds) > 1:
        raise InputError(
            f"{kinds[True]} lacks whole sectors (--checkpoint {DEFAULT}) and {kinds[False]} does not (--checkpoint "
            f"{DENSIFY}): complete them apart, or give one --checkpoint for all."
        )
    return True in kinds


@lru_cache(maxsize=16)  # the scans of a small folder are read once
def hiding(scan: PartialScan, job: Job, number: int) -> tuple[Partial, Partial]:
    """What is known of scan `number`, and what the job leaves of it."""
    whole = scan.read()
    if job.fill_gaps:
        gaps = np.where(whole.state == Ray.EMPTY, int(Ray.UNKNOWN), whole.state)
        whole = replace(whole, state=gaps.astype(np.uint8))
    return whole, masked(whole, job.mask, number, job.seed, scan.name)


def masked(scan: Partial, mask: Mask | None, number: int, seed: int, name: str) -> Partial:
    """A scan of which a mask keeps a part; the part of scan `number` is a function of (seed, number).

    Raises:
        InputError: nothing is kept, or all.
    """
    if mask is None:
        return scan
    kept = mask(scan.state.shape, noise.generator(seed, "condition", number))
    measured = scan.state != Ray.UNKNOWN
    for wrong, what in ((not (measured & kept).any(), "nothing"), (not (measured & ~kept).any(), "everything")):
        if wrong:
            raise InputError(f"{name}: the mask keeps {what} that was measured; give another --mask.")
    state = np.where(kept, scan.state, int(Ray.UNKNOWN)).astype(np.uint8)
    xyz = None if scan.xyz is None else scan.xyz * kept
    return Partial(scan.image * kept, state, xyz)


def hidden_errors(whole: Partial, given: Partial, completed: Completed) -> np.ndarray:
    """MAE in metres where all return and share of rays wrong in ray-drop, of the answers and of interpolation, (2, 2).

    They are of the rays that a mask has hidden of a scan; of several answers the mean.
    """
    known = given.state != Ray.UNKNOWN
    hidden = (whole.state != Ray.UNKNOWN) & ~known
    images = [*completed.images.numpy(), interpolated(given.image, known)]
    off = common_mae(whole.image, images, hidden)
    wrong = [float(((whole.image[0] > 0) != (image[0] > 0))[hidden].mean()) for image in images]
    return np.array([[np.mean(part[:-1]), part[-1]] for part in (off, wrong)])


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


def _inputs(store: Store, inputs: Mapping[str, str], files: Mapping[str, Sequence[Path]]) -> dict[str, str]:
    """Identities of the scans that a folder's answers belong to, by name, with those of `inputs`.

    Raises:
        InputError: the folder holds answers by other settings, or files of an answer's name that are not its.
    """
    before: dict[str, str] = read_manifest(store.folder, store.kind)["inputs"] if store.check() else {}
    for name, paths in files.items():
        if before.get(name) != inputs[name] and any(path.exists() for path in paths):
            raise InputError(f"{store.folder} holds files of another scan of the name {name}; give another --out.")
    return {**before, **inputs}


def _write(
    checkpoint: Checkpoint,
    scan: PartialScan,
    out: Path,
    files: Sequence[Path],
    given: Partial,
    completed: Completed,
) -> None:
    if len(files) > 1:
        deviation, returned = completed.spread.numpy()
        with atomic_write(out / f"{scan.name}.spread.npz") as file:
            np.savez_compressed(file, deviation=deviation, returned=returned)
    measured = None if given.xyz is None else given.xyz * (given.state == Ray.RETURN)
    for path, image in zip(files, completed.images.numpy(), strict=True):
        if scan.image:
            with atomic_write(path) as file:
                np.save(file, image)
        else:
            xyz, reflectance = image_to_points(image, checkpoint.sensor.rays(), measured)
            write_points(path, xyz, reflectance if len(image) > 1 else None)


def _draw(
    checkpoint: Checkpoint, scan: PartialScan, out: Path, given: Partial, completed: Completed, truth: Partial | None
) -> None:
    """`NAME.png` with two answers, `NAME.html` with more."""
    rays, answers = checkpoint.sensor.rays(), completed.images.numpy()
    known = [("what is known", given.image)]
    whole = [("the whole scan", truth.image)] if truth else []
    rows = [(f"answer {number}", image) for number, image in enumerate(answers[:SHOWN])]
    named = [*known, *rows, *whole]
    page = out / f"{scan.name}.html"
    write_page(page, [image for _, image in named], rays, [name for name, _ in named], title=scan.name)
    spread = completed.spread.numpy() if len(answers) > 1 else None
    figure = completed_figure([*known, *rows[:2], *whole], given.state == Ray.UNKNOWN, rays, scan.name, spread)
    save_figure(figure, out / f"{scan.name}.png")
