"""How straight the paths of trained flows are: the paper's figure 8."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from r2flow.flow.straightness import straightness
from r2flow.generators import as_flow
from r2flow.generators.base import Progress
from r2flow.model.checkpoint import Checkpoint
from r2flow.noise import Draws
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import table

MOST_CURVED = 200  # paths drawn, as in the paper's figure 8 (b)


@dataclass(frozen=True)
class Paths:
    """The paths of one checkpoint; an element is a pixel of range or of reflectance.

    Attributes:
        label: Its name on the page.
        t: Times of the Euler steps, (n,).
        s: s(t) of every scan, (N, n).
        squared_length: |x_1 - x_0|^2 of every scan, (N,).
        elements: Of all scans together.
        bends: int (d - v_t)^2 dt of the most curved elements, the most curved first, (k,).
        trajectories: Their values in model space at 0, 1/n, ..., 1, (k, n + 1).
        dropped: Whether their rays end as dropped, (k,).
        dropped_share: Share of all elements whose rays end as dropped.
        dropped_bend: Share of int s(t) dt on them; NaN where every path is straight.
    """

    label: str
    t: np.ndarray
    s: np.ndarray
    squared_length: np.ndarray
    elements: int
    bends: np.ndarray
    trajectories: np.ndarray
    dropped: np.ndarray
    dropped_share: float
    dropped_bend: float

    @property
    def s_normalised(self) -> np.ndarray:
        """s(t) / |d|^2, (N, n); NaN where a path has no length."""
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

    Takes 2 x steps evaluations a batch; the memory does not grow with `num`.

    Args:
        progress: Called after every evaluation of a batch.

    Raises:
        InputError: fewer than one step.
    """
    flow = as_flow(checkpoint.generator, "curvature")
    scans: list[tuple[Tensor, ...]] = []  # s and squared length of each
    most: list[tuple[Tensor, ...]] = []  # bend, path and end of the most curved of each batch
    sums = np.zeros(4)  # elements, those that end as dropped, the bend of all, the bend of those
    for first in range(0, num, batch_size):
        x_0 = Draws(seed, range(first, min(first + batch_size, num))).start(flow.noise_shape).to(flow.device)
        with torch.inference_mode():
            found = straightness(flow.velocity, x_0, steps, most_curved, progress)
        bends, pixels = found.curvature.per_pixel, found.pixels
        dropped = (checkpoint.encoding.decode(found.curvature.x_1)[:, :1] == 0).expand_as(bends)
        scans.append((found.s, found.curvature.squared_length))
        most.append((bends.flatten()[pixels], found.trajectories, dropped.flatten()[pixels]))
        sums += bends.numel(), dropped.sum().item(), bends.sum().item(), bends[dropped].sum().item()
    s, squared_length = (torch.cat(batches).cpu().numpy() for batches in zip(*scans, strict=True))
    worst, trajectories, ends = (torch.cat(batches).cpu().numpy() for batches in zip(*most, strict=True))
    order = np.argsort(-worst, kind="stable")[:most_curved]
    elements, ends_dropped, bend, bend_of_dropped = map(float, sums)
    return Paths(
        label, found.t.numpy(), s, squared_length, int(elements), worst[order], trajectories[order], ends[order],
        dropped_share=ends_dropped / elements, dropped_bend=bend_of_dropped / bend if bend else math.nan,
    )  # fmt: skip


def curvature_rows(flows: Sequence[Paths]) -> list[dict[str, Any]]:
    """s(t) of every checkpoint and time: mean, least and most over the scans, as it is and over |d|^2."""
    rows = []
    for flow in flows:
        for index, t in enumerate(flow.t):
            row: dict[str, Any] = {"checkpoint": flow.label, "t": float(t)}
            for name in ("s", "s_normalised"):
                values = getattr(flow, name)[:, index]
                row |= {name: float(values.mean()), f"{name}_least": float(values.min())}
                row |= {f"{name}_most": float(values.max())}
            rows.append(row)
    return rows


def summary(flow: Paths) -> dict[str, Any]:
    """One checkpoint in one row."""
    mean = flow.s.mean(0)
    tenths = [_mean(mean[(flow.t >= k / 10) & (flow.t < (k + 1) / 10)]) for k in range(10)]
    ends, middle = min(tenths[0], tenths[-1]), float(np.max(tenths[1:-1]))
    return {
        "checkpoint": flow.label,
        "scenes": len(flow.s),
        "integral": float(mean.mean()),
        "integral_normalised": float(flow.s_normalised.mean()),
        "t_of_most": float(flow.t[mean.argmax()]),
        "first_tenth": _share(mean[flow.t < 0.1], mean),
        "last_tenth": _share(mean[flow.t >= 0.9], mean),
        "ends_over_middle": ends / middle if middle > 0 else math.nan,
        "paths": len(flow.bends),
        "paths_share": len(flow.bends) / flow.elements,
        "paths_dropped": float(flow.dropped.mean()) if len(flow.dropped) else math.nan,
        "dropped_share": flow.dropped_share,
        "dropped_bend": flow.dropped_bend,
    }


def _mean(part: np.ndarray) -> float:
    """Mean; NaN of no steps, as where a path has fewer than ten."""
    return float(part.mean()) if len(part) else math.nan


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    return float(part.sum() / whole.sum()) if whole.sum() else math.nan


