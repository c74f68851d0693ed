"""`r2flow ablate`."""

import re
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from r2flow.base.devices import choose_device
from r2flow.base.errors import check_folder
from r2flow.cli.app import app
from r2flow.cli.options import SETS, DeviceOption, OutOption, parse_counts, several

_UNITS = {"": 1, "s": 1, "min": 60, "h": 3600}


def parse_duration(text: str) -> float:
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
            parser=parse_duration,
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
        Option(parser=parse_counts, metavar="N,N,...", help="Network evaluations of samples."),
    ] = "1,2,4,16",
    out: OutOption = Path("runs/ablation"),
    device: DeviceOption = "auto",
) -> int:
    """Compare settings at equal training time: train every combination of values with several
    seeds, then measure cost and quality.

    The same command resumes. trainer.max_steps=N compares at equal steps instead.
    """
    from r2flow.base.progress import track
    from r2flow.base.signals import LATER
    from r2flow.data.opening import open_scans, reading_for
    from r2flow.model.checkpoint import load_checkpoint
    from r2flow.reports.ablation import ablation_page, measure_run, print_ablation, write_csv
    from r2flow.reports.pages import write_page
    from r2flow.runs.ablation import Ablation, training_cost

    where = choose_device(device)
    check_folder(out)
    ablation = Ablation(keys, seeds, budget, out)
    held_out = real or ablation.simulated()
    if not ablation.train():
        return LATER
    first = next(iter(ablation.runs.values()))[0]
    scans = open_scans(held_out, reading_for([held_out], load_checkpoint(first)), num=num)
    figures = {}
    for run in track([run for runs in ablation.runs.values() for run in runs], "measuring", "runs"):
        figures[run] = training_cost(run) | measure_run(run, scans, evaluations, where)
    groups = {name: [figures[run] for run in runs] for name, runs in ablation.runs.items()}
    count = several(seeds, "seed")
    about = f"{count}; {len(scans)} held-out scans of {scans.label}, as many samples."
    page = ablation_page(groups, ablation.swept, about, seeds, where)
    print_ablation(groups, page)
    print(*write_page(page, out), write_csv(page, out / "ablation.csv"), sep="\n")
    return 0
