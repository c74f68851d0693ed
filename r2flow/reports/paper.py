"""The paper's tables I and II and figures 3 and 5 to 8 from runs: the printed numbers next to evaluated ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from r2flow.data.sets import ScanSet
from r2flow.errors import InputError, check
from r2flow.files import read_json
from r2flow.generators import Flow
from r2flow.inversion import interpolate_scans
from r2flow.lidar.projection import image_to_points
from r2flow.metrics.jsd_mmd import js_distance
from r2flow.metrics.scans import EXTENT, birds_eye_histogram
from r2flow.model.checkpoint import Checkpoint, weights_hash
from r2flow.progress import track
from r2flow.reports.backbones import cost
from r2flow.reports.curvature import curvature_figure, curvature_text, measure_paths, trajectories_figure
from r2flow.reports.evaluation import points, speed_figure
from r2flow.reports.interpolation import interpolation_figure
from r2flow.reports.pages import Page, blank_figure
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.printed import COLUMNS, TABLE_I, TABLE_II, Architecture
from r2flow.reports.tables import Row, shown, table

PROTOCOL = "paper, 10000 scans of 64x1024 against"  # of the printed rows, all scans of KITTI-360
MANY = 16  # minimum evaluations of a row to compare with the paper's 256

# Generator -> the paper's name of the system.
SYSTEMS = {
    "vanilla_gan": "Vanilla GAN", "dusty1": "DUSty v1", "dusty2": "DUSty v2", "score": "LiDARGen",
    "latent_diffusion": "LiDM", "diffusion": "R2DM",
}  # fmt: skip


@dataclass(frozen=True)
class PaperRun:
    """A generator and its role: "1-RF", "2-RF", "2-TD", or the method's name in table I for other systems."""

    role: str
    label: str
    checkpoint: Checkpoint


def role_of(checkpoint: Checkpoint, label: str) -> str:
    """The row of table I for a checkpoint, from its config; `label` if the config does not determine it."""
    config = checkpoint.config
    options, stage = config.get("generator") or {}, config.get("stage") or {}
    if system := SYSTEMS.get(options.get("name", "")):
        if system == "LiDM" and (options.get("unet") or {}).get("position") == "learnable":
            system = "LiDM + APE"
        return system if checkpoint.encoding.reflectance else f"{system}, range"
    role, learned_from = {
        "rectify": ("1-RF", None), "reflow": ("2-RF", "rectify"), "distill": (f"{stage.get('steps')}-TD", "reflow")
    }.get(stage.get("name", ""), (label, None))  # fmt: skip
    return role if (config.get("parent") or {}).get("stage") in (None, learned_from) else label


def paper_page(
    runs: Sequence[PaperRun],
    rows: Sequence[Row],
    real: ScanSet | None,
    num: int,
    steps: int,
    device: str,
) -> Page:
    """Build the page from rows of `read_results`; without `real` scans it has no figure 3.

    Figures 5 and 7 have `num` scans per generator, figure 8 four paths of `steps` Euler steps.
    """
    run_of = {weights_hash(run.checkpoint): run for run in runs}
    evaluated = [{**row, "role": run_of[row["weights"]].role} for row in rows if row["weights"] in run_of]
    names = ", ".join(f"{run.label} ({run.role})" for run in runs)
    check(evaluated or not rows, f"the results are of other models or checkpoints than {names}: evaluate these.")
    architectures = architecture_rows(runs, evaluated, device)
    text = [f"Generators: {names}.", "## Table I: methods and metrics", table_i(evaluated)]
    if protocols := "; ".join(dict.fromkeys(row["protocol"] for row in evaluated)):
        text.append(f"Evaluated rows: {protocols}. Printed rows: {PROTOCOL} kitti_360. "
                    "Figures with * are of another protocol than printed ones, and not comparable.")  # fmt: skip
    if architectures:
        text += ["## Table II: velocity estimators", table(architectures, ARCHITECTURES)]
    figures: dict[str, Figure] = {}
    flows = [run for run in runs if isinstance(g := run.checkpoint.generator, Flow) and not g.fixed]
    if real is not None and len(real) > 1 and flows and flows[0].role not in SYSTEMS.values():
        figures["figure_3"] = between_figure(flows[0].checkpoint, real)
    tracked = track(runs, "sampling", "generators")
    samples = {run.label: run.checkpoint.sample(num).nan_to_num(0.0).numpy() for run in tracked}
    scans = None if real is None else real.spread(num)[:].numpy()
    figures["figure_5"] = birds_eye_figure(
        {run.label: _birds_eye(samples[run.label], run.checkpoint) for run in runs},
        None if scans is None else _birds_eye(scans, runs[0].checkpoint),
    )
    if metrics := [f"{name}/{name}" for name in COLUMNS if any(f"{name}/{name}" in row for row in evaluated)]:
        labelled = [{**row, "flow": f"{run_of[row['weights']].label} ({row['role']})"} for row in evaluated]
        figures["figure_6"] = speed_figure(labelled, metrics)
    figures["figure_7"] = scans_figure(runs, samples, scans)
    if flows:
        tracked = track(flows, "following paths")
        paths = {run.label: measure_paths(run.checkpoint, run.label, steps=steps, batch_size=4) for run in tracked}
        figures |= {"figure_8a": curvature_figure(paths), "figure_8b": trajectories_figure(paths)}
        text += ["## Figure 8: straightness", *curvature_text(paths)]
    return Page(
        "paper", "The paper's tables and figures", text, evaluated, figures, {"sampled scans": 0}, device,
        {"architectures": architectures},
    )  # fmt: skip


