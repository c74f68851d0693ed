"""`r2flow evaluate`: compare generated with real scans."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument

from r2flow.base.devices import choose_device
from r2flow.base.errors import InputError, check
from r2flow.base.files import check_folder
from r2flow.cli.app import app
from r2flow.cli.options import SETS, ReadingOptions, grouped
from r2flow.cli.sets import EvaluateOptions, judged_sets, open_set, possible_metrics, reading_of

if TYPE_CHECKING:
    from r2flow.data.sets import ScanSet


@app.command(
    rich_help_panel="Measure",
    epilog="Example: r2flow evaluate kitti_360:/data/KITTI-360 runs/1rf runs/2rf "
    "--split test --json e.json",
)
@grouped
def evaluate(
    real: Annotated[str, Argument(help=f"Real scans: {SETS}.")],
    options: EvaluateOptions,
    how: ReadingOptions,
    generated: Annotated[
        list[str] | None,
        Argument(
            help="Sets of generated scans, as REAL, or runs, checkpoints or models to sample."
        ),
    ] = None,
) -> None:
    """Evaluate generated scans against real scans: distances with their protocols and sensor.

    One table compares all sets with reference distances between real scans and with baselines.
    Models are sampled; several --steps or --sampler plot distance against evaluations and seconds.
    The same command with --out resumes. Under torchrun, processes share the scans.
    """
    from r2flow.base.processes import process_group

    named = list(dict.fromkeys(generated or []))
    if not (named or options.reference or options.baselines):
        raise InputError("nothing to compare with: give GENERATED or --reference.")
    if options.metrics == "miou":
        check(
            bool(named),
            "miou compares labels: give GENERATED, scans with labels of the same names.",
        )
        check(
            not (options.json or options.out), "miou is printed alone: leave --json and --out out."
        )
        from r2flow.reports.labels import label_tables
        from r2flow.reports.pages import print_text

        ids = (how.label_ids or "semantic_kitti").split(",")
        for name in named:
            print_text(label_tables(real, name, ids))
        return
    with process_group(choose_device(options.device)) as device:
        _evaluate(real, named, options, how, device)


def _evaluate(
    real: str, named: Sequence[str], options: EvaluateOptions, how: ReadingOptions, device: str
) -> None:
    from r2flow.base.processes import rank_and_world_size
    from r2flow.data.described import describe
    from r2flow.evaluation.comparing import Comparer
    from r2flow.evaluation.evaluate import evaluate
    from r2flow.evaluation.measuring import Work
    from r2flow.evaluation.protocols import PROTOCOLS
    from r2flow.evaluation.sets import is_checkpoint
    from r2flow.metrics import METRICS
    from r2flow.model.checkpoint import load_checkpoint

    rules = PROTOCOLS[options.protocol]
    named_metrics: dict[str, Any] = {}
    if options.metrics not in (None, "all"):
        named_metrics = {name: METRICS[name]().to(device) for name in options.metrics.split(",")}
    flows = {name: load_checkpoint(name, device) for name in named if is_checkpoint(name)}
    files = {name: describe(name) for name in named if name not in flows}
    truths = describe(real, split=options.split)
    trained = describe(options.train, split=options.train_split) if options.train else None
    how = replace(how, convention=how.convention or rules.convention)
    specs = [truths, *files.values(), *([trained] if trained else [])]
    reading = reading_of(how, specs, list(flows.values()))
    used = [m.needs_reflectance or m.uses_reflectance for m in named_metrics.values()]
    if used and not any(used):
        reading = replace(reading, reflectance=False)  # else a scale would be required
    truth = open_set(truths, reading, options.real_num)
    judged = judged_sets(named, flows, files, reading, options)
    sets = [truth, *judged.values()]
    reflectance = all(scans.about.get("reflectance") for scans in sets)
    metrics = named_metrics or possible_metrics(reflectance, options, device)
    work = Work(options.batch_size, options.workers)
    results = options.out and options.out / "results"
    compare = Comparer(metrics, work, rules, results)
    training = open_set(trained, reading, None) if trained else None
    for folder in filter(None, (options.out, options.json and options.json.parent)):
        check_folder(folder)
    reference = options.reference, options.baselines
    comparisons = evaluate(truth, judged, compare, training, *reference, device)
    if rank_and_world_size()[0] == 0:  # the first process prints and writes the results
        _write(comparisons, {"real": truth, **judged}, options, device)


def _write(
    comparisons: Sequence[Any], sets: "Mapping[str, ScanSet]", options: EvaluateOptions, device: str
) -> None:
    """Print the results; write them if --json or --out is given."""
    from r2flow.reports.evaluation import evaluation_page, print_comparisons
    from r2flow.reports.pages import write_json, write_page
    from r2flow.reports.view.panels import write_sets

    page = evaluation_page(comparisons, device, {"sampled scans": options.seed})
    print_comparisons(comparisons)
    if options.json is not None:
        write_json(page, options.json)
        print(options.json)
    if options.out is not None:
        print(*write_page(page, options.out), sep="\n")
        viewer = options.out / "evaluation.html"
        print(write_sets(viewer, sets, title="Generated and real scans"))
