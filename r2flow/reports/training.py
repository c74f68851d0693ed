"""Report at the end of training: loss curve, samples and files."""

import csv
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.model.checkpoint import checkpoints_of, load_checkpoint
from r2flow.reports.outputs import what_next, write_samples
from r2flow.reports.pages import STYLES, blank_figure
from r2flow.reports.pictures import save_figure

Curve = tuple[np.ndarray, np.ndarray]

CURVES = {
    "train/loss": "training loss", "val/loss": "validation loss", "curvature/bend": "bend, s / length²",
}  # fmt: skip


def read_curves(run: str | Path, names: tuple[str, ...] = ("train/loss", "val/loss")) -> dict[str, Curve]:
    """Logged values against optimiser steps, (steps, values) by name.

    Each resumption logs into a new folder; of several values of a step, the last counts.
    """
    values: dict[str, dict[int, float]] = {name: {} for name in names}
    folders = Path(run, "metrics").glob("version_*/metrics.csv")
    numbered = {int(number): path for path in folders if (number := path.parent.name.split("_")[1]).isdecimal()}
    for _, path in sorted(numbered.items()):
        for row in csv.DictReader(path.read_text("utf-8", "replace").rpartition("\n")[0].splitlines()):
            for name in (name for name in names if row.get(name)):
                with suppress(TypeError, ValueError):  # a line cut by a kill or a full disk
                    values[name][int(row["step"]) + 1] = float(row[name])  # Lightning logs the index of the step
    return {
        name: (np.array(sorted(points)), np.array([points[step] for step in sorted(points)]))
        for name, points in values.items()
        if points
    }


def curves_figure(runs: Sequence[tuple[str, Mapping[str, Curve]]]) -> Figure:
    """Plot one panel per logged curve of `CURVES`, one line per run; runs of one label share a style."""
    names = [name for name in CURVES if any(name in curves for _, curves in runs)]
    styles = {label: STYLES[i % len(STYLES)] for i, label in enumerate(dict.fromkeys(label for label, _ in runs))}
    figure = blank_figure(5.5 * len(names), 3.8 + 0.18 * len(styles) * (len(styles) <= len(STYLES)))
    for axes, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        for label, curves in runs:
            if name in curves:
                steps, values = smooth(*curves[name])
                axes.plot(steps, values, **styles[label], ms=4, lw=1.1, markevery=max(len(steps) // 8, 1), label=label)
        axes.set(title=CURVES[name], xlabel="optimiser step")
        shown = np.concatenate([line.get_ydata() for line in axes.lines])
        if 0 < 3 * shown.min() < shown.max():  # else its labels would be 1.11 x 10^0
            axes.set_yscale("log")
        axes.grid(alpha=0.25)
    if len(styles) <= len(STYLES):  # more labels share styles
        handles = {line.get_label(): line for axes in figure.axes for line in axes.lines}
        figure.legend(handles=handles.values(), fontsize=8, loc="outside lower left")  # labels may be long
    return figure


def smooth(steps: np.ndarray, values: np.ndarray) -> Curve:
    """Running mean over a twentieth of the points, at the centre of its steps."""
    width = max(len(values) // 20, 1)
    kernel = np.full(width, 1 / width)
    return np.convolve(steps, kernel, "valid"), np.convolve(values, kernel, "valid")


def finish(run: Path, samples: Mapping[str, Any], seed: int, device: str, finished: bool, kept: bool) -> None:
    """Draw the loss curve and a few scans of a run; print its files and the commands that come next.

    `kept`: the run keeps checkpoints.
    """
    if curves := read_curves(run):
        save_figure(curves_figure([(run.name, curves)]), run / "loss.png")
    if not checkpoints_of(run):
        configured = "no checkpoint was kept, as configured" + (f"; loss curve: {run / 'loss.png'}" if curves else "")
        print("stopped before a checkpoint was kept: the same command starts it again" if kept else configured)
        return
    checkpoint = load_checkpoint(run, device)
    if not finished:
        print(f"stopped at step {checkpoint.step}: the same command resumes from here")
    for name, (steps, values) in curves.items():
        tenth = max(len(values) // 10, 1)
        single = " (single batches: too few to compare)" if tenth == 1 and name.startswith("train/") else ""
        start = f"{values[:tenth].mean():.4f} first, " if len(values) > 1 else ""  # a validation may be late
        print(f"{name}: {start}{values[-tenth:].mean():.4f} at step {steps[-1]}{single}")
    out = run / "samples"
    if samples["num"] == 0 or not checkpoint.generator.draws:
        print(f"checkpoint    {checkpoint.path}")
        return
    write_samples(checkpoint, out, samples["num"], seed, pictures=samples["num"], replace=True)
    during = f"; during training: {run / 'pictures'}" if (run / "pictures").is_dir() else ""
    logged = [str(run / "loss.png")] if curves else []
    logged += [f"tensorboard --logdir {quote(str(run / 'tensorboard'))}"] if (run / "tensorboard").is_dir() else []
    print(
        f"""
checkpoint    {checkpoint.path}
pictures      {out / "samples.png"} and one page per scan next to it{during}
in 3-D        {out / "samples.html"}, in a browser
point clouds  {out / "000000.ply"} ...
loss curve    {"; ".join(logged) or "not logged"}
{what_next(run, out, config=checkpoint.config)}""",
        flush=True,
    )
