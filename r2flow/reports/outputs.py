"""Generated scans as files and pictures."""

import logging
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
from r2flow.files import atomic_write
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.region import Region
from r2flow.lidar.scan_files import write_points
from r2flow.model.checkpoint import Checkpoint, weights_hash
from r2flow.model.sampling import batches, draw
from r2flow.progress import Bar, track
from r2flow.reports.view import most_images, write_page
from r2flow.store import MANIFEST, FileStore, read_manifest

log = logging.getLogger(__name__)

FORMATS = ("ply", "bin", "npy")
OWN = re.compile(r"\d{6}(\.reflectance)?\.(ply|bin|npy|png)|samples\.(png|html)")  # what samples are written to


def formats_of(checkpoint: Checkpoint, channels: str = "both") -> list[str]:
    """The output formats that can hold the scans: a .bin needs reflectance, a point needs its range."""
    if channels == "reflectance":
        return ["npy"]
    return [name for name in FORMATS if name != "bin" or (channels == "both" and checkpoint.encoding.reflectance)]


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
    channels: str = "both",
    replace: bool = False,
    precision: Precision = "32-true",
) -> list[np.ndarray]:
    """Draw scans and write each as `out/NNNNNN.FORMAT`, the first ones also as pictures and in 3-D (`samples.html`).

    Scan i of a seed is the same whatever `num` and `batch_size` are. A call that was stopped resumes.

    Args:
        sampler: How the generator is run; its own if left out.
        formats: All that fit if left out. `ply` and `bin` are points in metres with reflectance, `npy` the range image,
            float32 (2 or 1, H, W) in metres and reflectance; reflectance alone is `NNNNNN.reflectance.npy`.
        pictures: How many scans get a page of their own; the contact sheet shows at most 8 of them.
        region, channels: See `r2flow.model.sampling.sample`. Files are of the sensor's shape, 0 outside the region.
        replace: Whether samples of other settings in the folder are removed first.

    Returns:
        The images drawn as pictures.

    Raises:
        InputError: an unknown format, one that cannot hold what is asked for, nothing to draw, or a folder that holds
            other scans.
    """
    if num < 1 or batch_size < 1:
        raise InputError(f"needs at least one scan and a batch of at least one; found {num} and {batch_size}.")
    generator = checkpoint.generator
    sampler = sampler or generator.sampler
    generator.space.check_channels(channels)
    formats = formats_of(checkpoint, channels) if formats is None else formats
    check_formats(checkpoint, formats, channels)
    sampler.check(generator)
    out, rays = Path(out), checkpoint.sensor.rays()
    part: dict[str, Any] = {} if region is None else {"region": asdict(region)}
    part |= {} if channels == "both" else {"channels": channels}
    part |= {} if precision == "32-true" else {"precision": precision}
    endings = ["reflectance.npy"] if channels == "reflectance" else formats
    store = FileStore(out, "samples", recipe_of(checkpoint, seed, part, **sampler.asdict()), endings)
    stale = _stale(store, replace)
    if {"ply", "bin"} & set(formats) and not torch.equal(generator.space.rays, rays):
        log.warning(
            "the model was told rays through the corners of the bins (rays=reference); points are written along rays "
            "through their middles, where returns lie nearer (docs/data.md, Projection)"
        )
    shown: list[np.ndarray] = []
    with ScanBar("sampling", num, batches(num, batch_size) * (sampler.evaluations(generator) or 0)) as bar:
        for first in range(0, num, batch_size):
            numbers = range(first, min(first + batch_size, num))
            if first >= pictures and not stale and not store.missing(numbers):
                bar.finished(numbers.stop)
                continue
            drawn = draw(
                generator, numbers, seed, sampler, region=region, channels=channels, precision=precision,
                progress=bar.evaluated,
            )  # fmt: skip
            warn_unsolved(drawn.converged, drawn.first)
            while stale:  # the first scan shows that the settings can be used
                stale.pop().unlink()
            store.begin()
            for number, image in enumerate(drawn.images.numpy(), drawn.first):
                if channels == "reflectance":
                    _save(image, out / f"{number:06d}.reflectance.npy")
                else:
                    write_scan(image, rays, out, f"{number:06d}", formats)
                if len(shown) < pictures:
                    shown.append(image)
            bar.finished(numbers.stop)
    parts = shown if region is None else [region.crop(torch.from_numpy(image)).numpy() for image in shown]
    if parts and channels == "reflectance":
        draw_reflectances(parts[:8], out)
    elif parts:
        seen = rays if region is None else region.crop(rays)
        draw_pages(parts, seen, out)
        parts = parts[: most_images(seen.shape)]
        captions = [f"sample {number}" for number in range(len(parts))]
        write_page(out / "samples.html", parts, seen, captions, title=out.name)
    return shown


def warn_unsolved(converged: Tensor, first: int = 0) -> None:
    """Warn of the scans that the sampler has not solved; `first` is the number of the first one."""
    lost = [str(first + offset) for offset, solved in enumerate(converged.tolist()) if not solved]
    if lost:
        log.warning(
            "not solved, so no scans of this flow: %s; try another solver, or for a velocity that is singular at t = 1 "
            "a last step before it: --sampler adams3:finish=0.001.",
            ", ".join(lost),
        )


