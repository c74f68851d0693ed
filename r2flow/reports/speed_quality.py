"""Distance to real scans against evaluations and seconds: the paper's figure 6."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle, product
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from r2flow.errors import InputError
from r2flow.evaluation.measuring import Gathered, Work, measure, point_key
from r2flow.evaluation.sets import SampledScans, ScanSet, sampled_set
from r2flow.files import read_json
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.metrics.base import ScanMetric
from r2flow.model.checkpoint import Checkpoint, weights_hash
from r2flow.reports.evaluation import heading
from r2flow.reports.pages import STYLES, Page, blank_figure, few_log_ticks
from r2flow.reports.tables import shown, table

NAME = "speed_quality"
BETWEEN = " | "  # remarks of a row
ENDS = (" low", " high")  # of the names of an interval's ends
AXES = (("evaluations", "network evaluations a scan"), ("seconds", "seconds a scan"))


@dataclass(frozen=True)
class Drawing:
    """What is drawn at each point of a curve: scans, by each generator's own sampler with these name and fields."""

    num: int
    seed: int
    sampler_options: Mapping[str, Any] = field(default_factory=dict)
    precision: Precision = "32-true"

    def sampler(self, flow: Checkpoint, steps: int) -> Sampler:
        """How a flow is run at this number of steps."""
        how = flow.generator.choose(**self.sampler_options)
        return flow.generator.choose(**{"steps": steps, **self.sampler_options}) if hasattr(how, "steps") else how


@dataclass(frozen=True)
class Curve:
    """What every point of a speed-quality curve has in common.

    Attributes:
        real: The scans that it is measured against.
        gathered: Their statistics, for the metrics.
        drawings: Each is a line of its own for each flow.
        device: What the network runs on, in words.
        bootstrap: Resamples for 95 % intervals; 0 for none.
    """

    real: ScanSet
    metrics: Mapping[str, ScanMetric]
    gathered: Gathered
    drawings: Sequence[Drawing]
    device: str
    bootstrap: int = 0

    def key(self, flow: Checkpoint, steps: int, drawing: Drawing) -> str:
        """Of a point; when it changes, the point is measured again."""
        how = drawing.sampler(flow, steps)
        more: dict[str, Any] = {"bootstrap": self.bootstrap} if self.bootstrap else {}
        return point_key(
            self.real, self.metrics, **more, weights=weights_hash(flow), steps=steps, num=drawing.num,
            seed=drawing.seed, sampler=how.asdict(), precision=drawing.precision,
            device=self.device, protocol=self.gathered.protocol.name,
        )  # fmt: skip


def steps_of(flow: Checkpoint, label: str, steps: Sequence[int], drawing: Drawing) -> list[int]:
    """The numbers of steps, out of some, that a generator can be run with; a GAN with 1 alone.

    An adaptive solver chooses its own: it has one point, under its sampler's number.

    Raises:
        InputError: it can be run with none of them.
    """
    found, refused = [], ""
    for count in steps:
        try:
            how = drawing.sampler(flow, count)
            found.append(count)
        except InputError as error:
            refused = str(error)
    if not found:
        raise InputError(f"{label}: {refused}")
    return found if hasattr(how, "steps") else found[:1]


def measure_curve(
    curve: Curve,
    flows: Mapping[str, Checkpoint],
    steps: Sequence[int],
    work: Work,
    done: Sequence[Mapping[str, Any]] = (),
    arrived: Callable[[list[dict[str, Any]]], None] = lambda rows: None,
) -> list[dict[str, Any]]:
    """A row for each generator, way to draw and number of steps; rows that are done already are kept as they are.

    Seconds are of the network and its solver alone, the median over batches, so that neither the first batch's warm-up
    nor the metrics count.

    Args:
        flows: By label.
        done: Rows of an earlier, perhaps unfinished call.
        arrived: Called with all rows so far after each point that was measured.
    """
    known = {row["key"]: dict(row) for row in done}
    rows: list[dict[str, Any]] = []
    for (name, flow), drawing in product(flows.items(), curve.drawings):
        label = f"{name}, {drawing.sampler_options['name']}" if len(curve.drawings) > 1 else name
        for count in steps_of(flow, label, steps, drawing):
            key = curve.key(flow, count, drawing)
            if key in known:
                rows.append({**known[key], "flow": label})
            else:
                rows.append({**_point(curve, flow, label, count, drawing, work), "key": key})
                arrived(rows)
    return rows


