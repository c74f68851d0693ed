"""Completed scans as files and pictures."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2flow import noise
from r2flow.data.opening import SAMPLES, write_samples_note
from r2flow.data.partial import PartialScan
from r2flow.errors import InputError
from r2flow.files import atomic_write, read_json
from r2flow.generators import Sampler
from r2flow.lidar.known import Mask, Ray
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import write_points
from r2flow.lidar.sensors import Sensor
from r2flow.lidar.transfer import Partial
from r2flow.metrics.completion import errors
from r2flow.model.checkpoint import Checkpoint, weights_hash
from r2flow.model.completion import Completed, complete
from r2flow.reports.outputs import ScanBar, note_of, warn_unsolved
from r2flow.reports.pictures import completed_figure, save_figure
from r2flow.reports.view import write_page

log = logging.getLogger(__name__)

WRITTEN = (".bin", ".pcd", ".ply", ".npy")  # formats that answers are written in; others become .ply
SHOWN = 4  # answers on a page


@dataclass(frozen=True)
class Job:
    """What is asked of the scans.

    Attributes:
        num: Answers to each scan.
        keep: As in `r2flow.model.completion.complete`.
        mask: Of the measured rays of each scan those that are kept; None for all.
        fill_gaps: Whether rays without a return count as not measured.
        on_surfaces: As in `r2flow.model.completion.complete`.
        pictures: How many scans get a picture and a page in 3-D.
    """

    num: int = 1
    seed: int = 0
    keep: str = "exact"
    mask: Mask | None = None
    fill_gaps: bool = False
    batch_size: int = 1
    on_surfaces: bool | None = None
    pictures: int = 8


def write_completed(
    checkpoint: Checkpoint,
    scans: Sequence[PartialScan],
    out: Path,
    job: Job,
    sampler: Sampler,
    about: Mapping[str, Any],
) -> dict[str, dict[str, float] | None]:
    """Complete scans and write their answers, the spread between these, pictures and pages in 3-D.

    A scan whose answers are all there is finished and passed over: they are written last.

    Args:
        about: What else decides the answers, as plain values, by which a folder is told from another.

    Returns:
        The scans that were completed now, by name, with the mean `errors` of their answers where a mask has hidden
        some of their rays, else None.

    Raises:
        InputError: a folder that holds other answers, or a scan that cannot be completed.
    """
    asked = {"num": job.num, "seed": job.seed, "keep": job.keep, "weights": weights_hash(checkpoint), **about}
    settings = {**asked, "sampler": sampler.asdict(), "inputs": {scan.name: scan.identity() for scan in scans}}
    files = [answer_files(checkpoint, scan, out, job.num) for scan in scans]
    inputs = {scan.path.resolve() for scan in scans if scan.path}
    replaced = [path for paths in files for path in paths if path.resolve() in inputs]
    if replaced:
        raise InputError(f"{replaced[0]} is one of the scans and would be replaced; give another --out.")
    for scan in scans:
        if scan.path and (out / scan.name).resolve().parent == scan.path.resolve().parent:
            raise InputError(f"{out} is the folder of the scans; answers need one of their own: give another --out.")
    there = {scan.name: any(path.exists() for path in paths) for scan, paths in zip(scans, files, strict=True)}
    before = _refuse_others(out, settings, [path for paths in files for path in paths], there)
    settings["inputs"] = {**before, **settings["inputs"]}
    left = [number for number, paths in enumerate(files) if not all(path.is_file() for path in paths)]
    found: dict[str, dict[str, float] | None] = {}
    known = []
    batches = math.ceil(job.num / job.batch_size) * checkpoint.generator.evaluations_of(sampler)
    with ScanBar("completing", len(left), len(left) * batches) as bar:
        for number in left:
            scan = scans[number]
            whole = scan.read()
            if job.fill_gaps:
                gaps = np.where(whole.state == Ray.EMPTY, int(Ray.UNKNOWN), whole.state)
                whole = replace(whole, state=gaps.astype(np.uint8))
            given = masked(whole, job.mask, number, job.seed, scan.name)
            images, state = torch.from_numpy(given.image)[None], torch.from_numpy(given.state)[None]
            (made,) = complete(
                checkpoint, images, state, job.num, job.seed, keep=job.keep, sampler=sampler,
                batch_size=job.batch_size, first=number, on_surfaces=job.on_surfaces, progress=bar.evaluated,
            )  # fmt: skip
            if not found:  # the first answer shows that the settings can be used
                write_samples_note(out, note_of(checkpoint, job.seed, {"completion": settings}, **sampler.asdict()))
            warn_unsolved(made.converged)
            if number < job.pictures:
                _draw(checkpoint, scan, out, given, made, whole if job.mask else None)
            _write(checkpoint, scan, out, files[number], given, made, job.keep)
            found[scan.name] = hidden_errors(whole, given, made, checkpoint.sensor) if job.mask else None
            known += [] if made.evaluations.any() else [scan.name]
            bar.finished(len(found))
    if known:
        log.warning(
            "%s: everything is known, so it came back as it was given; --fill-gaps completes rays without a return, "
            "--mask hides a part, --keep mend repairs it",
            known[0] if len(known) == 1 else f"{len(known)} scans",
        )  # fmt: skip
    return found


def masked(scan: Partial, mask: Mask | None, number: int, seed: int, name: str) -> Partial:
    """A scan of which a mask keeps a part; that of scan `number` is a function of (seed, number).

    Raises:
        InputError: nothing is kept, or all.
    """
    if mask is None:
        return scan
    kept = torch.from_numpy(mask(scan.state.shape, noise.generator(seed, "condition", number))).numpy()
    measured = scan.state != Ray.UNKNOWN
    for wrong, what in ((not (measured & kept).any(), "nothing"), (not (measured & ~kept).any(), "everything")):
        if wrong:
            raise InputError(f"{name}: the mask keeps {what} that was measured; give another --mask.")
    state = np.where(kept, scan.state, int(Ray.UNKNOWN)).astype(np.uint8)
    xyz = None if scan.xyz is None else scan.xyz * kept
    return Partial(scan.image * kept, state, xyz, scan.outside)


def hidden_errors(whole: Partial, given: Partial, made: Completed, sensor: Sensor) -> dict[str, float]:
    """How far answers are from what a mask has hidden of a scan: means over the answers of `errors`."""
    measured = whole.state != Ray.UNKNOWN
    hidden = measured & (given.state == Ray.UNKNOWN)
    # What no scan has measured, nobody knows: there an answer is neither right nor wrong.
    each = [errors(whole.image, image * measured, hidden, sensor) for image in made.images.numpy()]
    return {name: float(np.mean([one[name] for one in each])) for name in each[0]}


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


def _refuse_others(
    out: Path, settings: Mapping[str, Any], files: Sequence[Path], answered: Mapping[str, bool]
) -> dict[str, str]:
    """Refuse a folder with answers by other settings or to other scans.

    Args:
        answered: Of each scan, by name, whether an answer to one of this name is there.

    Returns:
        The scans that were completed there, by name, with what identifies them.
    """
    note = out / SAMPLES
    if not note.exists():  # it is written before the first answer
        if foreign := next((path for path in files if path.exists()), None):
            raise InputError(f"{foreign} is there and no answer of this command; give another --out.")
        return {}
    try:
        there = read_json(note).get("completion")
    except (ValueError, AttributeError):
        there = None
    ours = _flat(json.loads(json.dumps(settings)))
    if there is None:
        raise InputError(f"{out} holds other scans than completed ones (its {SAMPLES} says so); give another --out.")
    before: dict[str, str] = there.get("inputs") or {}
    there = _flat(there)
    wrong = next((key for key in ours if there.get(key) != ours[key]), None)
    if wrong is not None:
        found, asked = (json.dumps(one) for one in (there.get(wrong), ours[wrong]))
        raise InputError(
            f"{out} holds scans that were completed with {wrong} {found}, not {asked}; give another --out."
        )
    other = next(
        (name for name, scan in settings["inputs"].items() if answered[name] and before.get(name, scan) != scan), None
    )
    if other is not None:
        raise InputError(f"{out} holds answers to another scan of the name {other}; give another --out.")
    return before


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of the sampler beside the others, without the scans."""
    apart = ("sampler", "inputs")
    return {key: value for key, value in settings.items() if key not in apart} | settings.get("sampler", {})


