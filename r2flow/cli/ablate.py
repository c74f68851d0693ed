"""`r2flow ablate`."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.files import check_folder
from r2flow.cli.app import app
from r2flow.cli.options import SETS, DeviceOption, OutOption, parse_counts

_UNITS = {"": 1, "s": 1, "min": 60, "h": 3600}


def _parse_duration(text: str) -> float:
    """Seconds of a duration such as 10min, 90s or 1.5h."""
    found = re.fullmatch(r"(\d+\.?\d*) *(s|min|h|)", text)
    if found is None or float(found[1]) == 0:
        raise ValueError(text)
    return float(found[1]) * _UNITS[found[2]]


@app.command(
    rich_help_panel="Measure",
    epilog="Example: r2flow ablate backbone=hdit_tiny,vit_tiny backbone.prediction=velocity,data "
    "--budget 1h",
)
def ablate(
    keys: Annotated[
        list[str],
        Argument(metavar="KEY=VALUE,VALUE...", help="Config keys, some with several values."),
    ],
    budget: Annotated[
        Any,
        Option(
            parser=_parse_duration,
            metavar="TIME",
            help="Training time of all runs together, as 10min or 2h. Measuring comes on top.",
        ),
    ] = "10min",
    seeds: Annotated[int, Option(min=1, help="Runs of each combination.")] = 3,
    real: Annotated[
        str | None,
        Option(help=f"Held-out scans: {SETS}. Default for simulated training scans: simulated."),
    ] = None,
    num: Annotated[int, Option(min=2, help="Held-out scans, and samples of each run.")] = 64,
    evaluations: Annotated[
        Any,
        Option(
            parser=parse_counts,
            metavar="N,N,...",
            help="Network evaluations of samples. Default: 1,2,4,16; of systems, each one's own.",
        ),
    ] = None,
    format: Annotated[
        Literal["md", "tex"], Option(help="tex: also write the table for LaTeX.")
    ] = "md",
    rows: Annotated[
        Path | None,
        Option(help="CSV of the finished runs, of any budget. Default: OUT/ablation.csv."),
    ] = None,
    steps: Annotated[
        Path | None,
        Option(help="CSV whose runs give the training steps, to repeat them in another --rows."),
    ] = None,
    workers: Annotated[
        int, Option(min=1, help="Runs at once on a processor, each with one thread if several.")
    ] = 1,
    out: OutOption = Path("runs/ablation"),
    device: DeviceOption = "auto",
) -> int:
    """Compare settings at equal training time: train every combination of values with several
    seeds, then measure cost and quality.

    The same command resumes. Runs in the CSV are not trained again, so that another machine goes
    on with the missing ones. trainer.max_steps=N compares at equal steps instead.
    """
    from r2flow.base.files import write_file
    from r2flow.base.signals import LATER
    from r2flow.reports.ablation_page import COLUMNS
    from r2flow.reports.pages import print_text, write_page
    from r2flow.reports.tables import latex
    from r2flow.runs.ablate import ablate as train_and_measure
    from r2flow.runs.ablation import Ablation

    where = choose_device(device)
    check_folder(out)
    csv = rows or out / "ablation.csv"
    ablation = Ablation(keys, seeds, budget, out)
    page = train_and_measure(
        ablation,
        csv,
        real,
        num,
        evaluations,
        where,
        workers,
        steps,
        follow=lambda page: write_page(page, out),
    )
    if page is None:
        return LATER
    print_text(page.text)
    written = [*write_page(page, out), csv]
    if format == "tex":
        write_file(out / "ablation.tex", latex(page.rows, COLUMNS))
        written.append(out / "ablation.tex")
    print(*written, sep="\n")
    return 0