def read_results(files: Sequence[Path]) -> list[dict[str, Any]]:
    """One row per sampled set in the JSON files of `r2flow evaluate`; see `r2flow.reports.evaluation.points`."""
    rows = []
    for file in files:
        try:
            rows += points(read_json(file)["comparisons"])
        except (OSError, ValueError, LookupError, TypeError, AttributeError):
            raise InputError(f"{file} is not a JSON file of `r2flow evaluate`.") from None
    return rows


def table_i(rows: Sequence[Row]) -> str:
    """Table I as printed, with evaluated rows below: those of equal evaluations, or the most if both are >= `MANY`.

    Evaluated rows without a printed row come last.
    """
    lines: list[dict[str, Any]] = []
    placed: list[Row] = []
    for printed in TABLE_I:
        count = printed.evaluations
        line: dict[str, Any] = {"method": printed.method, "of": "paper", "evaluations": count}
        lines.append(line | dict(zip(COLUMNS, printed.figures, strict=True)))
        same = [row for row in rows if row["role"] == printed.method]
        most = max((row["evaluations"] for row in same), default=0)
        like = [row for row in same if row["evaluations"] in ((count, most) if min(count, most) >= MANY else (count,))]
        lines += map(_evaluated, like)
        placed += like
    lines += [_evaluated(row) for row in rows if row not in placed]
    headings = {name: heading for name, (heading, _) in COLUMNS.items()}
    return table(lines, {"method": "method", "of": "figures of", "evaluations": "NFE", **headings})


def _evaluated(row: Row) -> dict[str, Any]:
    """Columns of table I of an evaluated row, scaled as printed; * marks another protocol."""
    mark = "" if row["protocol"].startswith(PROTOCOL) and " of kitti_360" in row["protocol"] else "*"
    figures = {n: shown(row[key] * factor) + mark for n, (_, factor) in COLUMNS.items() if (key := f"{n}/{n}") in row}
    return {"method": row["role"], "of": row["flow"], "evaluations": row["evaluations"], **figures}


ARCHITECTURES = {
    "backbone": "backbone", "parameters": "parameters", "gmac": "GMAC", "gmac_printed": "paper",
    "latency_ms": "ms an evaluation", "latency_printed": "paper", "frd_marked": "FRD", "frd_printed": "paper",
}  # fmt: skip


def architecture_rows(runs: Sequence[PaperRun], rows: Sequence[Row], device: str) -> list[dict[str, Any]]:
    """Table II: one row per 1-RF, with the printed row of equal parameters, and FRD of the most evaluations."""
    lines = []
    for run in (run for run in runs if run.role == "1-RF"):
        config = run.checkpoint.config
        row = {"backbone": (config["backbone"] or {}).get("name"), **cost(config, 3, device)}
        if printed := same_architecture(row["parameters"]):
            row |= {"gmac_printed": printed.gmac, "latency_printed": printed.latency_ms, "frd_printed": printed.frd}
        of_run = [r for r in rows if r["weights"] == weights_hash(run.checkpoint) and "frd/frd" in r]
        best = max((r for r in of_run if r["evaluations"] >= MANY), key=lambda r: r["evaluations"], default=None)
        lines.append(row | ({"frd": best["frd/frd"], "frd_marked": _evaluated(best)["frd"]} if best else {}))
    return lines


