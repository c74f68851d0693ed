"""Straightness of the paths of trained flows: the paper's figure 8."""

import logging
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow.base.noise import Draws
from r2flow.base.progress import Bar
from r2flow.flow.straightness import Straightness, straightness
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.reports.figures import Plot, blank_figure, lines_figure
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table, short_names

_log = logging.getLogger(__name__)

_COLUMNS = {
    "checkpoint": "checkpoint",
    "integral": "int s dt",
    "integral_normalised": "bend: int s dt / length^2",
}
_Flows = Mapping[str, Straightness]  # by label

_TIME = "t  (0 noise, 1 data)"


def report_curvature(
    models: Sequence[str],
    num: int = 4,
    steps: int = 256,
    seed: int = 0,
    batch_size: int = 1,
    device: str = "cpu",
) -> Page:
    """The page of the straightness of trained flows, by name, along paths of `steps` Euler steps of
    scans 0 to num - 1 of a seed.

    Raises:
        InputError: a model that is no flow from noise.
    """
    loaded = {name: load_checkpoint(name, device) for name in dict.fromkeys(models)}
    for name, checkpoint in loaded.items():
        as_flow(checkpoint.generator, f"{name}: curvature")
    evaluations = len(loaded) * math.ceil(num / batch_size) * steps
    with Bar("measuring", evaluations, "evaluations") as advance:
        flows = {
            name: measure_paths(checkpoint, name, num, steps, seed, batch_size, progress=advance)
            for name, checkpoint in loaded.items()
        }
    return curvature_page(flows, seed, device)


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

    Each batch takes `steps` evaluations, with a call of `progress` after each, and keeps as many
    images per scan.
    """
    flow = as_flow(checkpoint.generator, "curvature")
    parts = []
    for first in range(0, num, batch_size):
        numbers = range(first, min(first + batch_size, num))
        x_0 = Draws(seed, numbers).start(flow.noise_shape).to(flow.device)
        with torch.inference_mode():
            parts.append(straightness(flow.velocity, x_0, steps, most_curved, progress))
    joined = [torch.cat(part).cpu() for part in zip(*parts, strict=True)]
    _, s, squared_length, bends, trajectories = joined
    broken = int((~s.isfinite().all(1)).sum())
    if broken:
        _log.warning("%s: s(t) is not finite for %d of %d scans.", label, broken, len(s))
    order = bends.argsort(descending=True, stable=True)[:most_curved]
    return Straightness(parts[0].t, s, squared_length, bends[order], trajectories[order])


def _curvature_rows(flows: _Flows) -> list[Row]:
    """s(t) per checkpoint and time, mean over scans, unnormalised and over |d|^2."""
    rows = []
    for label, flow in flows.items():
        means = torch.stack([flow.t, flow.s.mean(0), flow.s_normalised.mean(0)], 1)
        for t, s, normalised in means.tolist():
            rows.append({"checkpoint": label, "t": t, "s": s, "s_normalised": normalised})
    return rows


def summary(label: str, flow: Straightness) -> Row:
    """Integrals of s(t) of a flow, means over scans."""
    return {
        "checkpoint": label,
        "scans": len(flow.s),
        "integral": float(flow.s.mean()),
        "integral_normalised": float(flow.s_normalised.mean()),
    }


def curvature_text(flows: _Flows) -> list[Part]:
    """Text: definition of s(t), and the table of flows."""
    first = next(iter(flows.values()))
    about = (
        "s(t) = |(x_1 - x_0) - v(t, x_t)|^2 along the flow's own path (the paper's eq. 6), the "
        "mean over "
        f"{len(first.s)} scans from the same noise and {len(first.t)} Euler steps. It is 0 on a "
        "straight "
        "path, which one step follows exactly. An untrained flow with v = 0 is straight too: "
        "compare int s dt over "
        "the squared length |x_1 - x_0|^2."
    )
    return [about, Table([summary(*flow) for flow in flows.items()], _COLUMNS)]


def curvature_figure(flows: _Flows) -> Figure:
    """Plot s(t), mean over scans, unnormalised and over |d|^2: one line per checkpoint."""
    plain = {label: (flow.t, flow.s.mean(0)) for label, flow in flows.items()}
    normalised = {label: (flow.t, flow.s_normalised.mean(0)) for label, flow in flows.items()}
    plots = [
        Plot(_TIME, "s(t) = |(x_1 - x_0) - v_t|²", plain),
        Plot(_TIME, "s(t) / |x_1 - x_0|²", normalised),
    ]
    return lines_figure(plots, 2)


def trajectories_figure(flows: _Flows) -> Figure:
    """Plot the most curved paths, one panel per checkpoint: the paper's figure 8 (b)."""
    figure = blank_figure(1 + 4.2 * len(flows), 4.2)
    panels = figure.subplots(1, len(flows), sharey=True, squeeze=False)[0]
    titles = short_names(list(flows))
    for axes, flow, title in zip(panels, flows.values(), titles, strict=True):
        t = np.append(flow.t, 1.0)
        axes.plot(t, flow.trajectories.T.numpy(), lw=0.7, alpha=0.8, color="0.55")
        axes.axhline(-1, color="black", lw=0.9, ls=":", zorder=4)
        axes.set(xlabel=_TIME, ylabel="value in model space (dotted: -1, ray-drop)")
        axes.set_title(title, fontsize=9)
    return figure


def curvature_page(flows: _Flows, seed: int, device: str = "cpu") -> Page:
    """Build the page of the straightness of flows."""
    return Page(
        "curvature",
        "Straightness of flows",
        curvature_text(flows),
        _curvature_rows(flows),
        {"curvature": curvature_figure(flows), "trajectories": trajectories_figure(flows)},
        {"scans": seed},
        device,
        {"summary": [summary(*flow) for flow in flows.items()]},
    )
