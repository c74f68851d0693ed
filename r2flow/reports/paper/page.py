"""The page of the paper's report: tables and figures in the paper's order, beside the printed ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from r2flow.evaluation.sets import ScanSet
from r2flow.inversion import Interpolation
from r2flow.reports.curvature import Paths, curvature_figure, curvature_text, summary, trajectories_figure
from r2flow.reports.evaluation import heading
from r2flow.reports.interpolation import interpolation_figure
from r2flow.reports.pages import Page, picture
from r2flow.reports.paper.cells import Cell
from r2flow.reports.paper.claims import FAILS, HOLDS, UNKNOWN, Claim, claims
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


@dataclass(frozen=True)
class PaperResults:
    """Everything that the page is made of.

    Attributes:
        subjects: The runs.
        real: The scans compared with.
        cells: Every flow at every number of steps.
        birds_eye: Points of the real scans from above, (100, 100).
        paths: Of the flows that are not distilled, by label.
        architectures: A row for each 1-RF.
        ends: Two real scans, (2, 2 or 1, H, W).
        between: Figure 3's frames, None where it was left out.
    """

    subjects: Sequence[PaperRun]
    real: ScanSet
    cells: Sequence[Cell]
    birds_eye: np.ndarray
    paths: Mapping[str, Paths]
    architectures: Sequence[dict[str, Any]]
    ends: np.ndarray
    between: Interpolation | None


def paper_page(
    measured: PaperResults, metrics: Sequence[str], missing: Mapping[str, str], num: int, command: str, device: str,
    seeds: Mapping[str, int],
) -> Page:  # fmt: skip
    """The page, still to be written."""
    rows = [cell.row for cell in measured.cells]
    headings = {name: heading(name, name)[0].partition(" x ")[0] for name in metrics}
    curved = curved_rows(measured)
    found = claims(rows, metrics, curved, measured.architectures)
    figures = figures_of(measured, rows, headings)
    parts = differences(
        data_in_words(measured.subjects), len(measured.real), num, measured.real.sensor.shape,
        [row["parameters"] for row in measured.architectures], images_seen(measured.subjects), missing,
    )  # fmt: skip
    text = [
        f"{len(measured.subjects)} runs; {num} scans of each flow and number of Euler steps, all from the same noise, "
        f"against {len(measured.real)} scans ({measured.real.label}).",
        "## The paper's claims, judged here",
        tally(found),
        claims_table(found),
        "*Holds* and *does not hold* are decided by the intervals over seeds or, for one seed, over scans.",
        "## What differs from the paper",
        "\n".join(f"- {part}" for part in parts),
        "## Table I: methods and metrics",
        ours(rows, headings),
        *remarks_of(rows),
        *_section("### The paper's figures beside ours", beside(rows, metrics)),
        "### As the paper prints it",
        printed_table(),
        "## Table II: velocity estimators",
        architectures_table(measured.architectures, headings),
        *_placed(figures, "figure_3", "## Figure 3: from scan to scan through the noise"),
        *_placed(figures, "figure_5", "## Figure 5: where points lie from above"),
        *_placed(figures, "figure_6", "## Figure 6: distance against evaluations and seconds"),
        *_placed(figures, "figure_7", "## Figure 7: scans"),
        *_placed(figures, "figure_8a", "## Figure 8: how straight the flows are"),
        *([picture("figure_8b")] if "figure_8b" in figures else []),
        *(curvature_text(list(measured.paths.values())) if measured.paths else []),
    ]
    more = {
        "claims": [vars(claim) for claim in found],
        "architectures": measured.architectures,
        "curvature": curved,
        "runs": [
            {"label": one.label, "role": one.role, "family": one.family, "seed": one.seed} for one in measured.subjects
        ],
    }
    title = "The paper's tables and figures"
    return Page("paper", title, text, rows, figures, command, seeds, device, more)


def remarks_of(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The remarks on the figures, each once."""
    said = dict.fromkeys(remark for row in rows for remark in str(row.get("remarks") or "").split(BETWEEN) if remark)
    return ["\n".join(f"- {remark}" for remark in said)] if said else []


