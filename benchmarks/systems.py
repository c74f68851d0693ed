"""The paper's other systems and R2Flow's own, each trained for as many processor seconds on the same simulated scans.

    python benchmarks/systems.py --out systems              # half an hour of one core; resumes
    python benchmarks/systems.py --out systems --seconds 5 --seeds 1 --samples 8    # whether it runs at all

Rows, division, figures and verdicts were written down before the first run.

Data: 1,024 simulated scans of 16 x 128 a seed, range alone, 1.45 to 80 m, the same for all. Recipes:
`experiment=NAME_small` with its own network, objective, range format, optimiser, batch and sampler. What a recipe says
in steps or images (a GAN's warm-up, ADA's speed, the autoencoder's first adversarial step) keeps its share of the run.

Budget: SECONDS processor seconds of one thread a row, from the first step to the end of the last. The number of steps
follows from the seconds a step of a short run of the same recipe; what was really spent is in the table. Where a row
comes out of several runs, the budget is divided:

- LiDM, LiDM + APE: one half the autoencoder, which both share, one half the diffusion of its latents.
- 2-RF: one half a 1-RF, one half its pairs and the 2-RF.
- k-TD, flow map: one half that 1-RF, a quarter pairs and a shorter 2-RF, a quarter pairs of this and the last link.

Links and pairs that rows share are made once and counted for each.

Figure: mean of the fidelity panel's eleven lines of range between 32 samples and 512 held-out scans of another seed;
16 of LiDARGen, whose scan takes four seconds, which makes its figure a little larger. Beside it are four controls and
the floor, as many other simulated scans. Each row is sampled by its default sampler; flows also at 1, 2 and 4
evaluations.

Verdicts over seeds 1, 2, 3 by Student's 95 % interval of the mean of log(b / a): a row has learned something if it is
nearer than the nearest control of its seed; a row beats another one if it is nearer. No error is shared among the many
comparisons: of 20 pairs of equal rows one would be said to differ.
"""

import argparse
import json
import math
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch

from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.lidar.projection import image_to_points
from r2flow.lidar.sensors import build_sensor
from r2flow.metrics.fidelity import controls, distances, panel
from r2flow.model.checkpoint import load_checkpoint
from r2flow.model.sampling import sample
from r2flow.reports.pictures import FOREGROUND, dark_figure, draw_birds_eye, draw_range, save_figure
from r2flow.reports.tables import table
from r2flow.reports.verdicts import HOLDS, all_above_0, interval
from r2flow.simulator import simulate
from r2flow.training import build, compose, fit

SEEDS = (1, 2, 3)
SECONDS = 45.0
SENSOR = build_sensor("hdl64e", 16, 128)
SCENES, HELD_OUT_SEED, HELD_OUT, SAMPLES = 1024, 1000, 512, 32
PROBE = 16, 48  # steps of a short run: R1 comes every 16
FEW = 1, 2, 4  # evaluations at which flows are also sampled
TAUGHT = 1, 2  # k of the k-TD

COMMON = [
    "samples.num=0", "callbacks.pictures=null", "callbacks.curvature=null", "loggers=[csv]", "trainer=cpu",
    "callbacks.checkpoint.every=1000000", "trainer.val_check_interval=1000000", "trainer.enable_progress_bar=false",
    "callbacks.progress=null",
]  # fmt: skip
SCANS = ["sensor.rows=16", "sensor.columns=128", "sensor.min_range=1.45", "sensor.max_range=80",
         "encoding.reflectance=false", f"data.scenes={SCENES}"]  # fmt: skip
FLOW = ["data.batch_size=8"]


def pairs(num: int, steps: int) -> list[str]:
    """Pairs by `midpoint`, two evaluations a step."""
    return [*FLOW, f"data.pairs.num={num}", "data.pairs.method=midpoint", f"data.pairs.steps={steps}"]


OF_1RF, OF_2RF = pairs(256, 4), pairs(256, 2)


@dataclass(frozen=True)
class Link:
    """A run.

    Attributes:
        overrides: Its recipe.
        share: Of the budget, its pairs included.
        parent: The link that it starts from.
        scaled: Keys whose values are so many times its number of steps.
        row: Whether it is a row of the table, or a link of others alone.
        few: Whether it is also sampled at 1, 2 and 4 evaluations.
        fewer: So many times fewer scans of it are drawn.
    """

    overrides: list[str]
    share: float = 1.0
    parent: str = ""
    scaled: dict[str, float] = field(default_factory=dict)
    row: bool = True
    few: bool = False
    fewer: int = 1

    @property
    def of_pairs(self) -> bool:
        return any(one.startswith("data.pairs") for one in self.overrides)


