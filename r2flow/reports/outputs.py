"""Generated scans as files and pictures."""

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.config import as_override
from r2flow.data.opening import reading_for
from r2flow.errors import InputError
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.projection import write_scan
from r2flow.lidar.region import Region
from r2flow.model.checkpoint import Checkpoint, title_of, weights_hash
from r2flow.model.sampling import draw, warn_unsolved
from r2flow.progress import Bar, track
from r2flow.reports.pictures import contact_sheet, save_figure, scan_figure
from r2flow.reports.view import Panel, most_images, write_page
from r2flow.store import MANIFEST, FileStore, read_manifest

FORMATS = ("ply", "bin", "npy")
OWN = re.compile(r"\d{6}\.(ply|bin|npy|png)|samples\.(png|html)")  # file names of samples


def write_samples(
    checkpoint: Checkpoint,
    out: str | Path,
    num: int,
    seed: int,
    sampler: Sampler | None = None,
    formats: Sequence[str] | None = None,
    pictures: int = 8,
    batch_size: int = 1,
    region: Region | None = None,
    replace: bool = False,
    precision: Precision = "32-true",
) -> Sequence[str]:
    """Sample scans and write each as `out/NNNNNN.FORMAT`, the first ones also as pictures and in 3-D (`samples.html`).

    Scan i of a seed is independent of `num` and `batch_size`. A stopped call resumes; `replace` deletes samples of
    other settings in the folder. The contact sheet shows at most 8 of `pictures`. Files have the sensor's shape, 0
    outside the region (`r2flow.model.sampling.sample`). Formats: `ply` and `bin` are points in metres with reflectance,
    `npy` is the range image, float32 (2 or 1, H, W); default: all that suit the model. Returns the formats.
    """
    generator, out, rays = checkpoint.generator, Path(out), checkpoint.sensor.rays()
    sampler = sampler or generator.sampler
    fitting = [name for name in FORMATS if name != "bin" or checkpoint.encoding.reflectance]
    endings = fitting if formats is None else formats
    if other := [name for name in endings if name not in fitting]:
        raise InputError(f"--format {','.join(other)!r} cannot hold these scans; give some of {','.join(fitting)}.")
    sampler.check(generator)
    how: dict[str, Any] = {"region": region, "precision": precision}
    part = {k: v for k, v in (how | {"region": region and asdict(region)}).items() if v not in (None, "32-true")}
    store = FileStore(out, "samples", recipe_of(checkpoint, seed, sampler, **part), endings)
    stale = _stale(store, replace)
    shown, done = list[np.ndarray](), 0
    batches = [range(first, min(first + batch_size, num)) for first in range(0, num, batch_size)]
    left = [numbers for numbers in batches if numbers.start < pictures or stale or store.missing(numbers)]
    with Bar("sampling", sum(map(len, left)), evaluations=len(left) * (sampler.evaluations(generator) or 0)) as bar:
        for numbers in left:
            drawn = draw(generator, numbers, seed, sampler, **how, progress=bar.evaluated)
            warn_unsolved(drawn.converged, numbers.start)
            while stale:  # the first scan shows that the settings are valid
                stale.pop().unlink()
            if not (done and store.check()):  # `begin` lists the folder
                store.begin()
            for number, image in zip(numbers, drawn.images.numpy(), strict=True):
                write_scan(image, rays, out, f"{number:06d}", endings)
                shown += [image] if number < pictures else []
            done += len(numbers)
            bar.set(done)
    if region is not None:
        shown, rays = [region.crop(torch.from_numpy(image)).numpy() for image in shown], region.crop(rays)
    if shown:
        draw_pages(shown, rays, out, f"{title_of(checkpoint.path)}, seed {seed}")
    return endings


def _stale(store: FileStore, replace: bool) -> list[Path]:
    """Files of samples with other settings, if they may be replaced; refuses other files."""
    files = [file for file in store.folder.glob("*") if OWN.fullmatch(file.name)]
    note = store.folder / MANIFEST
    if replace and note.is_file() and read_manifest(store.folder, store.kind)["recipe"] != store.described:
        return [note, *files]
    if not store.check() and files:
        raise InputError(f"{store.folder} holds {files[0].name} and no {MANIFEST}; give another folder by --out.")
    return []


def recipe_of(checkpoint: Checkpoint, seed: int, sampler: Sampler, **more: Any) -> dict[str, Any]:
    """Recipe of the store of samples: settings that affect samples, and how to read them."""
    about = {**checkpoint.config.get("encoding", {}), "reflectance": checkpoint.encoding.reflectance}
    about |= {"min_range": checkpoint.sensor.min_range, "max_range": checkpoint.sensor.max_range}
    # Points lie on rays through bin centres, independent of the rays in the model.
    return {
        "reading": reading_for([], checkpoint).described(), "encoding": about, "seed": seed,
        "sampler": sampler.asdict(), "step": checkpoint.step, "weights": weights_hash(checkpoint), "rays": "centre",
        **more,
    }  # fmt: skip


def draw_pages(images: Sequence[np.ndarray], rays: Tensor, out: Path, title: str) -> None:
    """Write a picture per image, `samples.png` of the first 8, and `samples.html` of all that fit."""
    for index, image in track(list(enumerate(images)), "drawing", "pages", least=3):
        save_figure(scan_figure(image, rays, f"sample {index}"), out / f"{index:06d}.png")
    save_figure(contact_sheet(images[:8], rays), out / "samples.png")
    panels = [Panel(f"sample {i}", image[None], rays) for i, image in enumerate(images[: most_images(rays.shape)])]
    write_page(out / "samples.html", panels, title)


def what_next(run: Path, out: Path, config: Mapping[str, Any]) -> str:
    """Suggested commands after sampling a run to `out`: training on real scans, the next link, or evaluation."""
    plugins = "".join(f" --plugin {shlex.quote(str(name))}" for name in config.get("plugins") or ())
    paths = run, out.parent / "more", out / "000000.ply", out.parent / "views"
    quoted, more, first, views = (shlex.quote(str(path)) for path in paths)
    stage = config["stage"]
    experiment = {"rectify": None if stage.get("init") else "reflow", "reflow": "distill"}.get(stage["name"])
    if config["data"]["name"] == "simulated":
        then = "train data=kitti_raw data.root=FOLDER backbone=hdit_small"
    elif experiment:
        then = f"train experiment={experiment} {as_override('stage.parent', run)}{plugins}"
    else:
        then = f"evaluate REAL {quoted}{plugins}"
    return f"""
next
  r2flow sample {quoted} --num 16{plugins} --seed 1 --out {more}
  r2flow show {first} --out {views}
  r2flow {then}"""
