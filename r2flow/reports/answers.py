"""Completed scans as files and pictures."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from scipy.spatial import cKDTree

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.base.files import atomic_write, save_array
from r2flow.base.progress import Bar, track
from r2flow.data.partial import PartialScan
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.known import Mask, Ray, share_in_sectors
from r2flow.lidar.labels import write_labels
from r2flow.lidar.other_sensors import Partial
from r2flow.lidar.projection import image_points
from r2flow.lidar.scan_files import WRITTEN, scan_ending, write_points
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import Completed, complete
from r2flow.model.shipped import DEFAULT, DENSIFY
from r2flow.reports.outputs import recipe_of, write_labelled
from r2flow.reports.pictures import contact_sheet, save_figure
from r2flow.reports.view import panel_of, write_viewer
from r2flow.store import Store, manifest_of

_THREADS = 4  # at most: Python's own work is done by one thread at a time


@dataclass(frozen=True)
class Job:
    """Settings of completions."""

    num: int = 1  # answers per scan
    seed: int = 0
    mask: Mask | None = None  # measured rays to use; None: all
    fill_gaps: bool = False  # treat rays without a return as unmeasured
    hide: frozenset[str] = frozenset()  # channels that are drawn anew; range takes all returns
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
) -> None:
    """Complete scans; write answers, their spread, pictures and 3-D pages; print counts.

    Scans whose answers are all in the folder are skipped. `about` has the other settings that
    affect the answers, as plain values.
    """
    settings = {
        "num": job.num,
        "fill_gaps": job.fill_gaps,
        **about,
        "precision": job.precision,
        "hide": sorted(job.hide) or None,
    }
    recipe = recipe_of(checkpoint, job.seed, sampler, completion=settings)
    store = Store(out, "answers", recipe)
    files = {scan.name: _answer_files(checkpoint, scan, out, job.num) for scan in scans}
    inputs = _check_inputs(store, scans, files)
    left = [
        number
        for number, scan in enumerate(scans)
        if not all(path.is_file() for path in files[scan.name])
    ]
    counts = _Counts()
    batches = math.ceil(job.num / job.batch_size) * (sampler.evaluations(checkpoint.generator) or 0)
    bar = Bar("completing", len(left) * job.num, "answers", evaluations=len(left) * batches)

    def answer(number: int) -> tuple[Partial, Completed]:
        given = _known_rays(scans[number], job, number)
        (completed,) = complete(
            checkpoint,
            torch.from_numpy(given.image)[None],
            torch.from_numpy(given.state)[None],
            job.num,
            job.seed,
            sampler=sampler,
            batch_size=job.batch_size,
            first=number,
            precision=job.precision,
            progress=bar.evaluated,
        )
        return given, completed

    def write(number: int, given: Partial, completed: Completed) -> tuple[Partial, Completed]:
        scan = scans[number]
        _write(checkpoint, scan, out, files[scan.name], given, completed, job)
        return given, completed

    with bar, _threads(checkpoint) as pool:
        done: Iterable[tuple[Partial, Completed]] = ()
        if left:
            first = answer(left[0])  # it shows that the settings are valid
            store.check()  # commands for other scans add theirs at the same time
            store.write_manifest(inputs={**manifest_of(out).get("inputs", {}), **inputs})
            others = pool.map(lambda number: write(number, *answer(number)), left[1:])
            done = chain([write(left[0], *first)], others)
        for number, (given, completed) in zip(left, done, strict=True):
            scan = scans[number]
            if number < job.pictures:
                _draw(checkpoint, scan, out, given, completed)
            counts.add(scan, given, completed)
        bar.set(len(left) * job.num)
    _print_counts(checkpoint, counts)
    written = f"{len(left)} scan{'' if len(left) == 1 else 's'} written to {out}"
    skipped = [f"{len(scans) - len(left)} there already"] if len(left) < len(scans) else []
    new = [f"{counts.added / len(left) / job.num:,.0f} new points a scan"] if left else []
    endings = {scan.ending: files[scan.name][0].suffix for scan in scans}
    other = [f"{own} as {given}" for own, given in endings.items() if own != given]
    print(", ".join([written, *skipped, *new, *other]))


@dataclass
class _Counts:
    """What was taken of scans of points, and added to scans."""

    rays: ndarray = field(default_factory=lambda: np.zeros(len(Ray), int))  # of each state
    outside: int = 0  # points
    added: int = 0

    def add(self, scan: PartialScan, given: Partial, completed: Completed) -> None:
        if not completed.evaluations.any():
            print(
                f"{scan.name}: every ray of the image is measured, so nothing is added; see "
                "--size, --from, --fill-gaps and --mask"
            )
        returned = completed.images[:, 0].numpy() > 0
        self.added += int((returned & (given.state != Ray.RETURN)).sum())
        if not scan.image:
            self.rays += np.bincount(given.state.ravel(), minlength=len(Ray))
            self.outside += given.points.dropped if given.points else 0


def _print_counts(checkpoint: Checkpoint, counts: _Counts) -> None:
    """Print what was taken of points."""
    rays = counts.rays
    share = rays[Ray.EMPTY] / max(rays[Ray.EMPTY] + rays[Ray.RETURN], 1)
    if share > 0.5:  # 31 % at most of real scans
        print(
            f"{share:.0%} of the measured rays have no return: for thinned scans give --fill-gaps"
        )
    if rays.any():
        sensor = checkpoint.sensor
        rows, columns = sensor.shape
        print(
            f"used: the nearest point in each pixel of {rows}x{columns}; {counts.outside:,} "
            f"outside {sensor.min_range:g}-{sensor.max_range:g} m left out"
        )


@contextmanager
def _threads(checkpoint: Checkpoint) -> Iterator[ThreadPoolExecutor]:
    """Threads that read, complete and write a scan each: on a CPU they share its cores.

    A command that is stopped does not wait for the scans that are left.
    """
    cores = torch.get_num_threads()
    count = min(cores, _THREADS) if checkpoint.generator.device.type == "cpu" else _THREADS
    pool = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(cores // count,))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _answer_files(checkpoint: Checkpoint, scan: PartialScan, out: Path, num: int) -> list[Path]:
    """Files of the answers to a scan: of its own format, if it can be written."""
    if scan.path and (out / scan.name).resolve().parent == scan.path.resolve().parent:
        raise InputError(f"{out} is the folder of the scans; give another --out.")
    ending = scan.ending
    if ending not in WRITTEN or (ending == ".bin" and not checkpoint.encoding.reflectance):
        ending = ".ply"
    if num == 1:
        return [out / f"{scan.name}{ending}"]
    width = len(str(num - 1))
    return [out / f"{scan.name}_{number:0{width}d}{ending}" for number in range(num)]


def _check_inputs(
    store: Store, scans: Sequence[PartialScan], files: Mapping[str, Sequence[Path]]
) -> dict[str, str]:
    """Hashes of the scans by name; refuses a folder with other answers."""
    store.check()
    before = manifest_of(store.folder).get("inputs", {})
    inputs = {scan.name: scan.identity() for scan in track(scans, "hashing", "scans")}
    for name, paths in files.items():
        if before.get(name) != inputs[name] and any(path.exists() for path in paths):
            raise InputError(
                f"{store.folder} holds files of another scan of the name {name}; give another "
                "--out."
            )
    return inputs


def lack_sectors(scans: Sequence[PartialScan], job: Job) -> bool:
    """Whether most unknown rays of each scan lie in sectors without known rays; ignores scans
    without unknown rays.

    Refuses a mixture of both kinds of scans.
    """
    kinds: dict[bool, str] = {}
    for number, scan in enumerate(track(scans, "looking at", "scans")):
        state = _known_rays(scan, job, number).state
        if (state == Ray.UNKNOWN).any():
            kinds.setdefault(share_in_sectors(state) >= 0.5, scan.name)
    if len(kinds) > 1:
        raise InputError(
            f"{kinds[True]} lacks whole sectors (--checkpoint {DEFAULT}) and {kinds[False]} does "
            "not (--checkpoint "
            f"{DENSIFY}): complete them apart, or give one --checkpoint for all."
        )
    return True in kinds


@lru_cache(maxsize=16)  # read the scans of a small folder once
def _known_rays(scan: PartialScan, job: Job, number: int) -> Partial:
    """Known rays of scan `number` that the job's mask keeps; the mask depends only on (seed,
    number).
    """
    given = scan.read()
    if job.fill_gaps:
        state = np.where(given.state == Ray.EMPTY, np.uint8(Ray.UNKNOWN), given.state)
        given = replace(given, state=state)
    given = _without(given, job.hide)
    if job.mask is None:
        return given
    measured = given.state != Ray.UNKNOWN
    kept = job.mask(measured, noise.generator(job.seed, "condition", number))
    for some, what in ((measured & kept, "nothing"), (measured & ~kept, "everything")):
        if not some.any():
            raise InputError(f"{scan.name}: the mask keeps {what} that was measured; give another.")
    state = np.where(kept, given.state, np.uint8(Ray.UNKNOWN))
    xyz = None if given.xyz is None else given.xyz * kept
    return Partial(given.image * kept, state, xyz)


def _without(given: Partial, hidden: frozenset[str]) -> Partial:
    """A partial scan without some channels; without ranges, only its labels are left."""
    image = given.image.copy()
    if "label" in hidden:
        image = image[:2]
    if "reflectance" in hidden:
        image[1:2] = 0
    if "range" not in hidden:
        return replace(given, image=image if image[1:].any() else image[:1])
    image[:2] = 0
    if not image.any():
        raise InputError("without ranges a scan has no known ray: give one with labels.")
    return Partial(image, np.full_like(given.state, Ray.UNKNOWN))


def _write(
    checkpoint: Checkpoint,
    scan: PartialScan,
    out: Path,
    files: Sequence[Path],
    given: Partial,
    completed: Completed,
    job: Job,
) -> None:
    """Write the answers to a scan, and the spread of several."""
    if len(files) > 1:
        deviation, returned = completed.spread.numpy()
        with atomic_write(out / f"{scan.name}.spread.npz") as file:
            np.savez_compressed(file, deviation=deviation, returned=returned)
    known = given.state == Ray.RETURN
    rays = checkpoint.sensor.rays()
    silent = given.points.reflectance is None if given.points else len(given.image) == 1
    silent &= "reflectance" not in job.hide  # else that of the answer would be invented
    labelled = checkpoint.encoding.labels
    for path, image in zip(files, completed.images.numpy(), strict=True):
        name = path.name.removesuffix(scan_ending(path.name) or path.suffix)
        if scan.image:
            if labelled:
                write_labelled(image, rays, path.parent, name, ["ply"])
            save_array(path, image[: 1 if silent else 2])
            continue
        xyz, values = image_points(image * known, rays, given.xyz)
        if given.points is not None:  # in the order of the file
            points = given.points.xyz
            strength = given.points.reflectance
            if strength is not None and len(values) == 1:
                values = strength[None]
            else:  # those of the nearest ray
                values = values[:, cKDTree(xyz).query(points)[1]]
                if strength is not None:
                    values[:1] = strength
            xyz = points
        new, estimated = image_points(image * ~known, rays)
        xyz = np.concatenate([xyz, new])
        values = np.concatenate([values, estimated], axis=1)
        if labelled:
            write_labels(path.parent, name, *values[1:])
        strength = values[0] if len(values) else None
        if silent:  # a .bin has this column
            strength = np.zeros(len(xyz)) if path.suffix == ".bin" else None
        write_points(path, xyz, strength)


def _draw(
    checkpoint: Checkpoint, scan: PartialScan, out: Path, given: Partial, completed: Completed
) -> None:
    """Write `NAME.png` and `NAME.html` with the known rays and up to four answers."""
    rays = checkpoint.sensor.rays()
    answers = completed.images.numpy()[:4]
    images = [given.image, *answers]
    names = ["what is known", *(f"answer {number}" for number in range(len(answers)))]
    panels = [panel_of(name, image[None], rays) for name, image in zip(names, images, strict=True)]
    write_viewer(out / f"{scan.name}.html", panels, scan.name)
    figure = contact_sheet(images, rays, names, given.state == Ray.UNKNOWN)
    save_figure(figure, out / f"{scan.name}.png")