def _point(curve: Curve, flow: Checkpoint, label: str, steps: int, drawing: Drawing, work: Work) -> dict[str, Any]:
    how = drawing.sampler(flow, steps)
    drawn = sampled_set(flow, label, drawing.num, how, drawing.seed, drawing.precision)
    measured = measure(curve.metrics, curve.gathered, drawn, work, curve.bootstrap)
    assert isinstance(drawn.source, SampledScans)
    # A process without a batch has none; the first one, which writes the page, always has some.
    evaluations: Sequence[float] = drawn.source.evaluations or [math.nan]
    seconds = drawn.source.seconds or [math.nan]
    figures = {f"{m.metric}/{name}": value for m in measured for name, value in m.figures.items()}
    for one in measured:
        for name, ends in one.intervals.items():
            figures |= {f"{one.metric}/{name}{end}": value for end, value in zip(ENDS, ends, strict=True)}
    remarks = dict.fromkeys(remark for m in measured for remark in m.remarks)
    return {
        "flow": label, "weights": weights_hash(flow), "steps": steps,
        "distilled_for": how.steps if flow.generator.fixed else None,  # type: ignore[attr-defined]
        "solver": how.name, "evaluations": statistics.fmean(evaluations),
        "seconds": statistics.median(seconds), "batch_size": work.batch_size,
        "scans": drawing.num, "seed": drawing.seed, **figures, "remarks": BETWEEN.join(remarks),
    }  # fmt: skip


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of a page that was written there, none where there is no page.

    Raises:
        InputError: a file of its name that is none of ours.
    """
    path = folder / f"{NAME}.json"
    if not path.is_file():
        return []
    try:
        content = read_json(path)
        rows = [*content["rows"], *content["other_points"]]
        return [{k: math.nan if v is None and "/" in k else v for k, v in row.items()} for row in rows if "key" in row]
    except (ValueError, KeyError, TypeError, AttributeError):
        raise InputError(
            f"{path} is no page of this report, or a damaged one; delete it or give another --out."
        ) from None


def speed_quality_page(
    curve: Curve,
    rows: Sequence[Mapping[str, Any]],
    command: str,
    done: Sequence[Mapping[str, Any]] = (),
    figures: bool = True,
) -> Page:
    """The page of a curve.

    Args:
        done: Rows of earlier calls, which the JSON keeps although this call did not ask for them.
        figures: False while it is still being measured.
    """
    drawing, keys = curve.drawings[0], {row["key"] for row in rows}
    # METRIC/FIGURE, without the ends of its interval
    names = [n for n in dict.fromkeys(n for row in rows for n in row) if "/" in n and not n.endswith(ENDS)]
    headings = {name: heading(*name.split("/", 1)) for name in names}
    columns = {
        "flow": "flow",
        "steps": "steps",
        "solver": "solver",
        "evaluations": "evaluations",
        "seconds": "s a scan",
    }
    columns |= {name: said for name, (said, _) in headings.items()}
    printed = [
        {**row, **{n: _shown(row, n, factor) for n, (_, factor) in headings.items() if n in row}} for row in rows
    ]
    about = (
        f"{drawing.num} scans of seed {drawing.seed} at every point, from the same noise, against {len(curve.real)} "
        f"scans of {curve.real.label}, under the protocol `{curve.gathered.protocol.name}`. Seconds are those of the "
        "network and its solver, the median over batches."
    )
    remarks = dict.fromkeys(remark for row in rows for remark in row["remarks"].split(BETWEEN) if remark)
    protocol = curve.gathered.protocol.describe()
    more: dict[str, Sequence[Mapping[str, Any]]] = {
        "protocols": [
            {**protocol, **metric.protocol.asdict(), "real_chosen": curve.gathered.rules[name]}
            for name, metric in curve.metrics.items()
        ],
        "other_points": [row for row in done if row["key"] not in keys],
    }
    drawn = {NAME: speed_quality_figure(rows, names)} if figures and names else {}
    text = [about, table(printed, columns), *(["\n".join(f"- {remark}" for remark in remarks)] if remarks else [])]
    return Page(
        NAME, "Quality against speed", text, rows, drawn, command, {"sampled scans": drawing.seed}, curve.device, more
    )


def _shown(row: Mapping[str, Any], name: str, factor: float) -> float | str:
    """A figure as it is printed, with its interval where it has one."""
    low, high = (row.get(f"{name}{end}") for end in ENDS)
    value: float = row[name] * factor
    return value if low is None or high is None else f"{shown(value)} ({shown(low * factor)} to {shown(high * factor)})"


def speed_quality_figure(rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Figure:
    """Each metric's first figure against evaluations (above) and seconds (below), a line for each flow."""
    first: dict[str, str] = {}
    for name in names:
        first.setdefault(name.split("/", 1)[0], name)
    flows = list(dict.fromkeys(row["flow"] for row in rows))
    figure = blank_figure(3.4 * len(first) + 0.6, 6.2, "quality against speed: lower left is better")
    panels = figure.subplots(2, len(first), squeeze=False)
    for (line, (x, label)), (column, name) in product(enumerate(AXES), enumerate(first.values())):
        axes = panels[line, column]
        said, factor = heading(*name.split("/", 1))
        for flow, style in zip(flows, cycle(STYLES), strict=False):
            own = sorted((row for row in rows if row["flow"] == flow), key=lambda row: row[x])
            at = [row[x] for row in own]
            axes.plot(at, [row.get(name, math.nan) * factor for row in own], **style, ms=5, lw=1.2, label=flow)
            ends = [[row.get(f"{name}{end}", math.nan) * factor for row in own] for end in ENDS]
            axes.vlines(at, *ends, color=style["color"], lw=0.8)
        positive = all(row[name] > 0 for row in rows if name in row)
        axes.set(xscale="log", yscale="log" if positive else "linear", xlabel=label, ylabel=said)
        few_log_ticks(axes.xaxis)
        axes.grid(True, which="major", color="0.88", lw=0.6)
        axes.tick_params(labelsize=8)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(flows), 4), fontsize=8, frameon=False)
    return figure
