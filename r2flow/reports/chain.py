"""Report at the end of a chain: how near its flows' scans are to held-out ones, and pictures."""

from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from r2flow.data.datamodule import ScanDataModule
from r2flow.data.sets import ScanSet
from r2flow.data.sources import ScanSource
from r2flow.evaluation.sets import baseline_sets
from r2flow.generators import Generator, Sampler
from r2flow.metrics.panel import distances, mean_distance, panel
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.config import ModelConfig
from r2flow.model.sampling import sample
from r2flow.model.shipped import DEFAULT, find_model
from r2flow.reports.compare import compare_page
from r2flow.reports.outputs import what_next, write_samples
from r2flow.reports.pages import write_page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.runs import read_runs
from r2flow.reports.tables import Row, Table, print_table
from r2flow.samplers import FixedSteps

REPORT = "compare.md"  # the last file of a report
_SCANS = 32  # of each set that is compared
_STAGES = {"rectify": "trained on scans", "reflow": "straightened", "distill": "distilled"}
_GOAL = "training scans"
_COLUMNS = {
    "scans": "scans",
    "calls": "evaluations",
    "milliseconds": "ms a scan",
    "distance": "distance",
}
# What the ratio of two distances is called; 5 % count as equal.
_RATIOS = (0.5, 0.95, 1.05, 2.0)
_WORDS = ("far better than", "better than", "about as good as", "worse than", "far worse than")
_NEXT = """
next, with your own scans in FOLDER (.pcd, .ply, .bin, ...); step by step: docs/tutorial.md
  r2flow complete FOLDER --out dense                                     # add beams to them
  r2flow train experiment=finetune stage.parent=street data.root=FOLDER  # fine-tune street
without scans
  r2flow sample street --num 16 --out scans                              # generate street scenes"""


def link_label(name: str, stage: str) -> str:
    """Name of a link with what its stage does: 'rf2 (straightened)'."""
    return f"{name} ({_STAGES.get(stage, stage)})"


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
    rows = [row for row, _ in drawn]
    captions = [row["title"] for row in rows]
    labels = [link_label(one, model.config.stage.name or "") for one, model in makers.items()]
    if rows[-1]["scans"] == DEFAULT:
        labels.append(f"{DEFAULT} (a larger model, included)")
    about = f"{', '.join(labels)}. An evaluation runs the network once."
    said = []
    trained = ModelConfig({**last.config.stored, "data": first.config.stored.get("data")})
    then = what_next(runs[name], out, trained)
    if sets := _scan_sets(first):
        unseen, training = sets
        drawn.insert(0, ({"scans": _GOAL}, training[:].numpy()))
        rows = _with_distances(drawn, unseen, training)
        ends = [f"{row['title']}: distance {row['distance']}" for row in rows[1:-1]]
        captions = ["a training scan", *ends]
        said = _conclusion(rows, first.step * first.config.data.batch_size)
        nearest = min(rows[1:], key=lambda row: row["distance"])
        if nearest["scans"] == DEFAULT:
            longer = f"chain.{next(iter(runs))}.trainer.max_steps={10 * first.step}"
            then = f"{_NEXT}\nlonger training: the same command with name=longer {longer}"
        about += (
            f"\nDistance from {_SCANS} scans of each to {len(unseen)} unseen ones. Smaller is "
            f"better, 5 % is no difference; the best to expect is that of the {_GOAL}. The last "
            "row needs no network."
        )
    page = compare_page({run.label: [run] for run in read_runs(list(runs.values()))})
    page = replace(page, text=[about, Table(rows, _COLUMNS), "\n".join(said), *page.text])
    images = [scans[0] for _, scans in drawn]
    page.figures["steps"] = contact_sheet(images, last.sensor.rays(), captions)
    write_samples(last, out, num=4, seed=0, pictures=4, replace=True)
    *_, page_path = write_page(page, out)
    print_table(rows, _COLUMNS, f"\n{about}")
    print("", *said, sep="\n")
    print(
        f"""
look first    {out / "steps.png"}: one scan of each; black: no return
in 3-D        {out / "samples.html"}: four scans of {name}, in a browser
point clouds  {out / "000000.ply"} ... of {name}
details       {page_path}
{then}""",
        flush=True,
    )


