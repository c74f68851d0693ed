"""Report at the end of training: loss curve, samples and files."""

import csv
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from shlex import quote

import numpy as np
from matplotlib.figure import Figure
from numpy import ndarray

from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.paths import checkpoints_of
from r2flow.reports.figures import Plot, lines_figure, save_figure
from r2flow.reports.outputs import what_next, write_samples

Curve = tuple[ndarray, ndarray]

CURVES = {
    "train/loss": "training loss",
    "val/loss": "validation loss",
    "curvature/bend": "bend, s / length²",
}


def read_curves(
    run: str | Path, names: Sequence[str] = ("train/loss", "val/loss")
) -> dict[str, Curve]:
    """Logged values against optimiser steps, (steps, values) by name.

    Each resumption logs into a new folder; of several values of a step, the last counts.
    """
    values: dict[str, dict[int, float]] = {name: {} for name in names}
    files = Path(run, "metrics").glob("version_*/metrics.csv")
    for path in sorted(files, key=lambda file: (len(file.parent.name), file.parent.name)):
        lines = path.read_text("utf-8", "replace").rpartition("\n")[0].splitlines()
        for row in csv.DictReader(lines):
            for name in names:
                # A line may be cut by a kill or a full disk. Lightning logs the index of the step.
                with suppress(TypeError, ValueError, KeyError):
                    value = float(row[name])
                    values[name][int(row["step"]) + 1] = value
    return {
        name: (np.array(sorted(points)), np.array([points[step] for step in sorted(points)]))
        for name, points in values.items()
        if points
    }


def curves_figure(runs: Sequence[tuple[str, Mapping[str, Curve]]]) -> Figure:
    """Plot one panel per logged curve of `CURVES`, one line per run, smoothed."""
    plots = []
    for name, title in CURVES.items():
        lines = {label: smooth(*curves[name]) for label, curves in runs if name in curves}
        if lines:
            plots.append(Plot("optimiser step", "", lines, title))
    return lines_figure(plots, 3)


def smooth(steps: ndarray, values: ndarray) -> Curve:
    """Running mean over a twentieth of the points, at the centre of its steps."""
    width = max(len(values) // 20, 1)
    kernel = np.full(width, 1 / width)
    return np.convolve(steps, kernel, "valid"), np.convolve(values, kernel, "valid")


def finish(run: Path, num: int, seed: int, device: str, finished: bool, kept: bool) -> None:
    """Draw the loss curve and a few scans of a run; print its files and the commands that come
    next.

    `kept`: the run keeps checkpoints.
    """
    curves = read_curves(run)
    logged = []
    if curves:
        logged.append(str(save_figure(curves_figure([(run.name, curves)]), run / "loss.png")))
    if (run / "tensorboard").is_dir():
        logged.append(f"tensorboard --logdir {quote(str(run / 'tensorboard'))}")
    if not checkpoints_of(run):
        if kept:
            print("stopped before a checkpoint was kept: the same command starts it again")
        else:
            print(f"no checkpoint was kept, as configured; loss curve: {'; '.join(logged)}")
        return
    checkpoint = load_checkpoint(run, device)
    if not finished:
        print(f"stopped at step {checkpoint.step}: the same command resumes from here")
    for name, (steps, values) in curves.items():
        tenth = max(len(values) // 10, 1)
        start = f"{values[:tenth].mean():#.3g} at step {steps[0]}, " if len(values) > 1 else ""
        over = ""
        if name.startswith("train/"):
            over = f" (means of {tenth} logged batches)" if tenth > 1 else " (noisy: of one batch)"
        print(f"{CURVES[name]}: {start}{values[-tenth:].mean():#.3g} at step {steps[-1]}{over}")
    print(f"\ncheckpoint    {checkpoint.path}")
    if num == 0 or not checkpoint.generator.unconditional:
        return
    out = run / "samples"
    write_samples(checkpoint, out, num, seed, pictures=num, replace=True)
    print(
        f"""pictures      {out / "samples.png"} and one page per scan next to it
in 3-D        {out / "samples.html"}, in a browser
point clouds  {out / "000000.ply"} ...
loss curve    {"; ".join(logged) or "not logged"}
{what_next(run, out, config=checkpoint.config)}""",
        flush=True,
    )
