"""Completed scans as files and pictures."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from scipy.spatial import cKDTree

from r2flow import noise
from r2flow.data.partial import PartialScan
from r2flow.errors import InputError, check
from r2flow.files import atomic_write, save_array
from r2flow.generators import Sampler, TransferFlow
from r2flow.generators.base import Precision
from r2flow.lidar.interpolation import interpolated
from r2flow.lidar.known import Mask, Ray, share_in_sectors
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import WRITTEN, write_points
from r2flow.lidar.transfer import Partial
from r2flow.metrics.completion import common_mae
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import Completed, complete
from r2flow.models import DEFAULT, DENSIFY
from r2flow.progress import Bar, track
from r2flow.reports.outputs import recipe_of
from r2flow.reports.pictures import completed_figure, save_figure
from r2flow.reports.view import Panel, write_page
from r2flow.store import Store, manifest_of


@dataclass(frozen=True)
class Job:
    num: int = 1  # answers per scan
    seed: int = 0
    mask: Mask | None = None  # measured rays to use; None: all
    fill_gaps: bool = False  # treat rays without a return as unmeasured
    batch_size: int = 1
    pictures: int = 8  # number of scans with a picture and a 3-D page
    precision: Precision = "32-true"


def write_completed(
    checkpoint: Checkpoint,
    scans: Sequence[PartialScan],
    out: Path,
    job: Job,
    sampler: Sampler,
    about: Mapping[str, Any],
) -> dict[str, np.ndarray | None]:
    """Complete scans and write answers, their spread, pictures and 3-D pages.

    Scans whose answers are all in the folder are skipped. The result has the others by name, with their `hidden_errors`
    if a mask has hidden rays, else None. `about` has the other settings that affect the answers, as plain values.
    """
    numbers = [""] if job.num == 1 else [f"_{answer:0{len(str(job.num - 1))}d}" for answer in range(job.num)]
    written = [ending for ending in WRITTEN if ending != ".bin" or checkpoint.encoding.reflectance]
    files: dict[str, list[Path]] = {}
    for scan in scans:
        ending = scan.ending if scan.ending in written else ".ply"
        files[scan.name] = [out / f"{scan.name}{number}{ending}" for number in numbers]
        if scan.path and (out / scan.name).resolve().parent == scan.path.resolve().parent:
            raise InputError(f"{out} is the folder of the scans; give another --out.")
    settings = {"num": job.num, "fill_gaps": job.fill_gaps, **about, "precision": job.precision}
    store = Store(out, "answers", recipe_of(checkpoint, job.seed, sampler, completion=settings))
    store.check()
    before = manifest_of(out)
    inputs = {scan.name: scan.identity() for scan in track(scans, "hashing", "scans")}
    for name, paths in files.items():
        if before.get("inputs", {}).get(name) != inputs[name] and any(path.exists() for path in paths):
            raise InputError(f"{out} holds files of another scan of the name {name}; give another --out.")
    left = [number for number, scan in enumerate(scans) if not all(path.is_file() for path in files[scan.name])]
    done: dict[str, np.ndarray | None] = {}
    used = empty = kept = outside = blind = 0
    batches = math.ceil(job.num / job.batch_size) * (sampler.evaluations(checkpoint.generator) or 0)
    with Bar("completing", len(left) * job.num, "answers", evaluations=len(left) * batches) as bar:
        for number in left:
            scan = scans[number]
            whole, given = hiding(scan, job, number)
            used += 0 if scan.image else int((given.state == Ray.RETURN).sum())
            empty += 0 if scan.image else int((given.state == Ray.EMPTY).sum())
            if given.points is not None:
                kept, outside = kept + len(given.points.xyz), outside + given.points.dropped
            blind = max(blind, 360 * (given.state == Ray.UNKNOWN).mean() * share_in_sectors(given.state))
            images, state = torch.from_numpy(given.image)[None], torch.from_numpy(given.state)[None]
            (completed,) = complete(
                checkpoint, images, state, job.num, job.seed, sampler=sampler, batch_size=job.batch_size, first=number,
                precision=job.precision, progress=bar.evaluated,
            )  # fmt: skip
            if not done:  # the first answer shows that the settings are valid
                out.mkdir(parents=True, exist_ok=True)
                with FileLock(out / ".answers.lock") as lock:  # commands for other scans add theirs at the same time
                    if (now := manifest_of(out)) != before:
                        store.check()  # one with other settings may have begun meanwhile
                    store.write_manifest(inputs={**now.get("inputs", {}), **inputs})
                    Path(lock.lock_file).unlink(missing_ok=True)
            if number < job.pictures:
                _draw(checkpoint, scan, out, given, completed, whole if job.mask else None)
            _write(checkpoint, scan, out, files[scan.name], given, completed)
            done[scan.name] = hidden_errors(whole, given, completed) if job.mask else None
            if not completed.evaluations.any():
                print(f"{scan.name}: everything is known, so nothing was completed; see --from, --fill-gaps and --mask")
            bar.set(len(done) * job.num)
    if blind and isinstance(checkpoint.generator, TransferFlow):
        print(f"no ray is known in up to {blind:.0f} degrees of a scan, and this model fills no whole sectors: "
              f"--checkpoint {DEFAULT} does, without --to and --size")  # fmt: skip
    if used < empty:  # 31 % at most of real scans
        print(f"{empty / (used + empty):.0%} of the measured rays have no return: for thinned scans give --fill-gaps")
    if used:
        sensor = checkpoint.sensor
        size = "x".join(map(str, sensor.shape))
        print(f"measured points used: {used:,}, the nearest in each pixel of {size}", end="")
        lost = f", {outside:,} outside {sensor.min_range:g}-{sensor.max_range:g} m left out" if outside else ""
        print(f"; kept: {'' if outside else 'all '}{kept:,}{lost}" if kept else "")
    return done


def lack_sectors(scans: Sequence[PartialScan], job: Job) -> bool:
    """Whether most unknown rays of each scan lie in sectors without known rays; ignores scans without unknown rays.

    Refuses a mixture of both kinds of scans.
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


