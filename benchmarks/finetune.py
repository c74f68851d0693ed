"""What starting from a trained model is worth with few scans of one's own: fine-tuned against trained from nothing.

    python benchmarks/finetune.py --out finetune                        # real scans in R2FLOW_SHARED/real
    python benchmarks/finetune.py --out try --steps 4 --seeds 1 --num 2

31 real scans are trained on, 27 of other drives are held out, parted as in docs/simulator.md. Both kinds of run have
the same network, scans, batch and number of steps; each has learning rates of its own, and from nothing a step of Muon.
A budget is a run of its own, whose learning rate comes down within it. The same command goes on.
"""

import argparse
import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.data.opening import open_scans
from r2flow.evaluation.sets import reading_of_flow
from r2flow.files import atomic_write
from r2flow.metrics.fidelity import controls, distances, nearest, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.reports.pages import STYLES, Page, blank_figure, picture, prepare_folder, write_page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.tables import table
from r2flow.training import build, compose, fit

# Drives of the real scans, and how many scans each has.
TRAINED = {"odometry/sequences/00": 8, "raw/2011_09_26/2011_09_26_drive_0005_sync": 20, "object/training": 3}
HELD_OUT = {
    "kitti360/data_3d_raw/2013_05_28_drive_0000_sync": 15,
    "raw/2011_09_26/2011_09_26_drive_0048_sync": 11,
    "odometry/sequences/08": 1,
}
# How each begins: from nothing, with the rates of experiment=fast. The held-out loss of a map is of other times.
STARTS = {
    "fine-tuned": ["experiment=finetune"],
    "fine-tuned, still a map": ["experiment=finetune_map"],
    "from nothing": ["experiment=finetune", "stage.learning_rate=2e-3", "stage.muon=0.01"],
}
FEW = "panel's mean, 2 evaluations"


def link_scans(real: Path, drives: Mapping[str, int], folder: Path) -> Path:
    """A folder of links to the scans of some drives, a folder below it for each."""
    for drive, expected in drives.items():
        place = folder / drive.replace("/", "_")
        place.mkdir(parents=True, exist_ok=True)
        scans = sorted((real / drive).rglob("*.bin"))
        if len(scans) != expected:
            raise SystemExit(f"{real / drive} has {len(scans)} scans, not {expected}.")
        for scan in scans:
            if not (place / scan.name).is_symlink():
                (place / scan.name).symlink_to(scan)
    return folder


def train(start: str, seed: int, steps: int, out: Path, model: str, overrides: Sequence[str]) -> dict[str, Any]:
    """One run; a finished one is read."""
    run = out / "runs" / f"{start.replace(' ', '-')}-{steps}-{seed}"
    done = run / "finetune.json"
    if done.is_file():
        found: dict[str, Any] = json.loads(done.read_text())
        return found
    config = compose([
        *STARTS[start], f"stage.init={model}", f"data.root='{out / 'trained'}'",
        f"data.validation.data={{name: folder, root: '{out / 'held_out'}'}}",
        f"trainer.max_steps={steps}", f"trainer.val_check_interval={steps}", f"seed={seed}", f"run_dir='{run}'",
        "loggers=[csv]", "samples.num=0", "callbacks.pictures=null", "callbacks.curvature=null",
        f"callbacks.checkpoint.every={max(steps, 1)}", *overrides,
    ])  # fmt: skip
    if start == "from nothing":
        theirs = load_checkpoint(model).config
        config = {**config, **{group: theirs[group] for group in ("sensor", "encoding", "backbone")}}
        config["stage"]["init"] = None
    begun = time.perf_counter(), time.process_time()
    result = fit(build(config))
    found = {
        "start": start, "seed": seed, "steps": steps, "images": steps * config["data"]["batch_size"],
        "wall seconds": time.perf_counter() - begun[0], "processor seconds": time.process_time() - begun[1],
        "held-out loss": result.metrics["val/loss"], "run": str(run),
    }  # fmt: skip
    with atomic_write(done, "w") as file:
        json.dump(found, file, indent=2)
    return found


@dataclass(frozen=True)
class Judge:
    """The held-out scans, and what is known of the others."""

    flow: Checkpoint
    held: np.ndarray
    trained: np.ndarray
    num: int

    def lines(self, images: np.ndarray) -> dict[str, float]:
        """The panel's distances to the held-out scans, and their mean."""
        sensor = self.flow.sensor
        found = distances(panel(self.held, sensor), panel(images, sensor))
        return {"panel's mean": float(np.mean(list(found.values()))), **found}

    def drawn(self, checkpoint: str | Path, steps: int | None = None) -> np.ndarray:
        return load_checkpoint(checkpoint).sample(self.num, steps=steps).numpy()

    def judged(self, images: np.ndarray) -> dict[str, float]:
        copies = nearest(images, self.trained, self.flow.sensor)
        return {**self.lines(images), "nearest training scan, least": float(copies.min())}


def mean_and_range(values: Sequence[float]) -> str:
    return f"{np.mean(values):.4g} ± {(max(values) - min(values)) / 2:.1g}"


def summary(rows: Sequence[Mapping[str, Any]], start: str, steps: int) -> dict[str, Any]:
    """Mean and half range over the seeds of one start and budget."""
    chosen = [row for row in rows if (row["start"], row["steps"]) == (start, steps)]
    keys = "wall seconds", "held-out loss", "panel's mean", FEW, "nearest training scan, least"
    return {
        "start": start, "steps": steps, "images": chosen[0]["images"], "seeds": len(chosen),
        **{key: mean_and_range([row[key] for row in chosen]) for key in keys},
    }  # fmt: skip


