"""Translated scans as files."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from r2flow.data.reading import read_labelled_scan
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanFiles, ScanSource
from r2flow.files import atomic_write
from r2flow.generators import Sampler
from r2flow.lidar.labels import labels_beside
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.scan_files import scan_ending, write_points
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.translation import translate
from r2flow.reports.outputs import ScanBar, recipe_of, warn_unsolved
from r2flow.store import FileStore


def write_translated(
    checkpoint: Checkpoint, scans: ScanSet, out: Path, formats: Sequence[str], seed: int, sampler: Sampler
) -> int:
    """Translate scans, each to `out/NAME.FORMAT`, with `NAME.label` where labels lie beside the scan.

    Returns:
        How many were translated now; those that are there already are kept.

    Raises:
        InputError: a model of no sensor, or a folder that holds other files.
    """
    source = scans.source
    names = [name.removesuffix(scan_ending(name) or os.path.splitext(name)[1]) for name in source.names]
    paths = source.paths if isinstance(source, ScanFiles) else []
    labelled = any(labels_beside(path) for path in paths) and tuple(formats) != ("npy",)
    about = {"scans": source.identity(), "formats": list(formats), "labels": labelled}
    recipe = recipe_of(checkpoint, seed, {"translation": about}, **sampler.asdict())
    store = FileStore(out, "translated", recipe, [*formats, *(["label"] if labelled else [])], names)
    store.begin()
    missing = store.missing(range(len(names)))
    rays = checkpoint.sensor.rays()
    with ScanBar("translating", len(missing), len(missing) * (sampler.evaluations(checkpoint.generator) or 0)) as bar:

        def work(item: int) -> None:
            image, xyz = source.with_points(item) if source.measured else (source[item], None)
            made = translate(
                checkpoint, torch.from_numpy(image[None]), [item], seed, sampler=sampler, progress=bar.evaluated
            )
            warn_unsolved(made.converged)
            found = made.images[0].numpy()
            for path in store.files(item):
                path.parent.mkdir(parents=True, exist_ok=True)
                if path.suffix == ".npy":
                    with atomic_write(path) as file:
                        np.save(file, found)
                elif path.suffix == ".label":
                    labels = _labels(source, item, made.filled[0].numpy())
                    _, ordered = image_to_points(np.stack([found[0], labels.astype(np.float32)]), rays)
                    with atomic_write(path) as file:
                        file.write(ordered.astype("<u4").tobytes())
                else:
                    write_points(path, *image_to_points(found, rays, xyz))

        store.make(missing, work, 1, lambda item: bar.finished(missing.index(item) + 1))
    return len(missing)


def _labels(source: ScanSource, item: int, filled: np.ndarray) -> np.ndarray:
    """The label of each pixel, (H, W); a filled one has that of the nearest return, one without a file 0."""
    assert isinstance(source, ScanFiles)
    _, labels = read_labelled_scan(source.paths[item], source.reading)
    if labels is None:
        return np.zeros(filled.shape, np.uint16)
    nearest = distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
    return np.where(filled & (labels == 0), labels[tuple(nearest)], labels)
