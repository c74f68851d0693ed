"""Ablation: cost and quality of combinations of settings, with their spread over seeds.

Two combinations differ by a figure if their intervals of mean +- 2 standard errors over the seeds
do not overlap.
"""

import csv
import io
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev

import torch
from matplotlib.figure import Figure
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from torch import Tensor

from r2flow.base.files import read_json, write_file
from r2flow.base.noise import Draws
from r2flow.data.sets import ScanSet
from r2flow.evaluation.comparing import Comparer
from r2flow.evaluation.measuring import Work
from r2flow.evaluation.protocols import PROTOCOLS
from r2flow.evaluation.sets import sampled_set
from r2flow.flow.path import interpolate
from r2flow.flow.straightness import straightness
from r2flow.generators import Flow, as_flow
from r2flow.metrics import METRICS
from r2flow.metrics.things import LINES
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.saving import weights_hash
from r2flow.reports.backbones import cost
from r2flow.reports.pages import Page, Plot, lines_figure
from r2flow.reports.tables import Row, shown, table

TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of the error of x_1
BATCH = 8
PATHS = 8  # scans of the bend
# Kinds of figures in the order of the table; those of `COSTS` are not judged. An untrained flow is
# straight, too.
JUDGED = ("distance", *LINES, "error of x_1")
COSTS = ("bend", "parameters", "GMAC", "ms", "images/s", "seconds")
RULE = (
    "Mean ± standard error over the seeds. * the best of its row, = no difference from the best: "
    "the intervals of mean ± 2 standard errors overlap. "
    "Lower is better; things are judged by their distance from the real value. "
    '"in 4": in 4 network evaluations.'
)

Groups = Mapping[str, Sequence[Row]]  # figures of each seed's run, by combination


def measure_run(run: Path, real: ScanSet, evaluations: Sequence[int], device: str) -> Row:
    """Figures of a run by their titles; they are stored in its folder and read from there.

    Every run has the same held-out scans and the same noise.
    """
    checkpoint = load_checkpoint(run, device)
    recipe = [weights_hash(checkpoint), real.label, len(real), str(real.identity), *evaluations]
    path = run / "ablation.json"
    if path.is_file():
        stored = read_json(path)
        if stored["recipe"] == recipe:
            return stored["figures"]
    costs = cost(checkpoint.config, 5, device)
    figures: Row = {
        "parameters, millions": costs["parameters"] / 1e6,
        "GMAC": costs["gmac"],
        "ms an evaluation": costs["latency_ms"],
    }
    figures |= _of_velocity(checkpoint, real, device)
    figures |= _of_samples(checkpoint, real, evaluations, device)
    write_file(path, json.dumps({"recipe": recipe, "figures": figures}, indent=1))
    return figures


@torch.no_grad()
def _of_velocity(checkpoint: Checkpoint, real: ScanSet, device: str) -> Row:
    """RMS error of x_1 at each time, in model space, and bend; none of a distilled flow."""
    flow = as_flow(checkpoint.generator, "an ablation", distilled=True)
    if flow.fixed:
        return {}
    squares = torch.zeros(len(TIMES), dtype=torch.float64)
    for first in range(0, len(real), BATCH):
        images = real[first : first + BATCH]
        x_1 = flow.space.encoding.encode(images).to(device)
        x_0 = Draws(0, range(first, first + len(x_1))).start(flow.noise_shape).to(device)
        squares += _squared_errors(flow, x_0, x_1)
    rms = (squares / len(real)).sqrt().tolist()
    errors = {f"error of x_1, t = {t}": value for t, value in zip(TIMES, rms, strict=True)}
    noise = Draws(0, range(PATHS)).start(flow.noise_shape).to(device)
    bend = straightness(flow.velocity, noise, steps=16).s_normalised.mean().item()
    return {**errors, "bend": bend}


def _squared_errors(flow: Flow, x_0: Tensor, x_1: Tensor) -> Tensor:
    """Mean squares of x_t + (1 - t) v - x_1 of each time, summed over the scans."""
    sums = []
    for t in TIMES:
        x_t, _ = interpolate(x_0, x_1, torch.full((len(x_1),), t, device=x_1.device))
        v = flow.velocity(torch.tensor(t, device=x_1.device), x_t)
        error = x_t + (1 - t) * v - x_1
        sums.append(error.double().square().flatten(1).mean(1).sum().cpu())
    return torch.stack(sums)


def _of_samples(
    checkpoint: Checkpoint, real: ScanSet, evaluations: Sequence[int], device: str
) -> Row:
    """Distance and things of as many samples as real scans, by numbers of evaluations."""
    generator = checkpoint.generator
    metrics = {name: METRICS[name]().to(device) for name in ("panel", "things")}
    compare = Comparer(metrics, Work(BATCH), PROTOCOLS["r2flow"], None, None, device)
    figures: Row = {}
    for count in evaluations:
        if generator.fixed and count != generator.sampler.evaluations(generator):
            continue
        sampler = generator.sampler if generator.fixed else generator.choose(steps=count)
        sampled = sampled_set(checkpoint, "", len(real), sampler)
        measured = {r.metric: r.figures for r in compare("judged", "", real, sampled).measured}
        figures[f"distance in {count}"] = measured["panel"]["panel"]
        for line in LINES:
            figures[f"{line} in {count}"] = measured["things"][line]
            figures[f"{line}, real"] = measured["things"][f"{line}, real"]
    return figures


def measures(groups: Groups) -> list[str]:
    """Titles of the figures in the order of the table."""
    titles = dict.fromkeys(title for rows in groups.values() for row in rows for title in row)
    kinds = (*JUDGED, *COSTS)
    return [
        title
        for kind in kinds
        for title in titles
        if title.startswith(kind) and not title.endswith(", real")
    ]


