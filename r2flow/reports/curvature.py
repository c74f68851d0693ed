"""How straight the paths of trained flows are: the paper's figure 8."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow.checkpoints import Checkpoint
from r2flow.flow.straightness import Straightness, straightness
from r2flow.generators import as_flow
from r2flow.lidar.encoding import Encoding
from r2flow.noise import Draws
from r2flow.reports.pages import STYLES, Page, blank_figure
from r2flow.reports.tables import table

MOST_CURVED = 200  # paths drawn, as in the paper's figure 8 (b)
OF_PATHS = ("bends", "trajectories", "dropped")  # fields of `Paths` with an entry for each path that is kept


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
    progress: Callable[[], None] | None = None,
) -> Paths:
    """s(t) over `steps` Euler steps of scans 0 to num - 1 of a seed, and the most curved paths.

    Takes 2 x steps evaluations a batch; the memory does not grow with `num`.

    Args:
        progress: Called after every evaluation of a batch.

    Raises:
        InputError: fewer than one step.
    """
    flow = as_flow(checkpoint.generator, "curvature")
    batches: list[Paths] = []
    for first in range(0, num, batch_size):
        x_0 = Draws(seed, range(first, min(first + batch_size, num))).start(flow.noise_shape).to(flow.device)
        with torch.inference_mode():
            found = straightness(flow.velocity, x_0, steps, most_curved, progress)
        batches.append(_paths(found, checkpoint.encoding, label))
    return _together(batches, most_curved)


def _paths(found: Straightness, encoding: Encoding, label: str) -> Paths:
    curvature = found.curvature
    bends = curvature.per_pixel
    dropped = (encoding.decode(curvature.x_1)[:, :1] == 0).expand_as(bends)
    tensors = (found.t, found.s, curvature.squared_length, bends.flatten()[found.pixels], found.trajectories,
               dropped.flatten()[found.pixels])  # fmt: skip
    t, s, length, most, trajectories, ends = (x.cpu().numpy() for x in tensors)
    share, total = dropped.double().mean().item(), bends.sum().item()
    on_dropped = bends[dropped].sum().item() / total if total else math.nan
    return Paths(label, t, s, length, bends.numel(), most, trajectories, ends, share, on_dropped)


def _together(batches: Sequence[Paths], most_curved: int) -> Paths:
    """The batches of one checkpoint as one."""
    every: dict[str, Any] = {
        name: np.concatenate([getattr(b, name) for b in batches]) for name in ("s", "squared_length", *OF_PATHS)
    }
    most = np.argsort(-every["bends"], kind="stable")[:most_curved]
    totals = np.array([b.s.mean(1).sum() for b in batches])
    elements = np.array([b.elements for b in batches])
    return replace(
        batches[0],
        **every | {name: every[name][most] for name in OF_PATHS},
        elements=int(elements.sum()),
        dropped_share=float(np.average([b.dropped_share for b in batches], weights=elements)),
        dropped_bend=float(np.average([b.dropped_bend for b in batches], weights=totals)) if totals.sum() else math.nan,
    )


def curvature_rows(flows: Sequence[Paths]) -> list[dict[str, Any]]:
    """s(t) of every checkpoint and time: mean, least and most over the scans, as it is and over |d|^2."""
    rows = []
    for flow in flows:
        for index, t in enumerate(flow.t):
            row: dict[str, Any] = {"checkpoint": flow.label, "t": float(t)}
            for name, values in (("s", flow.s[:, index]), ("s_normalised", flow.s_normalised[:, index])):
                row |= {name: float(values.mean()), f"{name}_least": float(values.min())}
                row |= {f"{name}_most": float(values.max())}
            rows.append(row)
    return rows


def summary(flow: Paths) -> dict[str, Any]:
    """One checkpoint in one row."""
    mean = flow.s.mean(0)
    return {
        "checkpoint": flow.label,
        "scenes": len(flow.s),
        "integral": float(mean.mean()),
        "integral_normalised": float(flow.s_normalised.mean()),
        "t_of_most": float(flow.t[mean.argmax()]),
        "first_tenth": _share(mean[flow.t < 0.1], mean),
        "last_tenth": _share(mean[flow.t >= 0.9], mean),
        "paths": len(flow.bends),
        "paths_share": len(flow.bends) / flow.elements,
        "paths_dropped": float(flow.dropped.mean()) if len(flow.dropped) else math.nan,
        "dropped_share": flow.dropped_share,
        "dropped_bend": flow.dropped_bend,
    }


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
    for place, (values, label) in enumerate(
        (
            (lambda flow: flow.s, r"$s(t) = \|(x_1 - x_0) - v_t\|^2$"),
            (lambda flow: flow.s_normalised, r"$s(t)\ /\ \|x_1 - x_0\|^2$"),
        )
    ):
        axes = figure.add_subplot(1, 2, place + 1)
        for index, flow in enumerate(flows):
            style, found = STYLES[index % len(STYLES)], values(flow)
            every = max(len(flow.t) // 8, 1)
            # Markers begin at another step for each line, so that lines on top of each other stay apart.
            marks = (index * every // max(len(flows), 1), every)
            axes.plot(flow.t, found.mean(0), **style, ms=5, lw=1.4, markevery=marks, label=flow.label)
            if len(found) > 1:
                axes.fill_between(flow.t, found.min(0), found.max(0), color=style["color"], alpha=0.12, lw=0)
        axes.set(xlabel="t  (0 noise, 1 data)", ylabel=label, xlim=(0, 1))
        if any((values(flow) > 0).any() for flow in flows):
            axes.set_yscale("log")
        axes.grid(True, which="both", color="0.9", lw=0.6)
        if place == 0:
            axes.legend(fontsize=8, framealpha=0.9)
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
            name = "ray ends dropped" if dropped else "ray ends as a return"
            for number, path in enumerate(chosen):
                label = f"{name}: {len(chosen)}" if number == 0 else None
                axes.plot(times, path, lw=0.7, alpha=0.8, label=label, **style)
            axes.scatter(np.ones(len(chosen)), [p[-1] for p in chosen], s=9, marker="x" if dropped else "o",
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
    return Page(
        "curvature",
        "How straight the flows are",
        curvature_text(flows),
        curvature_rows(flows),
        {"curvature": curvature_figure(flows), "trajectories": trajectories_figure(flows)},
        command,
        seeds={"scenes": seed},
        device=device,
        more={"summary": [summary(flow) for flow in flows], "trajectories": paths},
    )