GAN = {"stage.warmup.images": 4000 / 4000, "stage.augment.kimg": 20 / 4000}
LINKS: dict[str, Link] = {
    "vanilla GAN": Link(["experiment=vanilla_gan_small"], scaled=GAN),
    "DUSty v1": Link(["experiment=dusty1_small"], scaled=GAN),
    "DUSty v2": Link(["experiment=dusty2_small"], scaled=GAN),
    "LiDARGen": Link(["experiment=lidargen_small"], fewer=2),
    "autoencoder": Link(
        ["experiment=lidm_autoencoder_small"], 0.5, scaled={"stage.adversarial_start": 400 / 1500}, row=False
    ),
    "LiDM": Link(["experiment=lidm_small"], 0.5, "autoencoder"),
    "LiDM + APE": Link(["experiment=lidm_ape_small"], 0.5, "autoencoder"),
    "R2DM": Link(["experiment=r2dm_small"]),
    "1-RF": Link(FLOW, few=True),
    "half 1-RF": Link(FLOW, 0.5, row=False),
    "2-RF": Link(["experiment=reflow", *OF_1RF], 0.5, "half 1-RF", few=True),
    "short 2-RF": Link(["experiment=reflow", *OF_1RF], 0.25, "half 1-RF", row=False),
    **{
        f"{k}-TD": Link(["experiment=distill", f"stage.steps={k}", *OF_2RF], 0.25, "short 2-RF")
        for k in TAUGHT
    },
    "flow map": Link(["experiment=flow_map", *OF_2RF], 0.25, "short 2-RF", few=True),
}  # fmt: skip


class Clock(L.Callback):
    """Processor seconds from the first step to the end of the last, by step."""

    def on_train_start(self, *_: Any) -> None:
        self.seconds = [time.process_time()]

    def on_train_batch_end(self, *_: Any) -> None:
        self.seconds.append(time.process_time())


def folder_of(out: Path, seed: int, name: str) -> Path:
    return out / f"seed-{seed}" / name.lower().replace(" + ", "-").replace(" ", "-")


def train(out: Path, seed: int, name: str, steps: int, folder: Path) -> tuple[Clock, float, int]:
    """One run from its beginning; its clock, all of its processor seconds, and how many parameters learn."""
    link, start = LINKS[name], time.process_time()
    shutil.rmtree(folder, ignore_errors=True)  # of one that was interrupted; its seconds are lost
    given = [*COMMON, *link.overrides, f"seed={seed}", f"run_dir={folder}", f"trainer.max_steps={steps}"]
    given += [f"{key}={max(round(share * steps, 3), 0.001):g}" if "kimg" in key else f"{key}={round(share * steps)}"
              for key, share in link.scaled.items()]  # fmt: skip
    given += [f"stage.init={folder_of(out, seed, link.parent)}"] if link.parent else []
    given += [] if link.of_pairs else [*SCANS, f"data.root={out / f'scans-{seed}'}"]
    run, clock = build(compose(given), given), Clock()
    run.trainer.callbacks.append(clock)  # type: ignore[attr-defined]
    fit(run)
    return clock, time.process_time() - start, sum(p.numel() for p in run.stage.parameters() if p.requires_grad)


def seconds_of_pairs(out: Path, seed: int, name: str) -> float:
    """Makes the pairs of a link, or finds what they took."""
    link = LINKS[name]
    note = folder_of(out, seed, link.parent) / "pairs.seconds"
    if not note.exists():
        shutil.rmtree(folder_of(out, seed, link.parent) / "pairs", ignore_errors=True)
        clock, seconds, _ = train(out, seed, name, 1, out / "probe")
        write(note, seconds - (clock.seconds[-1] - clock.seconds[0]))
    return float(json.loads(note.read_text()))


def step_seconds(out: Path, seed: int, name: str) -> float:
    """Processor seconds a step, measured once for all seeds and for all runs of a recipe."""
    same = {"half 1-RF": "1-RF", "short 2-RF": "2-RF", "1-TD": "2-TD"}.get(name, name)
    note, (first, last) = folder_of(out, 0, same).with_suffix(".json"), PROBE
    if not note.exists():
        clock, _, _ = train(out, seed, name, last, out / "probe")
        write(note, (clock.seconds[last] - clock.seconds[first]) / (last - first))
    return float(json.loads(note.read_text()))


def write(path: Path, values: Any) -> None:
    with atomic_write(path) as file:
        file.write(json.dumps(values).encode())