def same_architecture(parameters: int) -> Architecture | None:
    """The row of table II with this number of parameters, within 0.4 % (the printed 125.5 M are 125.2 M)."""
    return next((row for row in TABLE_II.values() if abs(parameters - row.parameters) < 4e-3 * row.parameters), None)


def between_figure(checkpoint: Checkpoint, real: ScanSet) -> Figure:
    """Figure 3: interpolation between two distant scans of the set."""
    ends = np.stack([real.source[index] for index in (len(real) // 4, 3 * len(real) // 4)])
    result = interpolate_scans(checkpoint, torch.from_numpy(ends), 6)  # as in the paper, with round trips of both ends
    frames = result.images.nan_to_num(0.0).numpy()
    return interpolation_figure(ends, frames, result.weights.tolist(), checkpoint.sensor.rays(), ("first", "last"))


def _birds_eye(images: np.ndarray, checkpoint: Checkpoint) -> np.ndarray:
    return np.sum([birds_eye_histogram(image_to_points(image, checkpoint.sensor)[0]) for image in images], axis=0)


def marginals_apart(a: np.ndarray, b: np.ndarray) -> float:
    """Mean Jensen-Shannon distance of the marginals of two bird's-eye histograms, (100, 100)."""
    return float(np.mean([js_distance(a.sum(axis), b.sum(axis)) for axis in (0, 1)]))


def birds_eye_figure(made: Mapping[str, np.ndarray], real: np.ndarray | None) -> Figure:
    """Figure 5: bird's-eye histograms, (100, 100) each, with marginals; dotted: real scans."""
    shown = {**made, **({} if real is None else {"real scans": real})}
    figure = blank_figure(2.75 * len(shown) + 0.5, 3.6)
    panels = figure.subplots(2, 2 * len(shown), squeeze=False, width_ratios=(3.2, 1) * len(shown),
                             height_ratios=(1, 3.2))  # fmt: skip
    centres = (np.arange(100) + 0.5) / 100 * 2 * EXTENT - EXTENT
    for place, (name, counts) in enumerate(shown.items()):
        (top, corner), (axes, right) = panels[:, 2 * place : 2 * place + 2]
        share = counts / max(counts.sum(), 1)
        # Forward is up and left is left, as in all bird's-eye views.
        axes.imshow(np.log10(share[::-1, ::-1] + 1e-7), extent=(EXTENT, -EXTENT, -EXTENT, EXTENT), cmap="magma",
                    vmin=-6, vmax=-2, aspect="auto")  # fmt: skip
        axes.set(xlabel="y, m", ylabel="x, m" if place == 0 else "")
        for histogram, style in ((counts, {"color": "#1f6fb4"}), (real, {"color": "0.2", "ls": ":"})):
            if histogram is not None:
                part = histogram / max(histogram.sum(), 1)
                top.plot(centres, part.sum(0), lw=0.9, **style)
                right.plot(part.sum(1), centres, lw=0.9, **style)
        top.set(xlim=(EXTENT, -EXTENT))
        right.set(ylim=(-EXTENT, EXTENT))
        for panel in (top, right, corner):
            panel.set_axis_off()
        distance = "" if real is None or counts is real else f"JSD of marginals {marginals_apart(counts, real):.3f}"
        top.set_title(f"{name}\n{distance}", fontsize=8)
    return figure


def scans_figure(runs: Sequence[PaperRun], drawn: Mapping[str, np.ndarray], real: np.ndarray | None) -> Figure:
    """Figure 7: a real scan, and the first sample of each generator."""
    images, titles = ([], []) if real is None else ([real[0]], ["real"])
    for run in runs:
        generator = run.checkpoint.generator
        count = generator.sampler.evaluations(generator)
        images.append(drawn[run.label][0])
        titles.append(f"{run.role}, {f'NFE {count}' if count else 'adaptive steps'}")
    channels = min(map(len, images))
    return contact_sheet([image[:channels] for image in images], runs[0].checkpoint.sensor.rays(), titles)
