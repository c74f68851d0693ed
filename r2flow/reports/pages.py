"""Pages of reports: figures, JSON and Markdown, each with its provenance."""

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
from textwrap import indent
from typing import Any

import torch
from matplotlib.figure import Figure

import r2flow
from r2flow.base.files import write_file
from r2flow.reports.figures import save_figure
from r2flow.reports.tables import Part, Row, Table, markdown, print_table, words


def command() -> str:
    """The command line of this process, quoted for a shell."""
    program, *arguments = sys.argv
    if Path(program).stem in ("r2flow", "__main__"):
        return shlex.join(["r2flow", *arguments])
    return shlex.join(["python", program, *arguments])


@dataclass(frozen=True)
class Page:
    """Contents of a report.

    `text` is printed and written, `details` are written below it. `rows` and `more` go into the
    JSON.
    """

    name: str  # stem of the files, such as `solvers`
    title: str
    text: Sequence[Part]
    rows: Sequence[Row]
    figures: dict[str, Figure] = field(default_factory=dict)
    seeds: Mapping[str, int] = field(default_factory=dict)
    device: str = "cpu"
    more: Mapping[str, Sequence[Row]] = field(default_factory=dict)
    details: Sequence[Part] = ()


def print_text(parts: Sequence[Part]) -> None:
    """Print texts and tables, an empty line after each."""
    for part in parts:
        if isinstance(part, Table):
            print_table(*part)
        else:
            print(part)
        print(flush=True)


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
    text = [
        markdown(*part) if isinstance(part, Table) else part for part in (*page.text, *page.details)
    ]
    notes = [
        f"- {key}: {words(value) if isinstance(value, Mapping) else value}"
        for key, value in origin.items()
        if key not in ("report", "command")
    ]
    parts = [f"# {page.title}", *pictures, *text, "## Where this comes from", "Made with"]
    before, after = (  # names are no HTML
        text.replace("<", "&lt;") for text in ("\n\n".join(parts), "\n".join(notes))
    )
    return f"{before}\n\n{indent(origin['command'], '    ')}\n\n{after}\n"


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor()
    return str(re.findall(r"model name\s*: (.*)|$", info.read_text(encoding="utf-8"))[0])