def learn(out: Path, seed: int, name: str, seconds: float) -> dict[str, Any]:
    """Train a link, if that has not been done, and say what it took."""
    link, folder = LINKS[name], folder_of(out, seed, name)
    note = folder.with_suffix(".run.json")
    if not note.exists():
        planned = link.share * seconds
        found: dict[str, Any] = {"planned": planned, "failed": ""}
        try:
            above = learn(out, seed, link.parent, seconds)["total"] if link.parent else 0.0
            before = seconds_of_pairs(out, seed, name) if link.of_pairs else 0.0
            step = step_seconds(out, seed, name)
            steps = max(round((planned - before) / step), 20)
            clock, _, learning = train(out, seed, name, steps, folder)
            spent = before + clock.seconds[-1] - clock.seconds[0]
            found |= {"pairs": before, "probed": step, "steps": steps, "spent": spent, "total": above + spent,
                      "learning": learning}  # fmt: skip
        except InputError as error:
            found |= {"failed": str(error), "total": math.nan}
        write(note, found)
    return dict(json.loads(note.read_text()))


def figures(folder: Path, real: dict[str, np.ndarray], few: bool, num: int) -> dict[str, Any]:
    """The panel by evaluations; the first one is the default sampler's. A scan of it is kept."""
    model = load_checkpoint(folder).generator
    found: dict[str, Any] = {"parameters": sum(p.numel() for p in model.parameters()), "at": []}
    for steps in [None, *(FEW if few else ())]:
        start = time.process_time()
        drawn = list(sample(model, num, batch_size=16, steps=steps))
        seconds = (time.process_time() - start) / num
        images = torch.cat([one.images for one in drawn]).numpy()
        if steps is None:
            np.save(folder.with_suffix(".scan.npy"), images[0])
        lines = distances(panel(images, SENSOR), real)
        found["at"].append({
            "evaluations": float(torch.cat([one.evaluations for one in drawn]).double().mean()),
            "seconds": seconds, "panel": float(np.mean(list(lines.values()))), "lines": lines,
            "fill": float((images[:, 0] > 0).mean()),
        })  # fmt: skip
    return found


def make_scans(folder: Path, seed: int) -> None:
    """The training scans of a seed, made once."""
    command = [sys.executable, "-m", "r2flow.cli", "simulate", "--out", str(folder), "--num", str(SCENES)]
    subprocess.run([*command, "--seed", str(seed), "--size", "16x128", "--format", "npy"], check=True)


def scans_of(seed: int, first: int, num: int) -> np.ndarray:
    """Simulated scans, range alone, (num, 1, H, W)."""
    return np.stack([simulate(SENSOR, seed, k).image[:1] for k in range(first, first + num)])