@lru_cache(maxsize=16)  # read the scans of a small folder once
def hiding(scan: PartialScan, job: Job, number: int) -> tuple[Partial, Partial]:
    """Known rays of scan `number`, and those kept by the job's mask, which depends only on (seed, number)."""
    whole = scan.read()
    if job.fill_gaps:
        gaps = np.where(whole.state == Ray.EMPTY, int(Ray.UNKNOWN), whole.state)
        whole = replace(whole, state=gaps.astype(np.uint8))
    if job.mask is None:
        return whole, whole
    measured = whole.state != Ray.UNKNOWN
    kept = job.mask(measured, noise.generator(job.seed, "condition", number))
    for some, what in ((measured & kept, "nothing"), (measured & ~kept, "everything")):
        check(some.any(), f"{scan.name}: the mask keeps {what} that was measured; give another.")
    state = np.where(kept, whole.state, int(Ray.UNKNOWN)).astype(np.uint8)
    return whole, Partial(whole.image * kept, state, None if whole.xyz is None else whole.xyz * kept)


def hidden_errors(whole: Partial, given: Partial, completed: Completed) -> np.ndarray:
    """MAE in metres where all return and share of rays wrong in ray-drop, of the answers and of interpolation, (2, 2).

    Errors refer to rays hidden by a mask, averaged over answers.
    """
    known = given.state != Ray.UNKNOWN
    hidden = (whole.state != Ray.UNKNOWN) & ~known
    images = [*completed.images.numpy(), interpolated(given.image, known)]
    off = common_mae(whole.image, images, hidden)
    wrong = [float(((whole.image[0] > 0) != (image[0] > 0))[hidden].mean()) for image in images]
    return np.array([[np.mean(part[:-1]), part[-1]] for part in (off, wrong)])


def print_completed(done: Mapping[str, np.ndarray | None], out: Path, scans: int) -> None:
    """Print how many of the scans were completed, and the mean errors of hidden rays."""
    skipped = f", {scans - len(done)} there already" if len(done) < scans else ""
    print(f"{len(done)} scan{'s' * (len(done) != 1)} written to {out}{skipped}")
    if errors := [error for error in done.values() if error is not None]:
        (mae, linear), (wrong, wrong_linear) = np.ma.masked_invalid(errors).mean(0).filled(np.nan)
        off = f"MAE {mae:.2f} m ({linear:.2f}) where all return" if np.isfinite(mae) else "no ray returns in all"
        print(f"on hidden rays of {len(errors)} scan{'s' * (len(errors) > 1)} (interpolation of 1/range in brackets):")
        print(f"{off}, {wrong:.1%} ({wrong_linear:.1%}) wrong in ray-drop")


def _write(
    checkpoint: Checkpoint, scan: PartialScan, out: Path, files: Sequence[Path], given: Partial, completed: Completed
) -> None:
    if len(files) > 1:
        deviation, returned = completed.spread.numpy()
        with atomic_write(out / f"{scan.name}.spread.npz") as file:
            np.savez_compressed(file, deviation=deviation, returned=returned)
    known, rays = given.state == Ray.RETURN, checkpoint.sensor.rays()
    for path, image in zip(files, completed.images.numpy(), strict=True):
        if scan.image:
            save_array(path, image)
        else:
            own, strength = image_to_points(image * known, rays, given.xyz)  # before the new points
            new, estimated = image_to_points(image * ~known, rays)
            if given.points is not None:  # in the order of the file
                pixels, own, stored = own, given.points.xyz, given.points.reflectance
                strength = strength[cKDTree(pixels).query(own)[1]] if stored is None else stored
            xyz, reflectance = np.concatenate([own, new]), np.concatenate([strength, estimated])
            write_points(path, xyz, reflectance if len(image) > 1 else None)


def _draw(
    checkpoint: Checkpoint, scan: PartialScan, out: Path, given: Partial, completed: Completed, truth: Partial | None
) -> None:
    """Write `NAME.png` with two answers, `NAME.html` with four."""
    rays = checkpoint.sensor.rays()
    whole = [("the whole scan", truth.image)] if truth else []
    shown = completed.images.numpy()[:4]
    answers = [(f"answer {number}" if len(shown) > 1 else "answer", image) for number, image in enumerate(shown)]
    first, *_ = named = [("what is known", given.image), *answers, *whole]
    write_page(out / f"{scan.name}.html", [Panel(name, image[None], rays) for name, image in named], scan.name)
    spread = completed.spread.numpy() if len(completed.images) > 1 else None
    unknown = given.state == Ray.UNKNOWN
    linear = [("interpolation of 1/range", interpolated(given.image, ~unknown))] if truth else []
    true = (truth.image, truth.state == Ray.UNKNOWN) if truth else None
    figure = completed_figure([first, *answers[:2], *linear], unknown, rays, scan.name, spread, true)
    save_figure(figure, out / f"{scan.name}.png")
