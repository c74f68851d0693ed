"""The page of the paper's report: tables and figures in the paper's order, beside the printed ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.evaluation.protocols import PAPER, Rules
from r2flow.evaluation.sets import ScanSet
from r2flow.inversion import Interpolation
from r2flow.metrics.base import Better
from r2flow.reports.curvature import Paths, curvature_figure, curvature_text, summary, trajectories_figure
from r2flow.reports.evaluation import heading
from r2flow.reports.interpolation import interpolation_figure
from r2flow.reports.pages import Page, picture
from r2flow.reports.paper.cells import SEED, Cell
from r2flow.reports.paper.claims import Claim, claims
from r2flow.reports.paper.figures import birds_eye_figure, trade_off_figure
from r2flow.reports.paper.subjects import PaperRun
from r2flow.reports.paper.tables import (
    architectures_table,
    beside,
    claims_table,
    differences,
    ours,
    printed_table,
)
from r2flow.reports.pictures import contact_sheet
from r2flow.reports.speed_quality import BETWEEN
from r2flow.reports.verdicts import FAILS, HOLDS, UNKNOWN


@dataclass
class PaperResults:
    """What was measured.

    Attributes:
        birds_eye: Points of the real scans from above, (100, 100).
        ends: Two real scans, (2, 2 or 1, H, W), and between them figure 3's frames.
        cells: Every generator at every number of steps.
        paths: Of the paper's flows that are not distilled, by label.
        architectures: A row for each 1-RF.
    """

    subjects: Sequence[PaperRun]
    real: ScanSet
    birds_eye: np.ndarray
    ends: np.ndarray
    cells: list[Cell] = field(default_factory=list)
    paths: dict[str, Paths] = field(default_factory=dict)
    architectures: list[dict[str, Any]] = field(default_factory=list)
    between: Interpolation | None = None
    protocol: Rules = PAPER
    why: str | None = None  # another one than the paper's


def paper_page(
    measured: PaperResults,
    metrics: Mapping[str, Better],
    primary: str,
    missing: Mapping[str, str],
    num: int,
    command: str,
    device: str,
) -> Page:
    """The page, still to be written; the primary one of the metrics judges."""
    rows = [cell.row for cell in measured.cells]
    headings = {name: heading(name, name)[0].partition(" x ")[0] for name in metrics}
    known = {one.label: one for one in measured.subjects}
    curved = [
        {**summary(paths), "role": known[label].role, "family": known[label].family, "kind": known[label].kind}
        for label, paths in measured.paths.items()
    ]
    roots = [one.config for one in measured.subjects if one.role == "1-RF"]
    found = claims(rows, metrics, primary, curved, measured.architectures) if roots else []
    figures = figures_of(measured, rows, headings)
    learned = roots or [one.config for one in measured.subjects]
    scans = {str(config["data"]["name"]): config.get("scans", "") for config in learned}
    parts = differences(
        "; ".join(f"{name} ({which})" if which else name for name, which in scans.items()),
        len(measured.real), num, measured.real.sensor.shape, [row["parameters"] for row in measured.architectures],
        [int(config["trainer"]["max_steps"]) * int(config["data"]["batch_size"]) for config in roots], missing,
        measured.protocol, measured.why,
    )  # fmt: skip
    parts += ranges_apart(measured)
    # Under another protocol the figures would look comparable and are not.
    side_by_side = beside(rows, list(metrics)) if measured.protocol is PAPER else ""
    text = [
        f"{len(measured.subjects)} generators; {num} scans of each and each number of steps (Euler's of a flow), "
        f"against {len(measured.real)} scans ({measured.real.label}), under the protocol `{measured.protocol.name}`.",
        *(claimed(found, primary) if found else []),
        "## What differs from the paper",
        "\n".join(f"- {part}" for part in parts),
        "## Table I: methods and metrics",
        ours(rows, headings),
        *remarks_of(rows),
        *(["### The paper's figures beside ours", side_by_side] if side_by_side else []),
        "### As the paper prints it",
        printed_table(),
        *(["## Table II: velocity estimators", architectures_table(measured.architectures, headings)] if roots else []),
    ]
    titles = {
        "figure_3": "## Figure 3: from scan to scan through the noise",
        "figure_5": "## Figure 5: where points lie from above",
        "figure_6": "## Figure 6: distance against evaluations and seconds",
        "figure_7": "## Figure 7: scans",
        "figure_8a": "## Figure 8: how straight the flows are",
    }
    for name in figures:
        text += [*([titles[name]] if name in titles else []), picture(name)]
    text += curvature_text(list(measured.paths.values())) if measured.paths else []
    runs = [{"label": one.label, "role": one.role, "family": one.family, "seed": one.seed} for one in known.values()]
    more = {
        "claims": [vars(claim) for claim in found], "architectures": measured.architectures, "curvature": curved,
        "runs": runs, "protocol": [measured.protocol.describe()],
    }  # fmt: skip
    title, seeds = "The paper's tables and figures", {"sampled scans": SEED}
    return Page("paper", title, text, rows, figures, command, seeds, device, more)


def claimed(found: Sequence[Claim], primary: str) -> list[str]:
    """The claims' section; the first paragraph after its heading sums it up."""
    return [
        "## The paper's claims, judged here",
        tally(found),
        claims_table(found),
        f"`{primary}`, chosen before anything was measured (`--primary`), judges by Student's 95 % intervals over "
        "training seeds; one seed gives no verdict. Where there is no difference, a claim gets a verdict either way in "
        "at most 5 % of cases: each of them by itself, not all of them together.",
    ]