def curves(rows: Sequence[Mapping[str, Any]], untouched: float, floor: float) -> Figure:
    """Held-out loss and panel against seconds: each run a point, the mean of a budget's runs on the line."""
    figure = blank_figure(10, 4.2)
    axes = figure.subplots(1, 2)
    second = float(np.median([row["wall seconds"] / row["steps"] for row in rows]))
    for place, key in zip(axes, ("held-out loss", "panel's mean"), strict=True):
        for start, style in zip(STARTS, STYLES, strict=False):
            own = [row for row in rows if row["start"] == start]
            budgets = sorted({row["steps"] for row in own})
            means = [np.mean([row[key] for row in own if row["steps"] == steps]) for steps in budgets]
            place.plot([steps * second for steps in budgets], means, label=start, **style)
            place.plot([row["steps"] * second for row in own], [row[key] for row in own], ".", color=style["color"])
        place.set(xlabel="seconds of training", ylabel=f"{key}, held-out real scans", xscale="log")
        place.grid(alpha=0.3, which="both")
    axes[1].axhline(untouched, color="grey", ls=":", label="the model, not fine-tuned")
    axes[1].axhline(floor, color="grey", ls="--", label="the training scans")
    for place in axes:
        place.legend(fontsize=8)
    return figure


def measure(arguments: argparse.Namespace, command: str) -> Page:
    out: Path = arguments.out
    flow = load_checkpoint(arguments.model)
    trained = link_scans(arguments.real, TRAINED, out / "trained")
    held_out = link_scans(arguments.real, HELD_OUT, out / "held_out")

    def images(folder: Path) -> np.ndarray:
        scans = open_scans(folder, reading_of_flow(flow))
        return np.stack([scans.source[i] for i in range(len(scans))])

    judge = Judge(flow, images(held_out), images(trained), arguments.num)
    rows: list[dict[str, Any]] = []
    sheets: dict[str, np.ndarray] = {}
    for steps in arguments.steps:
        for start in STARTS:
            for seed in range(arguments.seeds):
                found = train(start, seed, steps, out, arguments.model, arguments.overrides)
                run = found.pop("run")
                drawn = judge.drawn(run)
                few = judge.lines(judge.drawn(run, 2))["panel's mean"]
                rows.append({**found, **judge.judged(drawn), FEW: few})
                sheets.setdefault(start, drawn) if steps == max(arguments.steps) else None
                print(json.dumps(rows[-1]), flush=True)
    untouched = judge.judged(judge.drawn(arguments.model))
    others = {f"control: {name}": judge.lines(made) for name, made in controls(judge.trained, flow.sensor, 31).items()}
    known = {
        f"{arguments.model}, not fine-tuned": untouched,
        "the training scans": judge.lines(judge.trained),
        **others,
    }
    last = max(arguments.steps)
    lines = {
        start: {key: float(np.mean([row[key] for row in rows if (row["start"], row["steps"]) == (start, last)]))
                for key in known["the training scans"]}
        for start in STARTS
    }  # fmt: skip
    budgets = [summary(rows, start, steps) for steps in arguments.steps for start in STARTS]
    shown = [image for start in STARTS for image in sheets[start][:2]]
    titles = [f"{start}, {last} steps" for start in STARTS for _ in sheets[start][:2]]
    kinds = {**lines, **known}
    panel_rows = [{"line": line, **{kind: kinds[kind][line] for kind in kinds}} for line in known["the training scans"]]
    text = [
        f"{len(judge.trained)} real scans are trained on, {len(judge.held)} of other drives held out; "
        f"{flow.sensor.shape[0]} x {flow.sensor.shape[1]}, {arguments.num} samples of each run with its own sampler. "
        "Mean and half range over the seeds.",
        table(budgets, {key: key for key in budgets[0]}),
        picture("finetune"),
        f"The lines of the panel at {last} steps, means over the seeds, and what other sets have:",
        table(panel_rows, {key: key for key in panel_rows[0]}),
        picture("finetune_samples"),
    ]
    figures = {
        "finetune": curves(rows, untouched["panel's mean"], known["the training scans"]["panel's mean"]),
        "finetune_samples": contact_sheet(shown, flow.sensor.rays(), titles),
    }
    seeds = {f"run {seed}": seed for seed in range(arguments.seeds)}
    return Page("finetune_real", "Fine-tuning on few real scans", text, rows, figures, command, seeds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--real", type=Path, default=Path(os.environ.get("R2FLOW_SHARED", "../shared"), "real"))
    parser.add_argument("--model", default="street", help="a model, a run folder or a checkpoint")
    parser.add_argument("--steps", type=int, nargs="+", default=[150, 500, 1500], help="budgets, each a run")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--num", type=int, default=64, help="samples of each run")
    parser.add_argument("overrides", nargs="*", help="further keys for all runs, as trainer.precision=bf16-mixed")
    arguments = parser.parse_args()
    arguments.out = prepare_folder(arguments.out).resolve()
    command = " ".join(["python benchmarks/finetune.py --out OUT --model", str(arguments.model), "--steps"])
    command += f" {' '.join(map(str, arguments.steps))} --seeds {arguments.seeds} --num {arguments.num}"
    page = measure(arguments, " ".join([command, *arguments.overrides]))
    print(write_page(page, arguments.out)[-1].read_text())


if __name__ == "__main__":
    main()