COLUMNS = {
    "checkpoint": "checkpoint", "integral": "int s dt", "integral_normalised": "int s dt / length^2",
    "t_of_most": "t of the most", "first_tenth": "share in t < 0.1", "last_tenth": "share in t >= 0.9",
    "paths_dropped": "most curved: ending at ray-drop", "dropped_share": "rays dropped",
    "dropped_bend": "share of curvature on dropped rays",
}  # fmt: skip


def curvature_text(flows: Sequence[Paths]) -> list[str]:
    """What s(t) is, and the flows in a table."""
    summaries = [summary(flow) for flow in flows]
    row = summaries[0]
    about = (
        "s(t) = |(x_1 - x_0) - v(t, x_t)|^2 along the flow's own path (the paper's eq. 5), the mean over "
        f"{row['scenes']} scans from the same noise and {len(flows[0].t)} Euler steps. It is 0 on a straight path, "
        "which one step follows exactly. A flow that goes nowhere is straight too: compare int s dt over the squared "
        f"length |x_1 - x_0|^2. The most curved paths are {row['paths']} ({row['paths_share']:.2%} of all pixels of "
        "range and reflectance)."
    )
    return [about, table(summaries, COLUMNS)]


def curvature_figure(flows: Sequence[Paths]) -> Figure:
    """s(t), as it is and over |d|^2, every checkpoint a line with the range over its scans."""
    figure = blank_figure(10, 4.2)
    panels = {"s": "s(t) = |(x_1 - x_0) - v_t|²", "s_normalised": "s(t) / |x_1 - x_0|²"}
    for axes, (name, label) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        for index, flow in enumerate(flows):
            style, found = STYLES[index % len(STYLES)], getattr(flow, name)
            every = max(len(flow.t) // 8, 1)
            # Markers begin at another step for each line, so that lines on top of each other stay apart.
            marks = (index * every // len(flows), every)
            axes.plot(flow.t, found.mean(0), **style, ms=5, lw=1.4, markevery=marks, label=flow.label)
            if len(found) > 1:
                axes.fill_between(flow.t, found.min(0), found.max(0), color=style["color"], alpha=0.12, lw=0)
        axes.set(xlabel="t  (0 noise, 1 data)", ylabel=label, xlim=(0, 1))
        if any((getattr(flow, name) > 0).any() for flow in flows):
            axes.set_yscale("log")
        axes.grid(True, which="both", color="0.9", lw=0.6)
    figure.axes[0].legend(fontsize=8, framealpha=0.9)
    return figure


def trajectories_figure(flows: Sequence[Paths]) -> Figure:
    """The most curved paths, a panel for each checkpoint: the paper's figure 8 (b)."""
    columns = min(len(flows), 3)
    rows = math.ceil(len(flows) / columns)
    figure, titles = blank_figure(1 + 4.2 * columns, 4.2 * rows), short_labels([flow.label for flow in flows])
    first = None
    for index, flow in enumerate(flows):
        axes = first = figure.add_subplot(rows, columns, index + 1, sharey=first)
        times = np.append(flow.t, 1.0)
        for dropped, style in ((False, {"color": "0.55", "ls": "-"}), (True, {"color": "#b5301c", "ls": (0, (4, 2))})):
            chosen = flow.trajectories[flow.dropped == dropped]
            label = f"ray ends {'dropped' if dropped else 'as a return'}: {len(chosen)}"
            lines = axes.plot(times, chosen.T, lw=0.7, alpha=0.8, **style)
            if lines:
                lines[0].set_label(label)
            axes.scatter(np.ones(len(chosen)), chosen[:, -1], s=9, marker="x" if dropped else "o",
                         lw=0.7, color=style["color"], clip_on=False, zorder=3)  # fmt: skip
        axes.set(xlabel="t  (0 noise, 1 data)", xlim=(0, 1))
        axes.set_title(titles[index], fontsize=9)
        if index % columns == 0:
            axes.set_ylabel("value in model space (dotted: -1, ray-drop)")
        axes.axhline(-1, color="black", lw=0.9, ls=":", zorder=4)
        # below the panel: paths are everywhere in it
        axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False)
    return figure


def short_labels(labels: Sequence[str]) -> list[str]:
    """The last two parts of each path, or as many as tell them apart."""
    parts = [Path(label).parts for label in labels]
    depth = 2
    while depth < max(map(len, parts)) and len({p[-depth:] for p in parts}) < len(set(parts)):
        depth += 1
    return [str(Path(*p[-depth:])) for p in parts]


def curvature_page(flows: Sequence[Paths], seed: int, command: str, device: str = "cpu") -> Page:
    """The report on one checkpoint or several."""
    paths = [
        {"checkpoint": flow.label, "pixel": number, "bend": float(flow.bends[number]),
         "dropped": bool(flow.dropped[number]), "values": [round(float(v), 3) for v in flow.trajectories[number]]}
        for flow in flows
        for number in range(len(flow.bends))
    ]  # fmt: skip
    figures = {"curvature": curvature_figure(flows), "trajectories": trajectories_figure(flows)}
    return Page(
        "curvature", "How straight the flows are", curvature_text(flows), curvature_rows(flows), figures, command,
        {"scenes": seed}, device, {"summary": [summary(flow) for flow in flows], "trajectories": paths},
    )  # fmt: skip