def _stale(store: FileStore, replace: bool) -> list[Path]:
    """The files of samples of other settings, if they are to be replaced.

    Raises:
        InputError: the folder holds other scans.
    """
    files = [file for file in store.folder.glob("*") if OWN.fullmatch(file.name)]
    note = store.folder / MANIFEST
    if replace and note.is_file() and read_manifest(store.folder, store.kind)["recipe"] != store.described:
        return [note, *files]
    if not store.check() and files:
        raise InputError(f"{store.folder} holds {files[0].name} and no {MANIFEST}; give another folder by --out.")
    return []


def recipe_of(
    checkpoint: Checkpoint, seed: int, more: Mapping[str, Any] | None = None, **sampler: Any
) -> dict[str, Any]:
    """What decides samples, and how they are read: the recipe of their store."""
    about = {**checkpoint.config.get("encoding", {}), "reflectance": checkpoint.encoding.reflectance}
    about |= {"min_range": checkpoint.sensor.min_range, "max_range": checkpoint.sensor.max_range}
    reading, step = reading_for([], checkpoint), checkpoint.step
    # Points lie on rays through the middles of the bins, whatever rays the model was told.
    return {
        "reading": reading.described(), "encoding": about, "seed": seed, "sampler": sampler, "step": step,
        "weights": weights_hash(checkpoint), "rays": "centre", **(more or {}),
    }  # fmt: skip


def check_formats(checkpoint: Checkpoint, formats: Sequence[str], channels: str) -> None:
    """Check the formats before anything is generated.

    Raises:
        InputError: an unknown one, or one that cannot hold what is asked for.
    """
    fitting = formats_of(checkpoint, channels)
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"no output format named {name!r}; known: {', '.join(FORMATS)}.")
        if name not in fitting:
            held = "points, which need a range," if channels == "reflectance" else "reflectance"
            whose = "this model has none" if channels == "both" else f"--channels {channels} leaves it out"
            raise InputError(f"a .{name} holds {held} and {whose}; use --format {','.join(fitting)}.")


class ScanBar(Bar):
    """A bar of scans that moves with the network evaluations between two scans.

    Args:
        evaluations: Network evaluations in all, batches counted as one; 0 where an adaptive solver decides.
        unit: What is counted in the place of scans.
    """

    def __init__(self, doing: str, num: int, evaluations: int = 0, unit: str = "scans") -> None:
        super().__init__(doing, num, unit)
        self._share = num / evaluations if evaluations else 0.0
        self._spent = 0

    def evaluated(self) -> None:
        self._spent += 1
        self(self._share)
        self.set(note=f"{self._spent} evaluations")

    def finished(self, done: int) -> None:
        """So many units are done by now."""
        self.set(done)


def write_scan(image: np.ndarray, rays: Tensor, out: Path, name: str, formats: Sequence[str]) -> None:
    """One range image in every format asked for."""
    xyz, reflectance = image_to_points(image, rays)
    for ending in formats:
        path = out / f"{name}.{ending}"
        if ending == "npy":
            _save(image, path)
        else:
            write_points(path, xyz, reflectance if len(image) > 1 else None)


def draw_pages(images: Sequence[np.ndarray], rays: Tensor, out: Path) -> Path:
    """A page for each image and `samples.png`, the contact sheet of the first 8."""
    from r2flow.reports.pictures import contact_sheet, save_figure, scan_figure

    numbered = list(enumerate(images))
    for index, image in track(numbered, "drawing", "pages", least=3):
        save_figure(scan_figure(image, rays, f"sample {index}"), out / f"{index:06d}.png")
    return save_figure(contact_sheet(images[:8], rays), out / "samples.png")


def draw_reflectances(images: Sequence[np.ndarray], out: Path) -> Path:
    """`samples.png` of scans without a range, (1, h, w) each: their reflectance, one under the other."""
    from r2flow.reports.pictures import dark_figure, draw_reflectance, save_figure

    figure = dark_figure(13, 1.2 * len(images) + 0.3)
    figure.set_layout_engine("constrained")
    axes: Any = figure.subplots(len(images), 1, squeeze=False)[:, 0]
    for row, (image, place) in enumerate(zip(images, axes, strict=True)):
        draw_reflectance(place, np.concatenate([image, image]), label=row == 0)  # a ray without any was dropped
    return save_figure(figure, out / "samples.png")


def what_next(checkpoint: Path, out: Path, config: Mapping[str, Any] | None = None) -> str:
    """The commands that come after scans were written to `out`.

    Args:
        config: The run's, if it is one run: what has been trained decides what can be trained next.
    """
    plugins = "".join(f" --plugin {shlex.quote(str(name))}" for name in (config or {}).get("plugins") or ())
    return f"""
next
  r2flow sample {checkpoint} --num 16{plugins} --seed 1 --out {out.parent / "more"}
  r2flow show {out / "000000.ply"} --out {out.parent / "views"}
  {_what_to_train(checkpoint, config)}"""


def _what_to_train(run: Path, config: Mapping[str, Any] | None) -> str:
    """Real scans after simulated ones, then the links of the paper's chain, then how good it is."""
    data, stage = (config or {}).get("data", {}), (config or {}).get("stage", {})
    if config is None or data.get("name") == "simulated":
        return "r2flow train data=kitti_raw data.root=FOLDER backbone=hdit_small"
    experiment = {"rectify": "reflow", "reflow": "distill"}.get(stage.get("name"))
    if experiment is not None:
        return f"r2flow train experiment={experiment} {as_override('stage.init', run)}"
    return f"r2flow evaluate REAL {shlex.quote(str(run))}"


def _save(image: np.ndarray, path: Path) -> None:
    with atomic_write(path) as file:
        np.save(file, image)
