"""Panels of a page of `r2flow.reports.view`: scans of sets, and samples of a generator."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray

from r2flow.base.errors import check
from r2flow.base.progress import Bar
from r2flow.data.described import Described
from r2flow.data.files import ScanFiles
from r2flow.data.opening import open_each, open_scans
from r2flow.data.options import FOLDER, SIMULATED
from r2flow.data.reading import Reading, read_errors, read_labelled_scan
from r2flow.data.reflectance import estimated_scale
from r2flow.data.sensor_checks import readable, warn_of_other_sensor
from r2flow.data.sets import ScanSet
from r2flow.data.simulated import SimulatedScans
from r2flow.data.sources import ScanSource
from r2flow.lidar.labels import SEMANTIC_KITTI, labels_beside
from r2flow.lidar.scan_files import points_beside, read_range_image
from r2flow.model.checkpoint import Checkpoint
from r2flow.reports.tables import short_names
from r2flow.reports.view import Panel, panel_of, write_viewer
from r2flow.simulator import simulate


def share_scale(readings: Mapping[Described, Reading], most: int) -> dict[Described, Reading]:
    """Readings of sets shown together: those without full reflectance take one estimate from all of
    them.
    """
    unknown = [scans for scans, reading in readings.items() if reading.reflectance_scale is None]
    paths = [path for scans in unknown for path in scans.some(most)]
    if not paths:
        return dict(readings)
    points = readable(paths, readings[unknown[0]].columns)
    scale = estimated_scale(paths[0], points.values())
    scaled = {scans: replace(readings[scans], reflectance_scale=scale) for scans in unknown}
    return {**readings, **scaled}


def scan_panels(
    readings: Mapping[Described, Reading], most: int
) -> Iterator[tuple[Described, Panel]]:
    """Sets and a panel for each of up to `most` scans of them, evenly spread, with their labels.

    The caption is the file name, with folders if names are ambiguous. Files not written by r2flow
    are opened one by one, since sizes of range images and reflectance may differ.
    """
    views: list[tuple[Described, Path, ScanSet, int]] = []
    for scans, reading in readings.items():
        reading = replace(reading, on_bad_scan="error")
        if scans.stored is None and scans.options.name == FOLDER:
            warn_of_other_sensor(scans, reading)
            total = len(scans.paths)
            paths = scans.some(most)
            each = open_each(scans, paths, reading)
            views += [(scans, Path(path), one, 0) for path, one in zip(paths, each, strict=True)]
        else:
            opened = open_scans(scans, reading)
            total = len(opened)
            some = opened.spread(most)
            folder = Path(str(scans.options.root or ""))
            names = enumerate(some.source.names)
            views += [(scans, folder / name, some, number) for number, name in names]
        if total > most and scans.options.name != SIMULATED:  # simulated sets have any size
            print(f"{scans.label}: {most} of its {total:,} scans, evenly spread (--num)")
    captions = short_names([path for _, path, *_ in views])
    for (scans, _, opened, number), caption in zip(views, captions, strict=True):
        image = opened.source[number]
        classes = _read_labels(opened.source, number)
        errors = None
        if isinstance(opened.source, ScanFiles):
            errors = read_errors(Path(opened.source.paths[number]), opened.source.reading)
        yield scans, Panel(caption, image[None], opened.sensor.rays(), classes, errors=errors)


def _read_labels(source: ScanSource, number: int) -> ndarray | None:
    """Semantic ids of a scan, (1, H, W), if it has any."""
    if isinstance(source, SimulatedScans):
        return simulate(source.sensor, source.seed, source.numbers[number]).labels[None]
    if isinstance(source, ScanFiles):
        path = points_beside(Path(source.paths[number]))
        file = labels_beside(path)
        if file and read_range_image(path) is None:
            # ids of an unknown list are shown by their numbers
            ids = source.reading.label_ids
            listed = None if ids is SEMANTIC_KITTI else ids
            return read_labelled_scan(path, file, source.reading, listed)[1][None]
    return None


def as_frames(panels: Sequence[Panel], caption: str) -> Panel:
    """Combine panels as frames of one."""
    captions, images, rays, classes, _, errors = zip(*panels, strict=True)
    for panel in panels:
        kinds = {(x.images.shape, x.labels is None, x.errors is None) for x in (panel, panels[0])}
        check(
            len(kinds) == 1 and torch.equal(panel.rays, rays[0]),
            f"{panel.caption} and {captions[0]} differ in size, sensor, reflectance, labels or "
            "predicted errors: they cannot be frames of one sequence; leave --sequence out.",
        )
    joined = [None if x[0] is None else np.concatenate(x) for x in (classes, errors)]
    return Panel(caption, np.concatenate(images), rays[0], joined[0], captions, joined[1])


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
