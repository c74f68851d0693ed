"""Generated scans as files and pictures."""

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numpy import ndarray
from torch import Tensor

from r2flow.base.config import as_override
from r2flow.base.errors import InputError
from r2flow.base.progress import Bar, track
from r2flow.data.detection import reading_for
from r2flow.data.options import SIMULATED
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.labels import SEMANTIC_KITTI, LabelList, label_list, write_labels
from r2flow.lidar.projection import image_points, write_scan
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.completion import label
from r2flow.model.config import ModelConfig
from r2flow.model.paths import title_of
from r2flow.model.sampling import draw, warn_unsolved
from r2flow.model.saving import weights_hash
from r2flow.reports.figures import save_figure
from r2flow.reports.pictures import contact_sheet, scan_figure
from r2flow.reports.view import most_images, panel_of, write_viewer
from r2flow.store import MANIFEST, FileStore

# names of their files
_SAMPLES = re.compile(r"\d{6}\.(ply|bin|npy|png|label|probability\.npz)|samples\.(png|html)")


def write_samples(
    checkpoint: Checkpoint,
    out: str | Path,
    num: int,
    seed: int,
    sampler: Sampler | None = None,
    formats: Sequence[str] | None = None,
    pictures: int = 8,
    batch_size: int = 1,
    replace: bool = False,
    precision: Precision = "32-true",
    labels: Checkpoint | None = None,
    label_ids: str | None = None,
) -> Sequence[str]:
    """Sample scans and write each as `out/NNNNNN.FORMAT`, the first ones also as pictures and in
    3-D.

    Scan i of a seed is independent of `num` and `batch_size`. A stopped call resumes; `replace`
    deletes samples of other settings in the folder. Formats: `ply` and `bin` are points in metres
    with reflectance, `npy` is the range image, float32 (2 or 1, H, W); default: all that suit the
    model. `labels`, a labelled model of the same images, adds labels of the points, ids of the list
    `label_ids`. Returns the formats.
    """
    generator = checkpoint.generator
    sampler = sampler or generator.sampler
    fitting = ("ply", "bin", "npy") if checkpoint.encoding.reflectance else ("ply", "npy")
    endings = fitting if formats is None else formats
    if not set(endings) <= set(fitting):
        raise InputError(
            f"--format {','.join(endings)!r} cannot hold these scans; give some of "
            f"{','.join(fitting)}."
        )
    sampler.check(generator)
    recipe = recipe_of(
        checkpoint,
        seed,
        sampler,
        label_ids,
        precision=None if precision == "32-true" else precision,
        labels=labels and weights_hash(labels),
    )
    store = FileStore(out, "samples", recipe, endings)
    stale = _stale_files(store, replace)
    rays = checkpoint.sensor.rays()
    ids = label_list(label_ids or SEMANTIC_KITTI)
    shown: list[ndarray] = []
    batches = [range(first, min(first + batch_size, num)) for first in range(0, num, batch_size)]
    left = [part for part in batches if part.start < pictures or stale or store.missing(part)]
    evaluations = len(left) * (sampler.evaluations(generator) or 0)
    taken: list[int] = []  # evaluations of each scan
    with Bar("sampling", sum(map(len, left)), evaluations=evaluations) as bar:
        for numbers in left:
            drawn = draw(generator, numbers, seed, sampler, None, precision, bar.evaluated)
            warn_unsolved(drawn.converged, numbers.start)
            while stale:  # the first scan shows that the settings are valid
                stale.pop().unlink()
            if not (taken and store.check()):  # `begin` lists the folder
                store.begin()
            images = drawn.images if labels is None else label(labels, drawn.images)
            for number, image in zip(numbers, images.numpy(), strict=True):
                write_labelled(image, rays, store.folder, f"{number:06d}", endings, ids)
                if number < pictures:
                    shown.append(image)
            taken += drawn.evaluations.tolist()
            bar.set(len(taken))
    if taken and not evaluations:  # an adaptive sampler's differ
        each = ", ".join(map(str, taken[:16]))
        more = ", ..." if len(taken) > 16 else ""
        print(f"evaluations of each scan: {each}{more}; mean {sum(taken) / len(taken):.1f}")
    if shown:
        _draw_samples(shown, rays, store.folder, f"{title_of(checkpoint.path)}, seed {seed}")
    return endings


