"""What a page of `r2flow.reports.view` can show: scans of files and sets, samples of a generator, its way to them."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError
from r2flow.generators import as_flow
from r2flow.generators.flow import ode_sampler
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.sampling import sample
from r2flow.noise import Draws
from r2flow.reports.outputs import ScanBar, warn_unsolved
from r2flow.reports.view import write_page
from r2flow.reports.views import View
from r2flow.samplers import OnGrid


class Panel(NamedTuple):
    """One scan of a page, or several in the slider's turn.

    Attributes:
        images: (T, 2 or 1, H, W).
        rays: (2, H, W).
        labels: (T, H, W), or None.
    """

    caption: str
    images: np.ndarray
    rays: Tensor
    labels: np.ndarray | None = None


def write_panels(path: str | Path, panels: Sequence[Panel], frames: Sequence[str] = (), title: str = "r2flow") -> Path:
    """Write the page of some panels."""
    captions, images, rays, labels = zip(*panels, strict=True) if panels else ((), (), (), ())
    return write_page(path, images, rays, captions, frames=frames, labels=labels, title=title)


def scan_panels(views: Sequence[View]) -> list[Panel]:
    """A panel for each scan, named by its file; by its folder too, where two files have one name."""
    shared = Counter(view.path.name for view in views)
    panels = []
    for view in views:
        image, labels = view.labelled()
        caption = view.path.name if shared[view.path.name] == 1 else f"{view.path.parent.name}/{view.path.name}"
        panels.append(Panel(caption, image[None], view.rays, None if labels is None else labels[None]))
    return panels


def in_turn(panels: Sequence[Panel], caption: str) -> tuple[Panel, list[str]]:
    """Panels as one, each a frame, and what the slider says."""
    captions, images, rays, labels = zip(*panels, strict=True)
    for name, image, ray, label in panels[1:]:
        alike = image.shape == images[0].shape and (label is None) == (labels[0] is None)
        if not alike or not torch.equal(ray, rays[0]):
            raise InputError(f"{name} and {captions[0]} differ in size, sensor, reflectance or labels: "
                             "they cannot be frames of one sequence; leave --sequence out.")  # fmt: skip
    numbers = None if labels[0] is None else np.concatenate(labels)
    return Panel(caption, np.concatenate(images), rays[0], numbers), list(captions)


def sample_panels(flow: Checkpoint, label: str, num: int, seed: int = 0, steps: Sequence[int] = ()) -> list[Panel]:
    """Scans 0 to num - 1 of a seed, a panel each; with `steps`, a panel for each number of steps, a scan each frame."""
    samplers = [flow.generator.choose(steps=count) for count in steps] or [flow.generator.sampler]
    evaluations = num * sum(one.evaluations(flow.generator) or 0 for one in samplers)
    drawn = []
    with ScanBar("sampling", num * len(samplers), evaluations) as bar:
        for one in samplers:
            made = list(sample(flow, num, seed, sampler=one, progress=bar.evaluated))
            for batch in made:
                warn_unsolved(batch.converged, batch.first)
            drawn.append(torch.cat([batch.images for batch in made]).nan_to_num(0.0).numpy())
            bar.set(num * len(drawn))
    rays, label = flow.sensor.rays(), f"{label}, seed {seed}"
    if not steps:
        return [Panel(f"{label}, sample {number}", image[None], rays) for number, image in enumerate(drawn[0])]
    captions = [f"{label}, {count} step{'s' * (count > 1)}" for count in steps]
    return [Panel(caption, images, rays) for caption, images in zip(captions, drawn, strict=True)]


def way_panels(
    flow: Checkpoint, label: str, num: int, seed: int = 0, steps: int | None = None, times: int = 9
) -> tuple[list[Panel], list[str]]:
    """x_t of scans 0 to num - 1 of a seed at `times` times from t = 0 to 1, decoded, and what the slider says.

    Between two times the flow's own solver takes its share of the steps, at least one, or the usual one where its own
    draws noise.
    """
    solved = as_flow(flow.generator, "x_t")
    share = ode_sampler(solved).changed(steps=steps)
    if isinstance(share, OnGrid):
        share = share.changed(steps=math.ceil(share.steps / (times - 1)), grid="uniform")
    x = Draws(seed, range(num)).start(solved.noise_shape)
    at = [i / (times - 1) for i in range(times)]
    decoded = [flow.encoding.decode(x)]
    with ScanBar("solving", times - 1, (times - 1) * (share.evaluations(solved) or 0)) as bar:
        for t_0, t_1 in pairwise(at):
            x = solved.solve(x, t_0, t_1, sampler=share, progress=bar.evaluated).x
            decoded.append(flow.encoding.decode(x.cpu()))
            bar.set(len(decoded) - 1)
    images = torch.stack(decoded, 1).nan_to_num(0.0).numpy()
    rays, label = flow.sensor.rays(), f"{label}, seed {seed}"
    panels = [Panel(f"{label}, sample {number}", image, rays) for number, image in enumerate(images)]
    return panels, [f"t = {t:.3g}" for t in at]


def write_sets(path: str | Path, sets: Mapping[str, ScanSet], num: int = 4, title: str = "r2flow") -> Path:
    """A panel for each set, a slider through `num` scans of each, evenly spread."""
    panels = []
    for name, scans in sets.items():
        some = scans.spread(num)
        if len(some):
            images = some.source.batch(range(len(some))).nan_to_num(0.0).numpy()
            panels.append(Panel(f"{name}: {scans.label}", images, scans.sensor.rays()))
    return write_panels(path, panels, title=title)
