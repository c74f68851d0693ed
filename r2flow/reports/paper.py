"""The paper's table I and figure 6 from runs: the printed numbers next to evaluated ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from r2flow.base.errors import InputError
from r2flow.base.files import read_json
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.saving import weights_hash
from r2flow.reports.evaluation import sampled_rows, speed_figure
from r2flow.reports.pages import Page
from r2flow.reports.tables import Part, Row, Table, short_names, shown
from r2flow.reports.verdict import PRINTED

_PRINTED = yaml.safe_load(Path(__file__).with_name("printed.yaml").read_text(encoding="utf-8"))
# Name in `r2flow.metrics` -> (heading, factor of the printed values).
COLUMNS = {
    key: PRINTED.get(key, (key.upper(), 1.0))
    for key in ("frd", "frid", "fpd", "fpvd", "fsvd", "jsd", "mmd")
}
_PROTOCOL = "paper, 10000 scans of 64x1024 against"  # of the printed rows, all scans of KITTI-360
_MANY = 16  # minimum evaluations of a row to compare with the paper's 256

# Generator -> the paper's name of the system.
_SYSTEMS = {
    "vanilla_gan": "Vanilla GAN",
    "dusty1": "DUSty v1",
    "dusty2": "DUSty v2",
    "score": "LiDARGen",
    "latent_diffusion": "LiDM",
    "diffusion": "R2DM",
}
# Stage -> role, and the stage that its parent was trained by.
_ROLES = {"rectify": ("1-RF", None), "reflow": ("2-RF", "rectify"), "distill": ("{}-TD", "reflow")}


@dataclass(frozen=True)
class PaperRun:
    """A generator and its role: "1-RF", "2-RF", "2-TD", or the method's name in table I for other
    systems.
    """

    role: str
    label: str
    checkpoint: Checkpoint


def role_of(checkpoint: Checkpoint, label: str) -> str:
    """The row of table I for a checkpoint, from its config; `label` if the config does not
    determine it.
    """
    generator = checkpoint.config.generator
    stage = checkpoint.config.stage
    system = _SYSTEMS.get(generator["name"])
    if system:
        if (generator.get("unet") or {}).get("position") == "learnable":
            system = f"{system} + APE"
        return system if checkpoint.encoding.reflectance else f"{system}, range"
    role, learned_from = _ROLES.get(stage.name, (label, None))
    if stage.parent and stage.parent.stage not in (None, learned_from):
        return label
    return role.format(stage.steps)


def report_paper(models: Sequence[str], results: Sequence[Path]) -> Page:
    """The page of the paper's table I and figure 6.

    Args:
        models: Runs, checkpoint files or models, as MODEL or ROLE=MODEL.
        results: JSON files of `r2flow evaluate`.
    """
    rows = [row for file in results for row in read_results(file)]
    runs = _paper_runs(models)
    run_of = {weights_hash(run.checkpoint): run for run in runs}
    evaluated = [
        {**row, "role": run_of[row["weights"]].role} for row in rows if row["weights"] in run_of
    ]
    names = ", ".join(f"{run.label} ({run.role})" for run in runs)
    if not evaluated:
        raise InputError(
            f"the results are of other models or checkpoints than {names}: evaluate these."
        )
    protocols = "; ".join(dict.fromkeys(row["protocol"] for row in evaluated))
    text: list[Part] = [
        f"Generators: {names}.",
        _table_i(evaluated),
        f"Evaluated rows: {protocols}. Printed rows: {_PROTOCOL} kitti_360. Figures with * are of "
        "another protocol than printed ones, and not comparable.",
    ]
    metrics = [f"{name}/{name}" for name in COLUMNS]
    metrics = [name for name in metrics if any(name in row for row in evaluated)]
    figures = {}
    if metrics:
        labelled = [
            {**row, "flow": f"{run_of[row['weights']].label} ({row['role']})"} for row in evaluated
        ]
        figures["figure_6"] = speed_figure(labelled, metrics)
    title = "The paper's table I and figure 6"
    return Page("paper", title, text, evaluated, figures, {}, "cpu")


def _paper_runs(models: Sequence[str]) -> list[PaperRun]:
    named = []
    for text in models:
        role, equals, model = text.partition("=")
        named.append((role, model) if equals and not Path(text).exists() else ("", text))
    labels = short_names([model for _, model in named])
    runs: list[PaperRun] = []
    for (role, model), label in zip(named, labels, strict=True):
        checkpoint = load_checkpoint(model)
        runs.append(PaperRun(role or role_of(checkpoint, label), model, checkpoint))
        if not checkpoint.generator.unconditional:
            raise InputError(f"{model} does not generate scans from noise.")
    return runs


def read_results(file: Path) -> list[Row]:
    """One row per sampled set in a JSON file of `r2flow evaluate` (`sampled_rows`)."""
    try:
        return sampled_rows(read_json(file)["comparisons"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        raise InputError(f"{file} is not a JSON file of `r2flow evaluate`.") from None


def _table_i(rows: Sequence[Row]) -> Table:
    """Table I as printed, with evaluated rows below: those of equal evaluations, or the most if
    both are many.

    Evaluated rows without a printed row come last.
    """
    lines = []
    left = list(rows)
    for printed in _PRINTED["table_1"]:
        lines.append({**printed, "of": "paper"})
        same = [row for row in rows if row["role"] == printed["method"]]
        most = max((row["evaluations"] for row in same), default=0)
        count = printed["evaluations"]
        if min(count, most) >= _MANY:
            count = most
        below = [row for row in same if row["evaluations"] == count]
        lines += map(_evaluated_line, below)
        left = [row for row in left if row not in below]
    lines += map(_evaluated_line, left)
    columns = {"method": "method", "of": "figures of", "evaluations": "NFE"}
    columns |= {name: title for name, (title, _) in COLUMNS.items()}
    return Table(lines, columns, "Table I: methods and metrics")


def _evaluated_line(row: Row) -> Row:
    """Columns of table I of an evaluated row, scaled as printed; * marks another protocol."""
    same = row["protocol"].startswith(_PROTOCOL) and " of kitti_360" in row["protocol"]
    line = {"method": row["role"], "of": row["flow"], "evaluations": row["evaluations"]}
    for name, (_, factor) in COLUMNS.items():
        value = row.get(f"{name}/{name}")
        if value is not None:
            line[name] = shown(value * factor) + ("" if same else "*")
    return line
