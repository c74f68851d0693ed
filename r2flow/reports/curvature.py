"""Straightness of the paths of trained flows: the paper's figure 8."""

import logging
import math
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow.flow.straightness import Straightness, straightness
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.model.checkpoint import Checkpoint
from r2flow.noise import Draws
from r2flow.reports.compare import labels
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import table

log = logging.getLogger(__name__)


def measure_paths(
    checkpoint: Checkpoint,
    label: str,
    num: int = 4,
    steps: int = 256,
    seed: int = 0,
    batch_size: int = 1,
    most_curved: int = 200,  # as in the paper's figure 8 (b)
    progress: Progress = None,
) -> Straightness:
    """s(t) over `steps` Euler steps of scans 0 to num - 1 of a seed, and the most curved paths.

    Each batch takes `steps` evaluations, with a call of `progress` after each, and keeps as many images per scan.
    """
    flow = as_flow(checkpoint.generator, "curvature")
    parts = []
    for first in range(0, num, batch_size):
        x_0 = Draws(seed, range(first, min(first + batch_size, num))).start(flow.noise_shape).to(flow.device)
        with torch.inference_mode():
            parts.append(straightness(flow.velocity, x_0, steps, most_curved, progress))
    _, s, squared_length, bends, trajectories = (torch.cat(part).cpu() for part in zip(*parts, strict=True))
    if broken := int((~s.isfinite().all(1)).sum()):
        log.warning("%s: s(t) is not finite for %d of %d scans.", label, broken, len(s))
    order = bends.argsort(descending=True, stable=True)[:most_curved]
    return Straightness(parts[0].t, s, squared_length, bends[order], trajectories[order])


def curvature_rows(flows: Mapping[str, Straightness]) -> list[dict[str, Any]]:
    """s(t) per checkpoint and time, mean over scans, unnormalised and over |d|^2."""
    return [
        {"checkpoint": label, "t": float(t), "s": float(s), "s_normalised": float(normalised)}
        for label, flow in flows.items()
        for t, s, normalised in zip(flow.t, flow.s.mean(0), flow.s_normalised.mean(0), strict=True)
    ]


def summary(label: str, flow: Straightness) -> dict[str, Any]:
    mean = flow.s.mean(0)
    total = float(mean.sum()) or math.nan
    return {
        "checkpoint": label,
        "scans": len(flow.s),
        "integral": float(mean.mean()),
        "integral_normalised": float(flow.s_normalised.mean()),
        "t_of_most": float(flow.t[mean.argmax()]),
        "first_tenth": float(mean[flow.t < 0.1].sum() / total),
        "last_tenth": float(mean[flow.t >= 0.9].sum() / total),
    }


COLUMNS = {
    "checkpoint": "checkpoint", "integral": "int s dt", "integral_normalised": "bend: int s dt / length^2",
    "t_of_most": "t of the maximum", "first_tenth": "share in t < 0.1", "last_tenth": "share in t >= 0.9",
}  # fmt: skip


def curvature_text(flows: Mapping[str, Straightness]) -> list[str]:
    """Text: definition of s(t), and the table of flows."""
    first = next(iter(flows.values()))
    about = (
        "s(t) = |(x_1 - x_0) - v(t, x_t)|^2 along the flow's own path (the paper's eq. 6), the mean over "
        f"{len(first.s)} scans from the same noise and {len(first.t)} Euler steps. It is 0 on a straight "
        "path, which one step follows exactly. An untrained flow with v = 0 is straight too: compare int s dt over "
        "the squared length |x_1 - x_0|^2."
    )
    return [about, table([summary(*flow) for flow in flows.items()], COLUMNS)]


def curvature_figure(flows: Mapping[str, Straightness]) -> Figure:
    """Plot s(t), unnormalised and over |d|^2: one line per checkpoint, with the range over scans."""
    figure = blank_figure(10, 4.2)
    panels = {"s": "s(t) = |(x_1 - x_0) - v_t|²", "s_normalised": "s(t) / |x_1 - x_0|²"}
    for axes, (name, label) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        for (checkpoint, flow), style in zip(flows.items(), cycle(STYLES), strict=False):
            values, interval = getattr(flow, name), max(len(flow.t) // 8, 1)
            axes.plot(flow.t, values.mean(0), **style, ms=5, lw=1.4, markevery=interval, label=checkpoint)
            axes.fill_between(flow.t, values.amin(0), values.amax(0), color=style["color"], alpha=0.12, lw=0)
        axes.set(xlabel="t  (0 noise, 1 data)", ylabel=label, xlim=(0, 1))
        if any((getattr(flow, name) > 0).any() for flow in flows.values()):
            axes.set_yscale("log")
        axes.grid(True, which="both", color="0.9", lw=0.6)
    figure.axes[0].legend(fontsize=8, framealpha=0.9)
    return figure


def trajectories_figure(flows: Mapping[str, Straightness]) -> Figure:
    """Plot the most curved paths, one panel per checkpoint: the paper's figure 8 (b)."""
    figure = blank_figure(1 + 4.2 * len(flows), 4.2)
    panels = figure.subplots(1, len(flows), sharey=True, squeeze=False)[0]
    for axes, flow, title in zip(panels, flows.values(), labels([Path(label) for label in flows]), strict=True):
        axes.plot(np.append(flow.t, 1.0), flow.trajectories.T.numpy(), lw=0.7, alpha=0.8, color="0.55")
        axes.set(xlabel="t  (0 noise, 1 data)", xlim=(0, 1))
        axes.set_title(title, fontsize=9)
        axes.axhline(-1, color="black", lw=0.9, ls=":", zorder=4)
    panels[0].set_ylabel("value in model space (dotted: -1, ray-drop)")
    return figure


def curvature_page(flows: Mapping[str, Straightness], seed: int, device: str = "cpu") -> Page:
    figures = {"curvature": curvature_figure(flows), "trajectories": trajectories_figure(flows)}
    return Page(
        "curvature", "Straightness of flows", curvature_text(flows), curvature_rows(flows), figures,
        {"scans": seed}, device, {"summary": [summary(*flow) for flow in flows.items()]},
    )  # fmt: skip
