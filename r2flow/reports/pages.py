"""Reports: figures, JSON and Markdown, each with its provenance."""

import json
import math
import os
import platform
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure

import r2flow
from r2flow.base.files import write_file
from r2flow.reports.pictures import save_figure
from r2flow.reports.tables import Row, words

# Markers and dashes distinguish lines without colour.
STYLES: tuple[Row, ...] = tuple(
    {"marker": marker, "linestyle": dash, "color": f"C{number}"}
    for number, (marker, dash) in enumerate(
        zip("os^DvPX*<>", ("-", "--", "-.", ":", "-") * 2, strict=True)
    )
)


def command() -> str:
    """The command line of this process, quoted for a shell."""
    program, *arguments = sys.argv
    if Path(program).stem in ("r2flow", "__main__"):
        return shlex.join(["r2flow", *arguments])
    return shlex.join(["python", program, *arguments])


@dataclass(frozen=True)
class Page:
    """Contents of a report."""

    name: str  # stem of the files, such as `solvers`
    title: str
    text: Sequence[str]
    rows: Sequence[Row]
    figures: dict[str, Figure]
    seeds: Mapping[str, int] = field(default_factory=dict)
    device: str = "cpu"
    more: Mapping[str, Sequence[Row]] = field(default_factory=dict)


def write_page(page: Page, out: Path) -> list[Path]:
    """Write `out/NAME.png ...`, `NAME.pdf`, `NAME.json` and `NAME.md` atomically; returns the
    files.
    """
    origin = _provenance(page)
    written = []
    for name, figure in page.figures.items():
        for ending in ("png", "pdf"):
            path = out / f"{name}.{ending}"
            written.append(save_figure(figure, path, title=page.title, about=json.dumps(origin)))
    data = out / f"{page.name}.json"
    text = out / f"{page.name}.md"
    write_json(page, data)
    write_file(text, _markdown(page, origin))
    return [*written, data, text]


def write_json(page: Page, path: Path) -> None:
    """Write the rows of a page with their provenance."""
    content = _plain({"origin": _provenance(page), "rows": page.rows, **page.more})
    write_file(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def _provenance(page: Page) -> Row:
    """Machine, versions, seeds, date and command of a page; only the command has paths."""
    machine = {
        "cpu": _cpu_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "system": platform.platform(terse=True),
    }
    if page.device.startswith("cuda"):
        machine["gpu"] = torch.cuda.get_device_name(page.device)
    return {
        "report": page.title,
        "command": command(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine,
        "versions": {
            "r2flow": r2flow.__version__,
            "torch": torch.__version__,
            "python": platform.python_version(),
        },
        "seeds": dict(page.seeds),
        "device": page.device,
    }


def blank_figure(width: float, height: float) -> Figure:
    """Create an empty figure, sized in inches."""
    return Figure(figsize=(width, height), facecolor="white", layout="constrained")


class Plot(NamedTuple):
    """Lines in one panel of a figure."""

    x: str  # labels of the axes
    y: str
    lines: Mapping[str, tuple[Any, Any]]  # x and y by label
    title: str = ""
    log_x: bool = False


def lines_figure(plots: Sequence[Plot], columns: int) -> Figure:
    """Draw plots in rows of `columns`; equal labels share a style.

    The y axis is logarithmic if its values are positive and differ by more than three times. The
    legend is left out if there are more labels than styles.
    """
    labels = list(dict.fromkeys(label for plot in plots for label in plot.lines))
    columns = min(columns, len(plots))
    rows = math.ceil(len(plots) / columns)
    legend = len(labels) <= len(STYLES)
    figure = blank_figure(4.2 * columns + 0.4, 3.3 * rows + (0.18 * len(labels) if legend else 0))
    for place, plot in enumerate(plots, 1):
        axes = figure.add_subplot(rows, columns, place)
        for label, (x, y) in plot.lines.items():
            style = STYLES[labels.index(label) % len(STYLES)]
            interval = max(len(x) // 8, 1)
            axes.plot(x, y, **style, ms=4, lw=1.1, markevery=interval, label=label)
        axes.set(xlabel=plot.x, ylabel=plot.y, xscale="log" if plot.log_x else "linear")
        axes.set_title(plot.title, fontsize=9)
        values = [v for _, y in plot.lines.values() for v in np.ravel(y) if math.isfinite(v)]
        if values and 0 < 3 * min(values) < max(values):  # else its labels would be 1.11 x 10^0
            axes.set_yscale("log")
        axes.grid(color="0.88", lw=0.6)
        axes.tick_params(which="both", labelsize=8)
    if legend:
        handles = {line.get_label(): line for axes in figure.axes for line in axes.lines}
        figure.legend(handles=handles.values(), fontsize=8, loc="outside lower left", frameon=False)
    return figure


def _plain(value: Any) -> Any:
    """Convert values for JSON, which has no NaN or infinity."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _markdown(page: Page, origin: Mapping[str, Any]) -> str:
    pictures = [f"![{name.replace('_', ' ')}]({name}.png)" for name in page.figures]
    notes = [
        f"- {key}: {words(value) if isinstance(value, Mapping) else value}"
        for key, value in origin.items()
        if key not in ("report", "command")
    ]
    runs = re.findall("`+", origin["command"])
    fence = "`" * max(3, *(1 + len(run) for run in runs), 3)  # no name ends it
    texts = [f"# {page.title}", *pictures, *page.text, "## Where this comes from", "Made with"]
    code = f"{fence}\n{origin['command']}\n{fence}"
    # names are no HTML
    before, after = (text.replace("<", "&lt;") for text in ("\n\n".join(texts), "\n".join(notes)))
    return f"{before}\n\n{code}\n\n{after}\n"


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor()
    return str(re.findall(r"model name\s*: (.*)|$", info.read_text(encoding="utf-8"))[0])
