"""Panels of a page of `r2flow.reports.view`: scans of files and sets, samples of a generator and their states x_t."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from r2flow.data.opening import find_drives, open_scans, own_reading, parse
from r2flow.data.options import FOLDER, SIMULATED
from r2flow.data.reading import Reading, estimated_scale, read_labelled_scan
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanFiles, ScanSource, SimulatedScans, readable, spread, warn_of_other_sensor
from r2flow.errors import check
from r2flow.generators import as_flow
from r2flow.generators.flow import ode_sampler
from r2flow.lidar.labels import labels_beside
from r2flow.lidar.scan_files import points_beside, read_range_image
from r2flow.model.checkpoint import Checkpoint
from r2flow.noise import Draws
from r2flow.progress import Bar
from r2flow.reports.compare import labels
from r2flow.reports.view import Panel, write_page
from r2flow.samplers import OnGrid
from r2flow.simulator import simulate


def scans_of(path: Path, most: int) -> tuple[list[Path], int]:
    """A scan file, or up to `most` scans of a folder, evenly spread; and the number of all."""
    paths = [Path(scan) for drive in find_drives(FOLDER, path) for scan in drive.scans] if path.is_dir() else [path]
    return [paths[index] for index in spread(len(paths), most)], len(paths)


def one_scale(readings: Mapping[str, Reading], most: int) -> dict[str, Reading]:
    """Readings of sets shown together: those that do not know full reflectance take one estimate from all of them."""
    unknown = [spec for spec, reading in readings.items() if reading.reflectance_scale is None]
    paths = [path for options, file in map(parse, unknown) for path in scans_of(file or options.folder, most)[0]]
    scale = estimated_scale(paths[0], readable(paths, readings[unknown[0]].columns)) if paths else None
    return {**readings, **{spec: replace(readings[spec], reflectance_scale=scale) for spec in unknown}}


def scan_panels(readings: Mapping[str, Reading], most: int, labelled: bool = True) -> Iterator[tuple[str, Panel]]:
    """Sets and a panel for each of up to `most` scans of them (`open_scans`), evenly spread; `labelled`: with ids.

    The caption is the file name, with folders if names are ambiguous. Files not written by r2flow are opened one by
    one, since sizes of range images and reflectance may differ.
    """
    views: list[tuple[str, Path, ScanSet, int]] = []
    for spec, reading in readings.items():
        reading = replace(reading, on_bad_scan="error")
        options, file = parse(spec)
        if own_reading(spec) is None and options.name == FOLDER:
            chosen, total = scans_of(file or options.folder, most)
            warn_of_other_sensor(chosen, reading, spec)
            views += [(spec, path, open_scans(path, reading, own_size=True), 0) for path in chosen]
        else:
            opened = open_scans(spec, reading)
            total = 0 if options.name == SIMULATED else len(opened)  # simulated sets have any size
            scans = opened.spread(most)
            views += [(spec, options.folder / name, scans, i) for i, name in enumerate(scans.source.names)]
        if total > most:
            print(f"{spec}: {most} of its {total:,} scans, evenly spread (--num)")
    for (spec, _, scans, number), caption in zip(views, labels([path for _, path, *_ in views]), strict=True):
        image, classes = _labelled(scans.source, number) if labelled else (scans.source[number], None)
        yield spec, Panel(caption, image[None], scans.sensor.rays(), None if classes is None else classes[None])


def _labelled(source: ScanSource, number: int) -> tuple[np.ndarray, np.ndarray | None]:
    if isinstance(source, SimulatedScans):
        made = simulate(source.sensor, source.seed, source.numbers[number])
        return made.image[: 1 + source.reflectance], made.labels
    if isinstance(source, ScanFiles):
        path = points_beside(Path(source.paths[number]))
        if (file := labels_beside(path)) and read_range_image(path) is None:
            return read_labelled_scan(path, file, replace(source.reading, on_bad_scan="error"))
    return source[number], None


def in_turn(panels: Sequence[Panel], caption: str) -> Panel:
    """Combine panels as frames of one."""
    captions, images, rays, classes, _ = zip(*panels, strict=True)
    for name, image, ray, label, _ in panels[1:]:
        alike = image.shape == images[0].shape and (label is None) == (classes[0] is None) and torch.equal(ray, rays[0])
        check(alike, f"{name} and {captions[0]} differ in size, sensor, reflectance or labels: "
                     "they cannot be frames of one sequence; leave --sequence out.")  # fmt: skip
    numbers = None if classes[0] is None else np.concatenate(classes)
    return Panel(caption, np.concatenate(images), rays[0], numbers, captions)


def sample_panels(flow: Checkpoint, label: str, num: int, seed: int = 0, steps: Sequence[int] = ()) -> list[Panel]:
    """Samples 0 to num - 1 of a seed, a panel each; with `steps`, a panel per number of steps, samples as frames."""
    if steps and flow.generator.fixed:
        steps = [flow.generator.sampler.steps]  # type: ignore[attr-defined]
        print(f"{label} is distilled for {flow.generator.sampler} alone")
    samplers = [flow.generator.choose(steps=count) for count in steps] or [flow.generator.sampler]
    evaluations = num * sum(sampler.evaluations(flow.generator) or 0 for sampler in samplers)
    sets = []
    with Bar("sampling", num * len(samplers), evaluations=evaluations) as bar:
        for sampler in samplers:
            images = flow.sample(num, seed, sampler=sampler, progress=bar.evaluated)
            sets.append(images.nan_to_num(0.0).numpy())
            bar.set(num * len(sets))
    rays, label = flow.sensor.rays(), f"{label}, seed {seed}"
    if not steps:
        return [Panel(f"{label}, sample {number}", image[None], rays) for number, image in enumerate(sets[0])]
    captions = [f"{label}, {count} step{'s' * (count > 1)}" for count in steps]
    frames = [f"sample {number}" for number in range(num)]
    return [Panel(caption, images, rays, None, frames) for caption, images in zip(captions, sets, strict=True)]


def way_panels(
    flow: Checkpoint, label: str, num: int, seed: int = 0, steps: int | None = None, times: int = 9
) -> list[Panel]:
    """Decoded x_t of scans 0 to num - 1 of a seed, at `times` times from t = 0 to 1.

    The flow's ODE solver (the default one for a stochastic sampler) divides its steps evenly between the times.
    """
    generator = as_flow(flow.generator, "x_t")
    solver = ode_sampler(generator).changed(steps=steps)
    if isinstance(solver, OnGrid):
        solver = solver.changed(steps=math.ceil(solver.steps / (times - 1)), grid="uniform")
    x = Draws(seed, range(num)).start(generator.noise_shape)
    grid = [i / (times - 1) for i in range(times)]
    decoded = [flow.encoding.decode(x)]
    with Bar("solving", times - 1, evaluations=(times - 1) * (solver.evaluations(generator) or 0)) as bar:
        for t_0, t_1 in pairwise(grid):
            x = generator.solve(x, t_0, t_1, sampler=solver, progress=bar.evaluated).x
            decoded.append(flow.encoding.decode(x.cpu()))
            bar.set(len(decoded) - 1)
    images = torch.stack(decoded, 1).nan_to_num(0.0).numpy()
    rays, frames = flow.sensor.rays(), [f"t = {t:.3g}" for t in grid]
    return [Panel(f"{label}, seed {seed}, sample {n}", image, rays, None, frames) for n, image in enumerate(images)]


def write_sets(path: Path, sets: Mapping[str, ScanSet], title: str) -> Path:
    """Write a page with one panel per set, with four evenly spread scans as frames."""
    panels = [
        Panel(f"{name}: {scans.label}", scans.spread(4)[:].nan_to_num(0.0).numpy(), scans.sensor.rays())
        for name, scans in sets.items()
    ]
    return write_page(path, panels, title)
