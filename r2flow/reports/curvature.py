"""Straightness of the paths of trained flows: the paper's figure 8."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow.flow.straightness import straightness
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.model.checkpoint import Checkpoint
from r2flow.noise import Draws
from r2flow.reports.compare import labels
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import table

log = logging.getLogger(__name__)

MOST_CURVED = 200  # paths drawn, as in the paper's figure 8 (b)


@dataclass(frozen=True)
class Paths:
    """Paths of one checkpoint."""

    label: str
    t: np.ndarray  # times of the Euler steps, (n,)
    s: np.ndarray  # s(t) of every scan, (N, n)
    squared_length: np.ndarray  # |x_1 - x_0|^2 of every scan, (N,)
    trajectories: np.ndarray  # the most curved pixels first, in model space at 0, 1/n, ..., 1, (k, n + 1)

    @property
    def s_normalised(self) -> np.ndarray:
        """s(t) / |d|^2, (N, n); NaN for paths of length 0."""
        with np.errstate(invalid="ignore"):
            return self.s / self.squared_length[:, None]


def measure_paths(
    checkpoint: Checkpoint,
    label: str,
    num: int = 4,
    steps: int = 256,
    seed: int = 0,
    batch_size: int = 1,
    most_curved: int = MOST_CURVED,
    progress: Progress = None,
) -> Paths:
    """s(t) over `steps` Euler steps of scans 0 to num - 1 of a seed, and the most curved paths.

    Each batch takes 2 x steps evaluations, with a call of `progress` after each; memory does not grow with `num`.
    """
    flow = as_flow(checkpoint.generator, "curvature")
    parts = []
    for first in range(0, num, batch_size):
        x_0 = Draws(seed, range(first, min(first + batch_size, num))).start(flow.noise_shape).to(flow.device)
        with torch.inference_mode():
            batch = straightness(flow.velocity, x_0, steps, most_curved, progress)
        bends = batch.curvature.per_pixel.flatten()[batch.pixels]
        parts.append((batch.s, batch.curvature.squared_length, bends, batch.trajectories))
    s, squared_length, curvature, trajectories = (torch.cat(part).cpu().numpy() for part in zip(*parts, strict=True))
    if not np.isfinite(s).all():
        log.warning("%s: s(t) is not finite for %d of %d scans.", label, (~np.isfinite(s).all(1)).sum(), len(s))
    order = np.argsort(-curvature, kind="stable")[:most_curved]
    return Paths(label, batch.t.numpy(), s, squared_length, trajectories[order])


def curvature_rows(flows: Sequence[Paths]) -> list[dict[str, Any]]:
    """s(t) per checkpoint and time, mean over scans, unnormalised and over |d|^2."""
    return [
        {"checkpoint": flow.label, "t": float(t), "s": float(s), "s_normalised": float(normalised)}
        for flow in flows
        for t, s, normalised in zip(flow.t, flow.s.mean(0), flow.s_normalised.mean(0), strict=True)
    ]


def summary(flow: Paths) -> dict[str, Any]:
    mean = flow.s.mean(0)
    total = mean.sum() or math.nan
    return {
        "checkpoint": flow.label,
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


def curvature_text(flows: Sequence[Paths]) -> list[str]:
    """Text: definition of s(t), and the table of flows."""
    about = (
        "s(t) = |(x_1 - x_0) - v(t, x_t)|^2 along the flow's own path (the paper's eq. 6), the mean over "
        f"{len(flows[0].s)} scans from the same noise and {len(flows[0].t)} Euler steps. It is 0 on a straight "
        "path, which one step follows exactly. An untrained flow with v = 0 is straight too: compare int s dt over "
        "the squared length |x_1 - x_0|^2."
    )
    return [about, table([summary(flow) for flow in flows], COLUMNS)]


def curvature_figure(flows: Sequence[Paths]) -> Figure:
    """Plot s(t), unnormalised and over |d|^2: one line per checkpoint, with the range over scans."""
    figure = blank_figure(10, 4.2)
    panels = {"s": "s(t) = |(x_1 - x_0) - v_t|²", "s_normalised": "s(t) / |x_1 - x_0|²"}
    for axes, (name, label) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        for flow, style in zip(flows, cycle(STYLES), strict=False):
            values, interval = getattr(flow, name), max(len(flow.t) // 8, 1)
            axes.plot(flow.t, values.mean(0), **style, ms=5, lw=1.4, markevery=interval, label=flow.label)
            axes.fill_between(flow.t, values.min(0), values.max(0), color=style["color"], alpha=0.12, lw=0)
        axes.set(xlabel="t  (0 noise, 1 data)", ylabel=label, xlim=(0, 1))
        if any((getattr(flow, name) > 0).any() for flow in flows):
            axes.set_yscale("log")
        axes.grid(True, which="both", color="0.9", lw=0.6)
    figure.axes[0].legend(fontsize=8, framealpha=0.9)
    return figure


def trajectories_figure(flows: Sequence[Paths]) -> Figure:
    """Plot the most curved paths, one panel per checkpoint: the paper's figure 8 (b)."""
    figure = blank_figure(1 + 4.2 * len(flows), 4.2)
    panels = figure.subplots(1, len(flows), sharey=True, squeeze=False)[0]
    for axes, flow, title in zip(panels, flows, labels([Path(flow.label) for flow in flows]), strict=True):
        axes.plot(np.append(flow.t, 1.0), flow.trajectories.T, lw=0.7, alpha=0.8, color="0.55")
        axes.set(xlabel="t  (0 noise, 1 data)", xlim=(0, 1))
        axes.set_title(title, fontsize=9)
        axes.axhline(-1, color="black", lw=0.9, ls=":", zorder=4)
    panels[0].set_ylabel("value in model space (dotted: -1, ray-drop)")
    return figure


def curvature_page(flows: Sequence[Paths], seed: int, device: str = "cpu") -> Page:
    figures = {"curvature": curvature_figure(flows), "trajectories": trajectories_figure(flows)}
    return Page(
        "curvature", "Straightness of flows", curvature_text(flows), curvature_rows(flows), figures,
        {"scans": seed}, device, {"summary": [summary(flow) for flow in flows]},
    )  # fmt: skip