def _write(
    checkpoint: Checkpoint,
    scan: PartialScan,
    out: Path,
    files: Sequence[Path],
    given: Partial,
    made: Completed,
    keep: str,
) -> None:
    if len(files) > 1:
        deviation, returned = made.spread.numpy()
        with atomic_write(out / f"{scan.name}.spread.npz") as file:
            np.savez_compressed(file, deviation=deviation, returned=returned)
    measured = None
    if given.xyz is not None and keep == "exact":
        measured = given.xyz * (given.state == Ray.RETURN)
    for path, image in zip(files, made.images.numpy(), strict=True):
        if scan.image:
            with atomic_write(path) as file:
                np.save(file, image)
        else:
            xyz, reflectance = image_to_points(image, checkpoint.sensor.rays(), measured)
            write_points(path, xyz, reflectance if len(image) > 1 else None)


def _draw(
    checkpoint: Checkpoint, scan: PartialScan, out: Path, given: Partial, made: Completed, truth: Partial | None
) -> None:
    """`NAME.png` with two answers, `NAME.html` with more."""
    rays, answers = checkpoint.sensor.rays(), made.images.numpy()
    known = [("what is known", given.image)]
    whole = [("the whole scan", truth.image)] if truth else []
    rows = [(f"answer {number}", image) for number, image in enumerate(answers[:SHOWN])]
    named = [*known, *rows, *whole]
    page = out / f"{scan.name}.html"
    write_page(page, [image for _, image in named], rays, [name for name, _ in named], title=scan.name)
    spread = made.spread.numpy() if len(answers) > 1 else None
    figure = completed_figure([*known, *rows[:2], *whole], given.state == Ray.UNKNOWN, rays, scan.name, spread)
    save_figure(figure, out / f"{scan.name}.png")
