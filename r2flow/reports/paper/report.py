"""Measure what the paper's tables and figures show, generator by generator, and write the page."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from r2flow import simulator
from r2flow.data.datamodule import ScanDataModule
from r2flow.errors import InputError
from r2flow.evaluation.measuring import Work, check_reflectance, gather_real
from r2flow.evaluation.protocols import PAPER, R2FLOW, Rules
from r2flow.evaluation.sets import ScanSet
from r2flow.evaluation.statistics import Cache
from r2flow.generators import Sampler
from r2flow.inversion import Interpolation, interpolate_scans
from r2flow.metrics.base import ScanMetric
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.reports.compare import cost
from r2flow.reports.curvature import measure_paths
from r2flow.reports.pages import Page
from r2flow.reports.paper.cells import SEED, CellSettings, counts_of, measure_cells
from r2flow.reports.paper.figures import marginals_apart
from r2flow.reports.paper.page import PaperResults, paper_page
from r2flow.reports.paper.subjects import PaperRun
from r2flow.reports.paper.tables import SIZE
from r2flow.runs.folder import read_config

FRAMES = 6  # of figure 3, as in the paper: both ends' round trips and four between


@dataclass(frozen=True)
class Budget:
    """How much is measured: `num` scans of each generator and number of steps, intervals from `bootstrap` resamplings.

    Attributes:
        steps: Of the generators that can be run in any number of them.
        curved: Scenes whose paths are followed for figure 8; 0 leaves it out.
        repeats: Timed evaluations of each network for table II; 0 leaves latency out.
        tolerance: Of dopri5 in the inversion of figure 3; None leaves it out.
    """

    num: int
    steps: tuple[int, ...]
    curved: int
    repeats: int
    bootstrap: int
    tolerance: float | None


def report(
    subjects: Sequence[PaperRun],
    out: Path,
    metrics: Mapping[str, ScanMetric],
    primary: str,
    missing: Mapping[str, str],
    budget: Budget,
    work: Work,
    real: ScanSet | None = None,
    device: str = "cpu",
    command: str = "",
    protocol: Rules | None = None,
) -> Page:
    """The page, still to be written; what is finished is kept in `out/cells`.

    Args:
        subjects: From `find_subjects`.
        metrics: By name, `jsd` among them.
        primary: The one that judges the paper's claims.
        missing: The paper's metrics that are not measured, and why.
        real: The scans to compare with; those that `first_of` held out if left out.
        protocol: The paper's where the real scans allow it, else ours, if left out.

    Raises:
        InputError: scans that cannot be read, or without the reflectance that a metric needs.
    """
    first = first_of(subjects)
    real = real or held_out(first)
    check_reflectance(metrics, [real])
    why = None if protocol else not_as_printed(real)
    rules = protocol or (R2FLOW if why else PAPER)
    gathered = gather_real(metrics, real, work, Cache(), rules)
    settings = CellSettings(real, metrics, gathered, budget.num, budget.bootstrap, work, out / "cells", device)
    metrics["jsd"].load_real_state(gathered.statistics["jsd"].states)
    ends = np.stack([real.source[index] for index in (len(real) // 4, 3 * len(real) // 4)])  # far apart in the set
    measured = PaperResults(subjects, real, counts_of(metrics["jsd"], "real"), ends, protocol=rules, why=why)
    costs: dict[str, dict[str, Any]] = {}
    for subject in subjects:
        flow = load_checkpoint(subject.run, device)
        measured.cells += measure_cells(settings, flow, subject, budget.steps)
        if budget.curved and subject.steps is None and not subject.system:
            most, label = max(budget.steps), subject.label
            with work.bar(f"following paths of {label}", 2 * most, "evaluations") as advance:
                measured.paths[label] = measure_paths(
                    flow, label, budget.curved, most, SEED, budget.curved, progress=advance
                )
        if subject.role == "1-RF":
            network = json.dumps(subject.config["backbone"], sort_keys=True)
            if network not in costs:
                costs[network] = cost(subject.config, budget.repeats, device)
            cell = measured.cells[-1]
            measured.architectures.append({
                "label": subject.label, "family": subject.family, "seed": subject.seed, "steps": cell.row["steps"],
                "backbone": subject.backbone, "position": subject.position, "kind": subject.kind,
                **{name: cell.row.get(name) for name in metrics},
                "marginals": marginals_apart(cell.birds_eye, measured.birds_eye), **costs[network],
            })  # fmt: skip
        if subject is first and not subject.system and budget.tolerance is not None and len(real) > 1:
            measured.between = _interpolate(flow, ends, Sampler("dopri5", tolerance=budget.tolerance), work)
        del flow
    better = {name: metric.better for name, metric in metrics.items()}
    return paper_page(measured, better, primary, missing, budget.num, command, device)


def first_of(subjects: Sequence[PaperRun]) -> PaperRun:
    """Whose scans the others are compared with: the first 1-RF's, else those of most channels and widest range."""
    return max(
        subjects, key=lambda one: (one.role == "1-RF", one.config["encoding"]["reflectance"], one.sensor.max_range)
    )


def not_as_printed(real: ScanSet) -> str | None:
    """Why scans cannot be compared as in the paper; None where they can."""
    if real.sensor.shape != SIZE:
        return f"its bins are those of an image of {SIZE[0]} x {SIZE[1]}"
    return PAPER.lacking(real)


def _interpolate(flow: Checkpoint, ends: np.ndarray, sampler: Sampler, work: Work) -> Interpolation:
    """Figure 3, between two scans, (2, 2 or 1, H, W)."""
    with work.bar("interpolating figure 3", FRAMES) as advance:
        return interpolate_scans(flow, torch.from_numpy(ends), FRAMES, sampler, arrived=lambda _: advance())


def held_out(subject: PaperRun) -> ScanSet:
    """All scans that a run held out of its training.

    Raises:
        InputError: a published file, which has none.
    """
    if "seed" not in subject.config:
        raise InputError(f"{subject.run} does not come with scans that were held out; give --real SCANS.")
    config = read_config(subject.run) or subject.config  # the folder's own knows where the scans have moved
    flow = load_checkpoint(subject.run)
    data = {**config["data"], "validation": {**(config["data"].get("validation") or {}), "scans": 10**9}}
    _, held = ScanDataModule(flow.sensor, flow.encoding, config["seed"], **data).sources()
    where = config["data"]["name"]
    # The run's seed is that of its simulated scenes, whose names are the same for every seed.
    identity = {
        "held out of": config.get("scans"), "data": _placeless(data), "sensor": subject.config["sensor"],
        "seed": config["seed"], "simulator": simulator.REVISION,
    }  # fmt: skip
    about = {"kind": "held out", "of": where, "reflectance": flow.encoding.reflectance}
    return ScanSet(f"held out of {where}", held, flow.sensor, about, identity)


def _placeless(data: Mapping[str, Any]) -> dict[str, Any]:
    """A data config without where the scans lie."""
    return {
        key: _placeless(value) if isinstance(value, Mapping) else value for key, value in data.items() if key != "root"
    }