def _section(title: str, body: str) -> list[str]:
    return [title, body] if body else []


def _placed(figures: Mapping[str, Figure], name: str, title: str) -> list[str]:
    return [title, picture(name)] if name in figures else []


def curved_rows(measured: PaperResults) -> list[dict[str, Any]]:
    """The rows on the paths that `claims` takes."""
    known = {one.label: one for one in measured.subjects}
    return [
        {**summary(paths), "role": known[label].role, "family": known[label].family}
        for label, paths in measured.paths.items()
    ]


def figures_of(
    measured: PaperResults, rows: Sequence[dict[str, Any]], headings: Mapping[str, str]
) -> dict[str, Figure]:
    """The figures by name; one without data is left out."""
    rays = measured.real.sensor.rays()
    figures: dict[str, Figure] = {}
    if measured.between is not None:
        frames = measured.between.images.nan_to_num(0.0).numpy()
        weights = measured.between.weights.tolist()
        figures["figure_3"] = interpolation_figure(measured.ends, frames, weights, rays, ("first", "last"))
    figures["figure_5"] = birds_eye_figure(measured.birds_eye, from_above(measured))
    figures["figure_6"] = trade_off_figure(rows, headings)
    figures["figure_7"] = scans_figure(measured)
    if measured.paths:
        paths = list(measured.paths.values())
        figures |= {"figure_8a": curvature_figure(paths), "figure_8b": trajectories_figure(paths)}
    return figures


def from_above(measured: PaperResults) -> dict[str, np.ndarray]:
    """The bird's-eye histogram of every kind of 1-RF at the most evaluations, added up over its seeds."""
    known = {one.label: one for one in measured.subjects}
    roots = [cell for cell in measured.cells if cell.row["role"] == "1-RF"]
    most = max(cell.row["steps"] for cell in roots)
    added: dict[str, np.ndarray] = {}
    for cell in roots:
        if cell.row["steps"] == most:
            name = known[cell.row["label"]].kind
            added[name] = added.get(name, 0) + cell.birds_eye
    return added


def scans_figure(measured: PaperResults) -> Figure:
    """Figure 7: a real scan, then the first scan of every flow of the first chain at the steps that table I has."""
    family = measured.cells[0].row["family"]
    chain = [cell for cell in measured.cells if cell.row["family"] == family]
    most = max(cell.row["steps"] for cell in chain)
    shown = [c for c in chain if c.row["steps"] in (1, most) or c.row["role"].endswith("TD")]
    channels = min(measured.ends.shape[1], shown[0].images.shape[1])
    images = [measured.ends[0][:channels], *(cell.images[0][:channels] for cell in shown)]
    titles = ["real", *(f"{c.row['role']}, NFE = {c.row['steps']}" for c in shown)]
    return contact_sheet(images, measured.real.sensor.rays(), titles)


def tally(found: Sequence[Claim]) -> str:
    counts = {verdict: sum(claim.verdict == verdict for claim in found) for verdict in (HOLDS, FAILS, UNKNOWN)}
    return (
        f"Of {len(found)} claims of the paper **{counts[HOLDS]} hold** here, **{counts[FAILS]} do not**, and of "
        f"**{counts[UNKNOWN]} these runs cannot tell**."
    )


def data_in_words(subjects: Sequence[PaperRun]) -> str:
    """What the 1-RFs were trained on."""
    names = {str(one.config["data"]["name"]): one.config.get("scans", "") for one in subjects if one.role == "1-RF"}
    return "; ".join(f"{name} ({scans})" if scans else name for name, scans in names.items())


def images_seen(subjects: Sequence[PaperRun]) -> list[int]:
    """Training images of each 1-RF."""
    return [
        int(one.config["trainer"]["max_steps"]) * int(one.config["data"]["batch_size"])
        for one in subjects
        if one.role == "1-RF"
    ]