def study(out: Path, seeds: Sequence[int], seconds: float, num: int, names: Sequence[str]) -> None:
    held = scans_of(HELD_OUT_SEED, 0, HELD_OUT + num)
    real = panel(held[:HELD_OUT], SENSOR)
    floor = distances(panel(held[HELD_OUT:], SENSOR), real)
    beside = {"floor": {"lines": floor, "panel": float(np.mean(list(floor.values())))}}
    for seed in seeds:
        make_scans(out / f"scans-{seed}", seed)
        note = out / f"controls-{seed}.json"
        if not note.exists():
            for name, images in controls(scans_of(seed, 0, SCENES), SENSOR, num, seed).items():
                lines = distances(panel(images, SENSOR), real)
                beside[name] = {"lines": lines, "panel": float(np.mean(list(lines.values())))}
            write(note, beside)
        for name in names:
            link = LINKS[name]
            took, folder = learn(out, seed, name, seconds), folder_of(out, seed, name)
            text = took["failed"] or "{steps} steps, {planned:.1f} s planned, {spent:.1f} spent".format(**took)
            note = folder.with_suffix(".json")
            if link.row and not took["failed"] and not note.exists():
                write(note, figures(folder, real, link.few, num // link.fewer))
            if note.exists():
                shown = json.loads(note.read_text())["at"]
                text += "".join(f"; {one['evaluations']:g}: {one['panel']:.4f}" for one in shown)
            print(f"{time.strftime('%H:%M')} seed {seed}, {name}: {text}", flush=True)


def read(out: Path, seeds: Sequence[int]) -> dict[str, list[dict[str, Any]]]:
    """The figures of each row over the seeds; a flow's row at k evaluations is a row of its own."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, link in LINKS.items():
        notes = [folder_of(out, seed, name) for seed in seeds]
        if not link.row or not all(note.with_suffix(".json").exists() for note in notes):
            continue
        took = [json.loads(note.with_suffix(".run.json").read_text()) for note in notes]
        found = [json.loads(note.with_suffix(".json").read_text()) for note in notes]
        for number, default in enumerate(found[0]["at"]):
            label = name if number == 0 else f"{name}, {default['evaluations']:g}"
            if number and default["evaluations"] == found[0]["at"][0]["evaluations"]:
                continue
            rows[label] = [{**one["at"][number], "parameters": one["parameters"], **run}
                           for one, run in zip(found, took, strict=True)]  # fmt: skip
    return rows


def mean_of(values: Sequence[float], digits: int = 4) -> str:
    """Mean and half of Student's 95 % interval."""
    low, high = interval(values)
    return f"{np.mean(values):.{digits}f}" + (f" ± {(high - low) / 2:.{digits}f}" if math.isfinite(high) else "")


def nearer(a: Sequence[float], b: Sequence[float]) -> str:
    return all_above_0([[math.log(right / left) for left, right in zip(a, b, strict=True)]])


def report(out: Path, seeds: Sequence[int]) -> None:
    rows = read(out, seeds)
    beside = [json.loads((out / f"controls-{seed}.json").read_text()) for seed in seeds]
    best = [min(v["panel"] for name, v in one.items() if name != "floor") for one in beside]
    numbers = {name: str(number) for number, name in enumerate(rows, 1)}
    panels = {name: [one["panel"] for one in found] for name, found in rows.items()}
    lines = []
    for name, found in rows.items():
        beaten = [numbers[other] for other in rows if other != name and nearer(panels[name], panels[other]) == HOLDS]
        lines.append([
            numbers[name], name, f"{found[0]['parameters']:,}", f"{found[0]['evaluations']:g}",
            f"{np.mean([one['seconds'] for one in found]):.4f}", f"{np.mean([one['steps'] for one in found]):.0f}",
            f"{np.mean([one['total'] for one in found]):.1f}", mean_of(panels[name]), nearer(panels[name], best),
            ", ".join(beaten) or "-",
        ])  # fmt: skip
    head = ["", "row", "parameters", "evaluations", "seconds a scan", "steps of the last link", "seconds of training",
            "panel", "nearer than every control", "beats"]  # fmt: skip
    others = {name: mean_of([one[name]["panel"] for one in beside]) for name in beside[0] if name != "floor"}
    text = f"{table(lines, head)}\n\nFloor: {beside[0]['floor']['panel']:.4f}. Controls: "
    text += ", ".join(f"{name} {value}" for name, value in others.items()) + ".\n"
    members = list(next(iter(rows.values()))[0]["lines"])
    by_line = [
        [name, *(f"{np.mean([one['lines'][member] for one in found]):.3f}" for member in members)]
        for name, found in [*rows.items(), *((name, [one[name] for one in beside]) for name in beside[0])]
    ]
    text += f"\n{table(by_line, ['row', *members])}\n"  # fmt: skip
    with atomic_write(out / "systems.md") as file:
        file.write(text.encode())
    print(text)
    picture(out, seeds[0])


def picture(out: Path, seed: int) -> None:
    """Scan 0 of each row of a seed, range image and bird's-eye view, below a held-out one; none was chosen."""
    shown = [("held-out simulated scan", scans_of(HELD_OUT_SEED, 0, 1)[0])]
    for name, link in LINKS.items():
        file = folder_of(out, seed, name).with_suffix(".scan.npy")
        shown += [(name, np.load(file))] if link.row and file.exists() else []
    figure = dark_figure(12, 1.25 * len(shown))
    grid = figure.add_gridspec(len(shown), 2, width_ratios=[8, 1], hspace=0.28, wspace=0.02,
                               left=0.01, right=0.99, top=1 - 0.25 / (1.25 * len(shown)), bottom=0.005)  # fmt: skip
    for row, (name, image) in enumerate(shown):
        axes = figure.add_subplot(grid[row, 0])
        draw_range(axes, image, label=False)
        axes.set_title(name, color=FOREGROUND, fontsize=9, loc="left", pad=3)
        draw_birds_eye(figure.add_subplot(grid[row, 1]), image_to_points(image, SENSOR.rays())[0], label=False)
    save_figure(figure, out / "systems.png", dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--samples", type=int, default=SAMPLES)
    parser.add_argument("--rows", nargs="+", default=list(LINKS), choices=LINKS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    out = given.out.resolve()
    study(out, given.seeds, given.seconds, given.samples, given.rows)
    report(out, given.seeds)


if __name__ == "__main__":
    main()
