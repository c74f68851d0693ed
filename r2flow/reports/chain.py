"""Compare the generators of a chain at few and many steps, from the same noise."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from r2flow.data.datamodule import ScanDataModule
from r2flow.generators import Flow
from r2flow.lidar.projection import write_scan
from r2flow.metrics.panel import PANEL, distances, mean_distance, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.sampling import sample
from r2flow.progress import track
from r2flow.reports.curvature import measure_paths
from r2flow.reports.outputs import draw_pages, what_next
from r2flow.reports.pages import Page, write_page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.tables import print_table, table
from r2flow.runs.folder import read_config

MANY = 32  # steps that approximate the limit of many
COLUMNS = {
    "flow": "flow", "steps": "steps", "seconds": "seconds a scan", "bend": "bend",
    "mean": "distance to held-out scans",
}  # fmt: skip


def report(runs: Mapping[str, Path], out: Path, num: int = 16, device: str = "cpu") -> None:
    """Sample every run, compare the samples with held-out scans, and write figure, table and scans.

    The first run was trained on scans. Each makes `num` scans for each number of steps; autoencoders make none.
    """
    loaded = {name: load_checkpoint(run, device) for name, run in runs.items()}
    flows = {name: flow for name, flow in loaded.items() if flow.generator.draws} or loaded
    first, last = next(iter(loaded.values())), list(flows)[-1]
    real, rays = held_out(first, next(iter(runs.values()))), first.sensor.rays()
    truth = panel(real, first.sensor)
    rows, drawn = [], {}
    bends = {name: bend(name, flow, num) for name, flow in flows.items()}
    fixed = {name: getattr(flow.generator.sampler, "steps", 1) for name, flow in flows.items()
             if flow.generator.fixed or not hasattr(flow.generator.sampler, "steps")}  # fmt: skip
    every = sorted({1, *fixed.values(), MANY})  # numbers of steps of flows that are not distilled
    cells = [(name, steps) for name in flows for steps in ([fixed[name]] if name in fixed else every)]
    for name, steps in track(cells, "sampling"):
        batches = list(sample(flows[name], num, steps=None if name in fixed else steps))
        images = np.concatenate([batch.images.numpy() for batch in batches])
        seconds = sum(batch.seconds for batch in batches) / num
        lines = distances(truth, panel(images, first.sensor))
        means = {"bend": bends[name], "mean": mean_distance(lines)}
        rows.append({"flow": name, "steps": steps, "seconds": seconds, **means, **lines})
        drawn[name, steps] = images
    shown = list(drawn[cells[-1]][:4])
    for index, image in enumerate(shown):
        write_scan(image, rays, out, f"{index:06d}", ("ply", "npy"))
    draw_pages(shown, rays, out, f"{last}, seed 0")
    text = [
        f"{num} scans of each generator and number of steps, all from the same noise, against {len(real)} held-out "
        "scans. *Bend* is the integral of the paper's s(t) over the squared length of the path (mean over scans, 0 "
        "is straight); an untrained flow is straight too, so read it together with the *distance*: the mean of "
        "the panel's lines, 0 is equal.",
        table(rows, COLUMNS | {line: line for line in PANEL}),
    ]
    titles = [f"{name}, {steps} step{'s' * (steps > 1)}" for name, steps in cells]
    figures = {"chain": contact_sheet([drawn[cell][0] for cell in cells], rays, titles)}
    page = Page("chain", "From many steps to few", text, rows, figures, {"evaluation": 0}, device)
    written = write_page(page, out)[-1]
    print_table(rows, COLUMNS)
    learned = flows[last].config | {"data": first.config.get("data", {})}  # the chain's scans are its first run's
    print(
        f"""
pictures      {out / "chain.png"} (every generator, few and many steps), {out / "samples.png"} ({last})
in 3-D        {out / "samples.html"}, in a browser
point clouds  {out / "000000.ply"} ...
table         {written}
flows         {", ".join(map(str, runs.values()))}
{what_next(runs[last], out, config=learned)}

Open {out / "chain.png"} first.""",
        flush=True,
    )


def held_out(flow: Checkpoint, run: Path) -> np.ndarray:
    """Validation scans of a run, (N, 2 or 1, H, W) in metres and reflectance."""
    config = read_config(run) or flow.config  # the folder's config has the current path of the scans
    data = ScanDataModule(**config["data"], sensor=config["sensor"], encoding=config["encoding"], seed=config["seed"])
    data.setup()
    held = data.validation_source
    return np.stack([held[i] for i in track(range(len(held)), "reading held-out scans", "scans")])


def bend(name: str, flow: Checkpoint, num: int) -> float:
    """int s(t) dt over |x_1 - x_0|^2, mean over scans: 0 is straight; NaN without paths, or distilled."""
    if not isinstance(flow.generator, Flow) or flow.generator.fixed:  # a distilled network knows the times of its steps
        return math.nan
    return float(measure_paths(flow, name, num, MANY, batch_size=num).s_normalised.mean())
