"""Report at the end of a chain: how near its flows' scans are to held-out ones, and pictures."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
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
from r2flow.reports.compare import report_runs
from r2flow.reports.outputs import what_next, write_samples
from r2flow.reports.pages import print_text, write_page
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.tables import Part, Row, Table
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
_CLEARLY = 0.95  # largest ratio of two distances that differ
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
    models = {name: load_checkpoint(run, device) for name, run in runs.items()}
    first = next(iter(models.values()))
    makers = {name: model for name, model in models.items() if model.generator.unconditional}
    name, last = list(makers.items())[-1]
    drawn = list(_drawn(makers, device))
    rows = [row for row, _ in drawn]
    captions = [row["title"] for row in rows]
    labels = [link_label(one, model.config.stage.name) for one, model in makers.items()]
    if rows[-1]["scans"] == DEFAULT:
        labels.append(f"{DEFAULT} (a larger model, included)")
    about = f"{', '.join(labels)}. An evaluation runs the network once."
    trained = ModelConfig({**last.config.stored, "data": first.config.stored.get("data")})
    then = what_next(runs[name], out, trained)
    said = ""
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
    text: list[Part] = [about, Table(rows, _COLUMNS), said]
    images = [scans[0] for _, scans in drawn]
    steps = contact_sheet(images, last.sensor.rays(), captions)
    page = report_runs(list(runs.values()))
    page = replace(page, text=[*text, *page.text], figures={**page.figures, "steps": steps})
    write_samples(last, out, num=4, seed=0, pictures=4, replace=True)
    *_, page_path = write_page(page, out)
    print()
    print_text(text)
    print(
        f"""look first    {out / "steps.png"}: one scan of each; black: no return
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
    default = generator.sampler
    if generator.fixed or not hasattr(default, "steps"):
        return [default]
    few = "euler" if isinstance(default, FixedSteps) else None  # as distilled flows take them
    return [generator.choose(few, steps=1), generator.choose(few, steps=2), default]


def _draw(model: Checkpoint, label: str, sampler: Sampler) -> tuple[Row, ndarray]:
    batches = list(sample(model, _SCANS, sampler=sampler, batch_size=8))
    calls = torch.cat([batch.evaluations for batch in batches]).float().mean().item()
    row = {
        "scans": label,
        "title": f"{label} in {calls:g} evaluation{'s' * (calls != 1)}",
        "calls": calls,
        "milliseconds": round(1000 * sum(batch.seconds for batch in batches) / _SCANS),
    }
    images = torch.cat([batch.images[:, :2] for batch in batches])  # without labels
    return row, images.nan_to_num(0.0).numpy()


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


def _conclusion(rows: Sequence[Row], images: int) -> str:
    """What the distances of the flows say next to the best baseline; `images`: seen by the first
    flow.
    """
    *others, baseline = rows
    flows = [row for row in others if "calls" in row and row["scans"] != DEFAULT]
    limit = _CLEARLY * baseline["distance"]
    near = [row["title"] for row in flows if row["distance"] < limit]
    about = f"{len(near)} of {len(flows)} are clearly better than {baseline['scans']}"
    names = f" ({', '.join(near)})" if near else ""
    return f"After {images:,} images {about}{names}. Longer training helps."