def _drawn(makers: Mapping[str, Checkpoint], device: str) -> Iterator[tuple[Row, ndarray]]:
    """What was drawn by each generator in few steps and by its own sampler, and by the included
    model in two if its images are the same; with the scans, (N, 2 or 1, H, W).
    """
    for name, model in makers.items():
        for sampler in _samplers(model.generator):
            yield _draw(model, name, sampler)
    included = load_checkpoint(find_model(DEFAULT), device)
    if included.sensor.same_image(model.sensor):
        yield _draw(included, DEFAULT, included.generator.choose(steps=2))


def _samplers(generator: Generator) -> list[Sampler]:
    own = generator.sampler
    if generator.fixed or not hasattr(own, "steps"):
        return [own]
    few = "euler" if isinstance(own, FixedSteps) else None  # as distilled flows take them
    return [generator.choose(few, steps=1), generator.choose(few, steps=2), own]


def _draw(model: Checkpoint, label: str, sampler: Sampler) -> tuple[Row, ndarray]:
    batches = list(sample(model, _SCANS, sampler=sampler, batch_size=8))
    calls = float(np.mean([batch.evaluations.float().mean().item() for batch in batches]))
    row = {
        "scans": label,
        "title": f"{label} in {calls:g} evaluation{'s' * (calls != 1)}",
        "solver": sampler.name,
        "calls": calls,
        "milliseconds": round(1000 * sum(batch.seconds for batch in batches) / _SCANS),
    }
    images = [batch.images[:, :2].nan_to_num(0.0).numpy() for batch in batches]  # without labels
    return row, np.concatenate(images)


def _scan_sets(first: Checkpoint) -> tuple[ScanSet, ScanSet] | None:
    """Held-out scans and some training scans of the first run; None for a run on pairs."""
    config = first.config
    groups = {key: config.model[key] for key in ("sensor", "encoding")}
    data = ScanDataModule(**vars(config.data), **groups, seed=config.seed)
    data.setup()
    training, held_out = data.training_source, data.validation_source
    if not (
        isinstance(training, ScanSource) and isinstance(held_out, ScanSource) and held_out.names
    ):
        return None
    return ScanSet("", held_out, data.sensor), ScanSet("", training, data.sensor).spread(_SCANS)


def _with_distances(
    drawn: Sequence[tuple[Row, ndarray]], unseen: ScanSet, training: ScanSet
) -> list[Row]:
    """The rows with distances to unseen scans, and a row of the best baseline."""
    sensor = unseen.sensor
    truth = panel(unseen[:][:, :2].numpy(), sensor)

    def distance(images: ndarray) -> float:
        return round(mean_distance(distances(truth, panel(images[:, :2], sensor))), 3)

    baselines = baseline_sets(training, _SCANS).items()
    best, name = min((distance(scans[:].numpy()), name) for name, scans in baselines)
    return [
        *({**row, "distance": distance(images)} for row, images in drawn),
        {"scans": name, "distance": best},
    ]


def _conclusion(rows: Sequence[Row], images: int) -> list[str]:
    """What the distances say: of the flows next to the best baseline, of each next to the one
    before at equal cost, and of the included model. `images`: seen by the first flow.
    """
    flows = [row for row in rows if "calls" in row and row["scans"] != DEFAULT]
    *_, baseline = rows
    limit = _RATIOS[1] * baseline["distance"]
    near = [row["title"] for row in flows if row["distance"] < limit]
    about = f"{len(near)} of {len(flows)} are clearly better than {baseline['scans']}"
    names = f" ({', '.join(near)})" if near else ""
    said = [f"After {images:,} images {about}{names}. Longer training helps."]
    latest: dict[Any, Row] = {}  # by cost
    for row in flows:
        cost = row["solver"], row["calls"]
        if cost in latest:
            said.append(_compare(row, latest[cost]))
        latest[cost] = row
    best = min(flows, key=lambda row: row["distance"])
    for row in rows:
        if row["scans"] == DEFAULT:
            seen = f"{DEFAULT} has seen over a million images."
            said.append(f"{_compare(row, best | {'scans': best['title']})} {seen}")
    return [f"- {sentence}" for sentence in said]


def _compare(a: Row, b: Row) -> str:
    """'rf2 (straightened) in 1 evaluation is better than rf1: 0.225 against 0.286.'"""
    word = _WORDS[bisect(_RATIOS, a["distance"] / b["distance"])]
    figures = f"{a['distance']:.3f} against {b['distance']:.3f}"
    return f"{a['title']} is {word} {b['scans']}: {figures}."