def kind_of(title: str) -> str:
    """The kind of a figure: its title without evaluations or time."""
    return next(kind for kind in (*JUDGED, *COSTS) if title.startswith(kind))


def table_rows(groups: Groups) -> list[Row]:
    """One row per figure: each combination's mean ± standard error, the real value, the verdict."""
    rows = []
    for title in measures(groups):
        level = best(groups, title)
        measured = [runs for runs in groups.values() if any(title in run for run in runs)]
        same = len(level) == len(measured) > 1
        row: Row = {"figure": title}
        for name, runs in groups.items():
            mark = ""
            if name in level and not same:
                mark = " *" if name == level[0] else " ="
            row[name] = _cell([run[title] for run in runs if title in run]) + mark
        row["real"] = next(iter(groups.values()))[0].get(f"{kind_of(title)}, real")
        row["verdict"] = "no difference" if same else ""
        rows.append(row)
    return rows


def best(groups: Groups, title: str) -> list[str]:
    """The best combination by a figure, then those that do not differ from it.

    None without a spread, and for a figure that is not judged.
    """
    if kind_of(title) in COSTS:
        return []
    intervals = {name: spread(errors(runs, title)) for name, runs in groups.items()}
    known = {name: one for name, one in intervals.items() if not math.isnan(one[1])}
    order = sorted(known, key=lambda name: known[name][0])
    if len(order) < 2:
        return []
    top = known[order[0]][0] + 2 * known[order[0]][1]
    return [name for name in order if known[name][0] - 2 * known[name][1] <= top]


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean and standard error of the mean; NaN where they are not defined."""
    if not values:
        return math.nan, math.nan
    error = stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return fmean(values), error


def errors(runs: Sequence[Row], title: str) -> list[float]:
    """A figure of each run; of things, its distance from the real value."""
    real = f"{kind_of(title)}, real"
    return [abs(run[title] - run.get(real, 0.0)) for run in runs if title in run]


def _cell(values: Sequence[float]) -> str:
    mean, error = spread(values)
    return shown(mean) if not error > 0 else f"{shown(mean)} ± {float(f'{error:.1g}'):g}"


def conclusion(groups: Groups, title: str) -> str:
    """All combinations in the order of a figure, and those that are best, in two sentences."""
    means = [(spread(errors(runs, title))[0], name) for name, runs in groups.items()]
    order = sorted(pair for pair in means if not math.isnan(pair[0]))
    listed = "; ".join(f"{name} {shown(mean)}" for mean, name in order)
    level = best(groups, title)
    verdict = "One seed: no verdict"
    if level:
        verdict = f"Best: {level[0]}"
    if len(level) > 1:
        verdict += f"; no difference: {'; '.join(level[1:])}"
    return f"{title.capitalize()}: {listed}. {verdict}."


def print_ablation(groups: Groups, page: Page) -> None:
    """Print the table, a part for each kind of figure, and the first sentences of the page."""
    console = Console(width=None if sys.stdout.isatty() else 160)
    grid = Table("figure", *groups, "real", "verdict", title=page.title, box=SIMPLE)
    rows = table_rows(groups)
    kinds = [kind_of(row["figure"]) for row in rows]
    for row, kind, after in zip(rows, kinds, [*kinds[1:], ""], strict=True):
        grid.add_row(*map(shown, row.values()), end_section=kind in JUDGED and kind != after)
    console.print(grid)
    print(*page.text[:2], RULE, sep="\n")


def figure_of(groups: Groups) -> Figure:
    """Distance against evaluations and error of x_1 against time, with mean ± 2 standard errors."""
    plots = []
    bands = []
    for start, label in (("distance in ", "network evaluations"), ("error of x_1, t = ", "t")):
        titles = [title for title in measures(groups) if title.startswith(start)]
        x = [float(title.removeprefix(start)) for title in titles]
        spreads = [[spread(errors(runs, title)) for title in titles] for runs in groups.values()]
        means = [[mean for mean, _ in one] for one in spreads]
        lines = {name: (x, y) for name, y in zip(groups, means, strict=True)}
        plots.append(Plot(label, kind_of(start), lines, log_x=label != "t"))
        bands.append((x, spreads))
    figure = lines_figure(plots, 2)
    for axes, (x, spreads) in zip(figure.axes, bands, strict=True):
        for line, one in zip(axes.lines, spreads, strict=True):
            low = [mean - 2 * error for mean, error in one]
            high = [mean + 2 * error for mean, error in one]
            axes.fill_between(x, low, high, color=line.get_color(), alpha=0.15, lw=0)
    return figure


def ablation_page(groups: Groups, swept: str, about: str, seeds: int, device: str) -> Page:
    """Build the page of an ablation: conclusion, table, figure; its rows are the runs."""
    runs = [
        {"combination": name, "seed": seed, **row}
        for name, rows in groups.items()
        for seed, row in enumerate(rows)
    ]
    last = [title for title in measures(groups) if title.startswith("distance")][-1:]
    sentences = [conclusion(groups, title) for title in last]
    rows = table_rows(groups)
    text = [*sentences, about, table(rows, {key: key for key in rows[0]}), RULE]
    figures = {"ablation": figure_of(groups)}
    return Page("ablation", f"Ablation: {swept}", text, runs, figures, {"runs": seeds}, device)


def write_csv(page: Page, path: Path) -> Path:
    """Write the rows of a page, one per run."""
    columns = list(dict.fromkeys(key for row in page.rows for key in row))
    lines = io.StringIO()
    writer = csv.DictWriter(lines, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(page.rows)
    write_file(path, lines.getvalue())
    return path
