"""Report at the end of a chain: how near its flows' scans are to held-out ones, and pictures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray

from r2flow.data.datamodule import ScanDataModule
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanSource
from r2flow.evaluation.sets import baseline_sets
from r2flow.generators import Generator, Sampler
from r2flow.metrics.panel import distances, mean_distance, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.sampling import sample
from r2flow.model.shipped import DEFAULT, find_model
from r2flow.reports.compare import compare_page
from r2flow.reports.outputs import what_next, write_samples
from r2flow.reports.pages import write_page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.runs import read_runs
from r2flow.reports.tables import Row, print_table, table
from r2flow.samplers import FixedSteps

_SCANS = 32  # of each set that is compared
_STAGES = {"rectify": "trained on scans", "reflow": "straightened", "distill": "distilled"}
_INCLUDED = f"{DEFAULT}, included in r2flow"
_COLUMNS = {
    "scans": "scans",
    "solver": "solver",
    "calls": "evaluations",
    "seconds": "seconds a scan",
    "distance": "distance",
}


def report_chain(runs: Mapping[str, Path], out: Path, device: str = "cpu") -> None:
    """Write the report of a chain: the distance of its flows' scans to held-out ones, the first
    scan of each, scans of the last flow, and the comparison of the runs.

    `runs` are the folders by name of the link, in order.
    """
    loaded = {name: load_checkpoint(run, device) for name, run in runs.items()}
    first = next(iter(loaded.values()))
    makers = {name: model for name, model in loaded.items() if model.generator.unconditional}
    name, last = list(makers.items())[-1]
    drawn = list(_drawn(makers, device))
    about, rows = _with_distances(drawn, first)
    page = compare_page({run.label: [run] for run in read_runs(list(runs.values()))})
    page = replace(page, text=[about, table(rows, _COLUMNS), *page.text])
    titles = [f"{row['scans']}, {row['solver']}, evaluations: {row['calls']:g}" for row, _ in drawn]
    page.figures["steps"] = contact_sheet([x[0] for _, x in drawn], last.sensor.rays(), titles)
    write_samples(last, out, num=4, seed=0, pictures=4, replace=True)
    *_, text = write_page(page, out)
    print_table(rows, _COLUMNS, f"\n{about}")
    learned = last.config | {"data": first.config.get("data", {})}
    print(
        f"""
pictures      {out / "steps.png"} (the first scan of each row)
              {out / "samples.png"} ({name})
in 3-D        {out / "samples.html"}, in a browser
point clouds  {out / "000000.ply"} ...
details       {text}
{_advice(rows) or what_next(runs[name], out, config=learned)}""",
        flush=True,
    )


def _drawn(makers: Mapping[str, Checkpoint], device: str) -> Iterator[tuple[Row, ndarray]]:
    """What was drawn by each generator in few steps and by its own sampler, and by the included
    model in two if its images are the same; with the scans, (N, 2 or 1, H, W).
    """
    for name, model in makers.items():
        stage = model.config.get("stage", {}).get("name", "")
        for sampler in _samplers(model.generator):
            yield _draw(model, f"{name}, {_STAGES.get(stage, stage)}", sampler)
    included = load_checkpoint(find_model(DEFAULT), device)
    if included.sensor.same_image(model.sensor):
        yield _draw(included, _INCLUDED, included.generator.choose(steps=2))


def _samplers(generator: Generator) -> list[Sampler]:
    own = generator.sampler
    if generator.fixed or not hasattr(own, "steps"):
        return [own]
    few = "euler" if isinstance(own, FixedSteps) else None  # as distilled flows take them
    return [generator.choose(few, steps=1), generator.choose(few, steps=2), own]


def _draw(model: Checkpoint, label: str, sampler: Sampler) -> tuple[Row, ndarray]:
    batches = list(sample(model, _SCANS, sampler=sampler, batch_size=8))
    calls = [batch.evaluations.float().mean().item() for batch in batches]
    row = {
        "scans": label,
        "solver": sampler.name,
        "calls": float(np.mean(calls)),
        "seconds": sum(batch.seconds for batch in batches) / _SCANS,
    }
    images = [batch.images[:, :2].nan_to_num(0.0).numpy() for batch in batches]  # without labels
    return row, np.concatenate(images)


def _with_distances(
    drawn: Sequence[tuple[Row, ndarray]], first: Checkpoint
) -> tuple[str, list[Row]]:
    """A heading and rows with distances to the held-out scans of the first run; further rows are
    training scans and the best baseline. A run on pairs has no scans.
    """
    rows = [row for row, _ in drawn]
    groups = {key: first.config[key] for key in ("sensor", "encoding", "seed")}
    data = ScanDataModule(**first.config["data"], **groups)
    data.setup()
    training, held_out = data.training_source, data.validation_source
    if not (
        isinstance(training, ScanSource) and isinstance(held_out, ScanSource) and held_out.names
    ):
        return "Scans drawn", rows
    truth = panel(ScanSet("", held_out, data.sensor)[:][:, :2].numpy(), data.sensor)

    def distance(images: ndarray) -> float:
        return mean_distance(distances(truth, panel(images[:, :2], data.sensor)))

    trained = ScanSet("", training, data.sensor).spread(_SCANS)
    baselines = baseline_sets(trained, _SCANS).items()
    best, name = min((distance(scans[:].numpy()), name) for name, scans in baselines)
    about = (
        f"Distance of {_SCANS} scans of each to {len(held_out)} unseen scans, smaller is better; "
        "evaluations: runs of the network a scan"
    )
    return about, [
        *({**row, "distance": distance(images)} for row, images in drawn),
        {"scans": "training scans", "distance": distance(trained[:].numpy())},
        {"scans": f"best baseline: {name}", "distance": best},
    ]


def _advice(rows: Sequence[Row]) -> str:
    """What to do if the included model's scans are nearer than those of all flows."""
    flows = {row["distance"]: row["scans"] for row in rows if "calls" in row and "distance" in row}
    if not flows or flows[min(flows)] != _INCLUDED:
        return ""
    return f"""
{DEFAULT} trained longer, and its scans are closer to the unseen ones. Use it, or fine-tune it:
  r2flow sample {DEFAULT} --num 16 --out scans
  r2flow train experiment=finetune stage.parent={DEFAULT} data.root=FOLDER"""