def ranges_apart(measured: PaperResults) -> list[str]:
    """A sentence on generators whose scans reach less or more far than the real ones that they are compared with."""
    real = measured.real.sensor
    said = {
        one.role: f"{one.role} {one.sensor.min_range:g} to {one.sensor.max_range:g} m"
        for one in measured.subjects
        if (one.sensor.min_range, one.sensor.max_range) != (real.min_range, real.max_range)
    }
    if not said:
        return []
    return [f"**Ranges:** real scans {real.min_range:g} to {real.max_range:g} m; {', '.join(said.values())}."]


def remarks_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The remarks on the figures, each once."""
    said = dict.fromkeys(remark for row in rows for remark in str(row.get("remarks") or "").split(BETWEEN) if remark)
    return ["\n".join(f"- {remark}" for remark in said)] if said else []


def tally(found: Sequence[Claim]) -> str:
    counts = {verdict: sum(claim.verdict == verdict for claim in found) for verdict in (HOLDS, FAILS, UNKNOWN)}
    return (
        f"Of {len(found)} claims of the paper **{counts[HOLDS]} hold** here, **{counts[FAILS]} do not**, and of "
        f"**{counts[UNKNOWN]} these runs cannot tell**."
    )


def figures_of(
    measured: PaperResults, rows: Sequence[dict[str, Any]], headings: Mapping[str, str]
) -> dict[str, Figure]:
    """The figures by name, in the paper's order; one without data is left out."""
    rays = measured.real.sensor.rays()
    figures: dict[str, Figure] = {}
    if measured.between is not None:
        frames = measured.between.images.nan_to_num(0.0).numpy()
        weights = measured.between.weights.tolist()
        figures["figure_3"] = interpolation_figure(measured.ends, frames, weights, rays, ("first", "last"))
    figures["figure_5"] = birds_eye_figure(measured.birds_eye, from_above(measured.cells))
    figures["figure_6"] = trade_off_figure(rows, headings)
    figures["figure_7"] = scans_figure(measured)
    if measured.paths:
        paths = list(measured.paths.values())
        figures |= {"figure_8a": curvature_figure(paths), "figure_8b": trajectories_figure(paths)}
    return figures


def from_above(cells: Sequence[Cell]) -> dict[str, np.ndarray]:
    """Bird's-eye histograms at the most evaluations, added up over seeds: of every kind of 1-RF and, as in the paper,
    LiDM without and with APE; of all systems where there is none of these.
    """
    added: dict[str, np.ndarray] = {}
    for only in (("1-RF", "LiDM"), ("",)):
        for cell in cells:
            role = cell.row["role"]
            most = max(one.row["steps"] for one in cells if one.row["role"] == role)
            if role.startswith(only) and cell.row["steps"] == most:
                name = cell.row["kind"] or role
                added[name] = added.get(name, 0) + cell.birds_eye
        if added:
            break
    return added


def scans_figure(measured: PaperResults) -> Figure:
    """Figure 7: a real scan, then the first scan of each other system at its most evaluations, and of every flow of the
    first chain at the steps that table I has.
    """
    systems = {one.role for one in measured.subjects if one.system}
    best = {c.row["role"]: c for c in sorted(measured.cells, key=lambda c: c.row["steps"]) if c.row["role"] in systems}
    flows = [cell for cell in measured.cells if cell.row["role"] not in systems]
    chain = [cell for cell in flows if cell.row["family"] == flows[0].row["family"]]
    most = max((cell.row["steps"] for cell in chain), default=0)
    shown = [*best.values(), *(c for c in chain if c.row["steps"] in (1, most) or c.row["role"].endswith("TD"))]
    channels = min(measured.ends.shape[1], *(cell.images.shape[1] for cell in shown))
    images = [measured.ends[0][:channels], *(cell.images[0][:channels] for cell in shown)]
    titles = ["real", *(f"{c.row['role']}, NFE = {c.row['steps']}" for c in shown)]
    return contact_sheet(images, measured.real.sensor.rays(), titles)
