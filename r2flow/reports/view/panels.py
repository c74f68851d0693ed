"""Panels of a page of `r2flow.reports.view`: scans of sets, and samples of a generator."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray

from r2flow.base.errors import InputError
from r2flow.base.progress import Bar
from r2flow.data.opening import SOURCES, describe, find_drives, open_scans
from r2flow.data.options import FOLDER, SIMULATED
from r2flow.data.reading import Reading, estimated_scale, read_labelled_scan
from r2flow.data.sets import ScanSet
from r2flow.data.sources import (
    ScanFiles,
    ScanSource,
    SimulatedScans,
    readable,
    spread,
    warn_of_other_sensor,
)
from r2flow.lidar.labels import SEMANTIC_KITTI, labels_beside
from r2flow.lidar.scan_files import points_beside, read_range_image
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.tables import short_names
from r2flow.reports.view import Panel, panel_of, write_viewer
from r2flow.simulator import simulate


def list_scans(path: Path, most: int) -> tuple[list[Path], int]:
    """A scan file, or up to `most` scans of a folder or `NAME:FOLDER`, evenly spread; and the
    number of all.
    """
    name, _, root = str(path).partition(":")
    if name in SOURCES and not path.exists():
        drives = find_drives(name, root)
    elif path.is_dir():
        drives = find_drives(FOLDER, path)
    else:
        return [path], 1
    paths = [Path(scan) for drive in drives for scan in drive.scans]
    return [paths[index] for index in spread(len(paths), most)], len(paths)


def share_scale(readings: Mapping[str, Reading], most: int) -> dict[str, Reading]:
    """Readings of sets shown together: those without full reflectance take one estimate from all of
    them.
    """
    unknown = [spec for spec, reading in readings.items() if reading.reflectance_scale is None]
    paths = []
    for scans in map(describe, unknown):
        paths += list_scans(scans.file or scans.options.folder, most)[0]
    if not paths:
        return dict(readings)
    scale = estimated_scale(paths[0], readable(paths, readings[unknown[0]].columns))
    scaled = {spec: replace(readings[spec], reflectance_scale=scale) for spec in unknown}
    return {**readings, **scaled}


def scan_panels(readings: Mapping[str, Reading], most: int) -> Iterator[tuple[str, Panel]]:
    """Sets and a panel for each of up to `most` scans of them, evenly spread, with their labels.

    The caption is the file name, with folders if names are ambiguous. Files not written by r2flow
    are opened one by one, since sizes of range images and reflectance may differ.
    """
    views = []
    for spec, reading in readings.items():
        reading = replace(reading, on_bad_scan="error")
        described = describe(spec)
        options = described.options
        if described.stored is None and options.name == FOLDER:
            chosen, total = list_scans(described.file or options.folder, most)
            warn_of_other_sensor(chosen, reading, spec)
            views += [(spec, path, open_scans(path, reading, own_size=True), 0) for path in chosen]
        else:
            opened = open_scans(spec, reading)
            total = len(opened)
            scans = opened.spread(most)
            names = enumerate(scans.source.names)
            views += [(spec, options.folder / name, scans, number) for number, name in names]
        if total > most and options.name != SIMULATED:  # simulated sets have any size
            print(f"{spec}: {most} of its {total:,} scans, evenly spread (--num)")
    captions = short_names([path for _, path, *_ in views])
    for (spec, _, scans, number), caption in zip(views, captions, strict=True):
        image = scans.source[number]
        classes = _read_labels(scans.source, number)
        yield spec, Panel(caption, image[None], scans.sensor.rays(), classes)


def _read_labels(source: ScanSource, number: int) -> ndarray | None:
    """Semantic ids of a scan, (1, H, W), if it has any."""
    if isinstance(source, SimulatedScans):
        return simulate(source.sensor, source.seed, source.numbers[number]).labels[None]
    if isinstance(source, ScanFiles):
        path = points_beside(Path(source.paths[number]))
        file = labels_beside(path)
        if file and read_range_image(path) is None:
            reading = replace(source.reading, on_bad_scan="error")
            # ids of an unknown list are shown by their numbers
            ids = None if reading.label_ids is SEMANTIC_KITTI else reading.label_ids
            return read_labelled_scan(path, file, reading, ids)[1][None]
    return None


def as_frames(panels: Sequence[Panel], caption: str) -> Panel:
    """Combine panels as frames of one."""
    captions, images, rays, classes, _ = zip(*panels, strict=True)
    for panel in panels[1:]:
        same_labels = (panel.labels is None) == (classes[0] is None)
        same_image = panel.images.shape == images[0].shape and torch.equal(panel.rays, rays[0])
        if not (same_labels and same_image):
            raise InputError(
                f"{panel.caption} and {captions[0]} differ in size, sensor, reflectance or labels: "
                "they cannot be "
                "frames of one sequence; leave --sequence out."
            )
    numbers = None if classes[0] is None else np.concatenate(classes)
    return Panel(caption, np.concatenate(images), rays[0], numbers, captions)


def sample_panels(
    flow: Checkpoint, label: str, num: int, seed: int = 0, steps: Sequence[int] = ()
) -> list[Panel]:
    """Samples 0 to num - 1 of a seed, a panel each; with `steps`, a panel per number of steps,
    samples as frames.
    """
    generator = flow.generator
    samplers = [generator.choose(steps=count) for count in steps] or [generator.sampler]
    rays = flow.sensor.rays()
    evaluations = num * sum(sampler.evaluations(generator) or 0 for sampler in samplers)
    drawn = []
    with Bar("sampling", num * len(samplers), evaluations=evaluations) as bar:
        for sampler in samplers:
            images = flow.sample(num, seed, sampler=sampler, progress=bar.evaluated)
            drawn.append(images.nan_to_num(0.0).numpy())
            bar.set(num * len(drawn))
    label = f"{label}, seed {seed}"
    if not steps:
        return [
            panel_of(f"{label}, sample {number}", image[None], rays)
            for number, image in enumerate(drawn[0])
        ]
    frames = [f"sample {number}" for number in range(num)]
    return [
        panel_of(f"{label}, {count} step{'s' if count > 1 else ''}", images, rays, frames)
        for count, images in zip(steps, drawn, strict=True)
    ]


def write_sets(path: Path, sets: Mapping[str, ScanSet], title: str) -> Path:
    """Write a page with one panel per set, with four evenly spread scans as frames."""
    panels = []
    for name, scans in sets.items():
        images = scans.spread(4)[:].nan_to_num(0.0).numpy()
        panels.append(Panel(f"{name}: {scans.label}", images, scans.sensor.rays()))
    return write_viewer(path, panels, title)