def write_labelled(
    image: ndarray, rays: Tensor, out: Path, name: str, endings: Sequence[str], ids: LabelList
) -> None:
    """Write an image by `write_scan`, and the labels of its points, if it has any, as ids of a
    list.
    """
    if len(image) > 2:
        write_labels(out, name, *image_points(image, rays)[1][1:], ids=ids)
    write_scan(image[:2], rays, out, name, endings)


def _stale_files(store: FileStore, replace: bool) -> list[Path]:
    """Files of samples with other settings, if they may be replaced; refuses other files."""
    files = [file for file in store.folder.glob("*") if _SAMPLES.fullmatch(file.name)]
    note = store.folder / MANIFEST
    if replace and note.is_file():
        if store.recipe_there() != store.described:
            return [note, *files]
    elif not store.check() and files:
        raise InputError(
            f"{store.folder} holds {files[0].name} and no {MANIFEST}; give another folder by --out."
        )
    return []


def recipe_of(
    checkpoint: Checkpoint,
    seed: int,
    sampler: Sampler,
    label_ids: str | LabelList | None = None,
    **more: Any,
) -> dict[str, Any]:
    """Recipe of the store of samples: settings that affect samples if not None, and how to read
    them.
    """
    return {
        "reading": reading_for([], checkpoint, label_ids=label_ids).described(),
        "encoding": {
            **(checkpoint.config.model["encoding"] or {}),
            "reflectance": checkpoint.encoding.reflectance,
            "min_range": checkpoint.sensor.min_range,
            "max_range": checkpoint.sensor.max_range,
        },
        "seed": seed,
        "sampler": sampler.asdict(),
        "step": checkpoint.step,
        "weights": weights_hash(checkpoint),
        "rays": "centre",  # points lie on rays through bin centres, whatever the model's rays
        **{key: value for key, value in more.items() if value is not None},
    }


def _draw_samples(images: Sequence[ndarray], rays: Tensor, out: Path, title: str) -> None:
    """Write a picture per image, `samples.png` of 8, and `samples.html` of all that fit."""
    for index, image in enumerate(track(images, "drawing", "pages", least=3)):
        save_figure(scan_figure(image, rays, f"sample {index}"), out / f"{index:06d}.png")
    save_figure(contact_sheet(images[:8], rays), out / "samples.png")
    shown = images[: most_images(rays.shape)]
    panels = [panel_of(f"sample {index}", image[None], rays) for index, image in enumerate(shown)]
    write_viewer(out / "samples.html", panels, title)


def what_next(run: Path, out: Path, config: ModelConfig) -> str:
    """Suggested commands after sampling a run to `out`: training on real scans, the next link, or
    evaluation.
    """
    plugins = "".join(f" --plugin {shlex.quote(name)}" for name in config.plugins)
    quoted = shlex.quote(str(run))
    stage = config.stage
    if config.data.name == SIMULATED:
        then = "train data=kitti_raw data.root=FOLDER backbone=hdit_small"
    elif stage.name == "rectify" and not stage.parent:
        then = f"train experiment=reflow {as_override('stage.parent', run)}{plugins}"
    elif stage.name == "reflow":
        then = f"train experiment=distill {as_override('stage.parent', run)}{plugins}"
    else:
        then = f"evaluate REAL {quoted}{plugins}"
    more = shlex.quote(str(out.parent / "more"))
    first = shlex.quote(str(out / "000000.ply"))
    views = shlex.quote(str(out.parent / "views"))
    return f"""
next
  r2flow sample {quoted} --num 16{plugins} --seed 1 --out {more}
  r2flow show {first} --out {views}
  r2flow {then}"""
